"""The pictures of the pages and the colours of their code.

Detects a picture without a maker or with two, a maker without its picture, a figure that no
experiment draws, code too faint to be read in the light or the dark mode.
"""

import re
import runpy
from pathlib import Path

import pytest

from tests.support.page_rules import contrast

pytest.importorskip("nbformat", reason="nbformat is not installed (extra test)")

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SCRIPT = runpy.run_path(str(DOCS / "make_pictures.py"))


def test_every_picture_has_one_maker():
    there = {str(path.relative_to(DOCS / "pictures")) for path in DOCS.glob("pictures/**/*.png")}
    assert set(SCRIPT["makers"]()) == there
    kinds = [SCRIPT[kind] for kind in ("FIGURES", "PARTS", "EXAMPLES", "CHECKS")]
    assert sum(map(len, kinds)) == len({name for kind in kinds for name in kind})


def test_makers_name_what_there_is():
    figures = "\n".join(
        path.read_text() for path in (ROOT / "lidar_mi/assessment/figures").glob("*.py")
    )
    for command, experiment, place in SCRIPT["FIGURES"].values():
        assert command in ("run", "fly")
        assert (ROOT / "scenes" / f"{experiment}.yaml").is_file()
        assert f'"{Path(place).stem}"' in figures
    for campaign, *_ in SCRIPT["PARTS"].values():
        assert (ROOT / "scenes/campaigns" / f"{campaign}.yaml").is_file()
    for example in SCRIPT["EXAMPLES"]:
        assert (ROOT / "examples" / f"{example}.py").is_file()


def test_every_picture_is_on_a_page():
    pages = "\n".join(path.read_text() for path in (*DOCS.rglob("*.md"), ROOT / "README.md"))
    for path in (*DOCS.glob("pictures/**/*.png"), *DOCS.glob("validation/*.png")):
        assert f"/{path.name})" in pages or path.name in pages, path.name


@pytest.mark.parametrize("mode", ["pygments_style", "pygments_dark_style"])
def test_code_of_the_site_is_read_in_both_modes(mode):
    """Each token against the background of code: 4.5 and more (WCAG 2.2, AA)."""
    pytest.importorskip("a11y_pygments", reason="accessible-pygments is not installed (extra docs)")
    from pygments.styles import get_style_by_name

    name = re.search(rf'^{mode} = "(.+)"', (DOCS / "conf.py").read_text(), re.MULTILINE)[1]
    style = get_style_by_name(name)
    for token, found in style:
        if found["color"]:
            back = found["bgcolor"] or style.background_color
            assert contrast(f"#{found['color']}", f"#{back.lstrip('#')}") >= 4.5, token
