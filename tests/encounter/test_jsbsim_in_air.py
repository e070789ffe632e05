"""A JSBSim script in our air. System tier.

Detects: loads of another place, time or sense than those of a flight of ours, a script that cannot
steer.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.aircraft.state import Commands, loads_in_wind
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.flight_air import air_along_path

pytest.importorskip("jsbsim")
PATH = {"start": "40 m", "beyond": "60 m", "crossing_angle": "20 deg"}


def experiment():
    return lm.load_experiment("encounter", encounter={"path": PATH, "aircraft": {"model": "737"}})


def test_a_script_rolls_as_a_flight_does():
    """The same wake, aircraft and trim, stepped by JSBSim's step and by ours: within 2 %."""
    given = experiment()
    ours = JSBSimAircraft(given.encounter.aircraft, given.encounter.path)
    script = lm.JSBSimInAir(given, "737")
    # the script starts as its user likes: here from the trim that a flight has
    script.fdm = JSBSimAircraft(given.encounter.aircraft, given.encounter.path)._fdm
    step, wind = 1 / 120, air_along_path(given).wind
    script.fdm.set_dt(step)
    rolls = []
    for _ in range(240):
        loads = loads_in_wind(ours.strips, ours.state, wind, ours.density)
        ours.step(step, loads, Commands())
        assert script.run()
        rolls.append((ours.state.roll, script.state.roll))
    expected, found = np.transpose(rolls)
    assert np.abs(expected).max() > np.radians(5)
    # the script's state is that before its step
    assert np.abs(found[1:] - expected[:-1]).max() < 0.02 * np.abs(expected).max()


def test_what_is_refused():
    with pytest.raises(InputError, match="'737x' is not known"):
        lm.JSBSimInAir(experiment(), "737x")
    with pytest.raises(InputError, match="encounter: missing"):
        lm.JSBSimInAir("wake_backscatter", "737")
