"""Write the pages of ``docs/validation`` from the results that ``make validate`` stored.

Usage: ``python docs/make_validation_pages.py``.
"""

import sys
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parent))

from validation import report  # noqa: E402

RESULTS = FOLDER.parent / "validation" / "results"


def pages() -> dict[str, str]:
    """Texts of the pages by their place below ``docs``."""
    stored = sorted(RESULTS.glob("*.json"))
    return {f"validation/{one.stem}.md": report.page(report.load(one)) for one in stored}


if __name__ == "__main__":
    for name, text in pages().items():
        report.write(text, FOLDER / name)
    print(f"{FOLDER / 'validation'}: {len(pages())} pages")
