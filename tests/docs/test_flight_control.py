"""The page of flight control has every field of its interface, and no other.

Detects a field that is new, renamed or gone, and a sign that is not the code's.
"""

import inspect
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from lidar_mi.aircraft.control import HORIZON
from lidar_mi.aircraft.state import AircraftModel, AircraftState, Commands
from lidar_mi.aircraft.strips import Loads, wake_loads, wing_strips
from lidar_mi.encounter.lidar.estimate import Estimate

PAGE = Path(__file__).parents[2] / "docs" / "flight_control.md"


def documented(title):
    """Fields of the first table of a section."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n## {title}\n")[1].split("\n## ")[0]
    table = re.search(r"(?:^\|.*\n)+", section, re.M)[0]
    first = [line.split("|")[1] for line in table.splitlines()[2:]]
    return {name for cell in first for name in re.findall(r"`(\w+)`", cell)}


@pytest.mark.parametrize("kind", [AircraftState, Loads, Commands, Estimate])
def test_all_fields_are_there(kind):
    assert documented(kind.__name__) == {field.name for field in fields(kind)}


def test_attributes_of_an_aircraft_are_there():
    own = {name for name, _ in inspect.getmembers(AircraftModel, lambda m: isinstance(m, property))}
    assert documented("AircraftModel") == own


def test_the_handover_takes_as_long_as_it_says():
    assert f"from 1 to 0 in {HORIZON:g} s" in PAGE.read_text(encoding="utf-8")


def test_signs_are_those_of_the_page():
    """Wind up under the port wing rolls it up; wind up on a tail moves the nose down."""
    wing = wing_strips(30.0, 100.0, 5.3)
    up = np.where(wing.places[:, 1:2] > 0, [0.0, 0.0, 1.0], 0.0)
    assert wake_loads(wing, up, 75.0, 1.2).moment[0] > 0
    tail = wing_strips(10.0, 20.0, 5.3, place=(-15.0, 0.0, 0.0))
    loads = wake_loads(tail, np.tile([0, 0, 1.0], (len(tail.areas), 1)), 75.0, 1.2)
    assert loads.moment[1] > 0 and loads.force[2] > 0
