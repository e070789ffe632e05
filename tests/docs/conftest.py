"""Pages that are made from stored results, for the links to them."""

import runpy
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "docs" / "make_validation_pages.py"

# before tests are collected, some of which are of each page
runpy.run_path(str(SCRIPT), run_name="__main__")
