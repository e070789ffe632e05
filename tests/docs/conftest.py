"""Pages that are made from the code and from stored results, for the links to them."""

import runpy
from pathlib import Path

# before tests are collected, some of which are of each page
runpy.run_path(str(Path(__file__).parents[2] / "docs" / "make_pages.py"), run_name="__main__")
