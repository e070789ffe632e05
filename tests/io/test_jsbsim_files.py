"""Copies of JSBSim's aircraft: detects a lost part, a socket that stays, a missing force."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from lidar_mi.io.jsbsim_files import shipped_aircraft, write_aircraft_in_wake

jsbsim = pytest.importorskip("jsbsim")
ROOT = Path(jsbsim.__file__).parent


def test_shipped_aircraft():
    names = shipped_aircraft(ROOT)
    assert {"737", "A320", "c172p"} <= set(names) and "blank" in names
    assert list(names) == sorted(set(names))


@pytest.mark.parametrize(("name", "own"), [("737", 0), ("ball", 1)])
def test_copy_has_the_wakes_forces_and_no_socket(tmp_path, name, own):
    write_aircraft_in_wake(ROOT, name, tmp_path)
    before = ElementTree.parse(ROOT / "aircraft" / name / f"{name}.xml").getroot()
    after = ElementTree.parse(tmp_path / name / f"{name}.xml").getroot()
    kept = [e.tag for e in before if e.tag not in ("input", "output", "external_reactions")]
    left = [e.tag for e in after if e.tag != "external_reactions"]
    assert left == kept
    reactions = after.find("external_reactions")
    mine = [e.get("name") for e in reactions if e.get("name", "").startswith("wake-")]
    assert len(mine) == 6
    assert (len(reactions) > 6) == bool(own)
