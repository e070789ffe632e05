"""Write the pages that are made from the code and from stored results; the site does so by itself.

Usage: ``python docs/make_pages.py``.

They are ``docs/reference``, ``docs/api``, ``docs/plugins`` and ``docs/validation``, and the first
pages of two of these.
"""

import runpy
from pathlib import Path

from lidar_mi.io.text import write_text

DOCS = Path(__file__).parent
SCRIPTS = (
    "make_api_reference.py",
    "make_command_reference.py",
    "make_key_reference.py",
    "make_plugin_reference.py",
    "make_validation_pages.py",
)
FOLDERS = ("reference", "api", "plugins", "validation")


def pages() -> dict[str, str]:
    """Texts of the pages by their places below ``docs``."""
    made = (runpy.run_path(str(DOCS / script))["pages"]() for script in SCRIPTS)
    return {place: text for one in made for place, text in one.items()}


def write() -> None:
    """Write pages that have changed, each whole or not at all, and remove those no longer made."""
    made = pages()
    for place, text in made.items():
        page = DOCS / place
        if page.exists() and page.read_text(encoding="utf-8") == text:
            continue
        page.parent.mkdir(exist_ok=True)
        write_text(page, text)
    for folder in FOLDERS:
        for page in (DOCS / folder).glob("*.md"):
            if f"{folder}/{page.name}" not in made:
                page.unlink(missing_ok=True)


if __name__ == "__main__":
    write()
