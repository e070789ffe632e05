"""The page of JSBSim's aircraft says which fly: detects an outcome that is another one,
in a sample of the rows.
"""

import random
import re
import runpy
from importlib.metadata import version
from pathlib import Path

import pytest

pytest.importorskip("jsbsim")

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "guide" / "jsbsim.md").read_text(encoding="utf-8")
SCRIPT = runpy.run_path(str(DOCS / "make_jsbsim.py"))
ROWS = {
    row.split("`")[1]: row
    for row in PAGE.split(SCRIPT["BEGIN"])[1].split(SCRIPT["END"])[0].splitlines()
    if row.startswith("| `")
}
# these need more than 5 s each
LONG = {"B17", "pa28", "paraglider", "pc7", "pogo-jsbsim"}
SAMPLE = random.Random(48).sample(sorted(ROWS.keys() - LONG), 8)

of_this_version = pytest.mark.skipif(
    f"JSBSim {version('jsbsim')}:" not in PAGE, reason="the page is of another version of JSBSim"
)


def rows_as_flown(names, capfd):
    rows = {name: SCRIPT["row"](name) for name in names}
    # of JSBSim's own
    assert capfd.readouterr() == ("", "")
    return rows


@of_this_version
def test_all_are_listed():
    assert tuple(ROWS) == SCRIPT["names"]() and len(ROWS) >= 60
    flying = [row for row in ROWS.values() if re.search(r"\| \d+ \| \|$", row)]
    assert 20 < len(flying) < len(ROWS)


@of_this_version
@pytest.mark.slow
def test_some_do_as_listed(capfd):
    assert rows_as_flown(SAMPLE, capfd) == {name: ROWS[name] for name in SAMPLE}
