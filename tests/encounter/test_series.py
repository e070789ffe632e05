"""Flights and tracks as data sets.

Detects: a column under another's name, units left out, standard errors of the wrong scale, a slab
without an estimate that shows numbers, errors over vectors that are flagged.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.aircraft.state import AircraftState, Commands
from lidar_mi.aircraft.strips import Loads
from lidar_mi.encounter.ahead.preview import Slab, WakeTracker
from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.encounter.series import QUANTITIES, FlightRecorder, track_dataset
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import STDERR, SyntheticLidar, encounter_keys


@pytest.fixture(scope="module")
def wake():
    return wake_along_path(check(encounter_keys(), "test"))


def recorded(roll):
    """Two instants: the second with a prediction."""
    record = FlightRecorder()
    loads = Loads(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    for k, predicted in enumerate((None, Loads(10 * loads.force, 10 * loads.moment))):
        state = AircraftState(
            time=0.1 * k, x=7.5 * k, roll=roll, pitch_rate=0.3, load_factor=1.5, port_bending=7.0
        )
        deflection = np.array([0.5, 0.6, 0.0])
        commands = Commands(0.1, 0.2, 0.3, 0.4)
        record.add(state, loads, predicted, commands, deflection, np.diag([2.0, 3, 5]), 0.7)
    return record.dataset()


def test_every_number_is_under_its_name():
    found = recorded(0.25)
    expected = {
        "x": [0, 7.5],
        "roll": 0.25,
        "pitch_rate": 0.3,
        "departed": 0,
        "force_x": 1,
        "force_z": 3,
        "roll_moment": 4,
        "yaw_moment": 6,
        "predicted_roll_moment": [np.nan, 40],
        "predicted_force_y": [np.nan, 20],
        "aileron": 0.1,
        "rudder": 0.3,
        "symmetric_aileron": 0.4,
        "aileron_deflection": 0.5,
        "elevator_deflection": 0.6,
        "symmetric_aileron_deflection": 0.7,
        "load_factor": 1.5,
        "port_bending": 7.0,
        "starboard_bending": np.nan,
        "control_roll_moment": 1.0,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], np.broadcast_to(values, 2), err_msg=name)
    assert all(found[name].attrs["units"] and found[name].attrs["long_name"] for name in found)
    np.testing.assert_allclose(found["time"], [0, 0.1])


def test_track_has_estimates_track_and_truth_of_every_slab(wake):
    tracker = WakeTracker(SyntheticLidar(wake), 0.1, 7.5)
    for time in np.arange(0, 1.2, 0.05):
        tracker.update(AircraftState(time=float(time), x=75 * float(time)))
    found = track_dataset(tracker.slabs, wake)
    assert found.sizes["slab"] == len(tracker.slabs) > 8
    assert list(found["source"].values) == ["estimate", "track", "truth"]
    # the first scan has no pair of images
    first = found.isel(slab=0)
    assert first["accepted"] == 0 and np.isnan(first["port_y"].sel(source="estimate"))
    later = found.isel(slab=slice(3, None))
    for name, k in (("port_circulation", 0), ("starboard_y", 6), ("port_z", 3)):
        estimate, truth = (later[name].sel(source=one) for one in ("estimate", "truth"))
        np.testing.assert_allclose(later[f"{name}_stderr"].sel(source="estimate"), STDERR[k])
        assert np.abs(estimate - truth).max() < 4.5 * STDERR[k]
    # the standard error of a radius is that of its logarithm times the radius
    radius = later["port_core_radius"].sel(source="estimate")
    stderr = later["port_core_radius_stderr"].sel(source="estimate")
    np.testing.assert_allclose(stderr, STDERR[1] * radius)
    x, time = float(later["x"][0]), float(later["time"][0])
    port, _ = wake.vortices(x, time)
    assert float(later["port_y"].sel(source="truth")[0]) == port.y
    assert all(found[name].attrs["units"] for name in QUANTITIES)


def test_errors_of_the_wind_are_those_of_valid_vectors(wake):
    y, z = np.linspace(-20.0, 20.0, 5), np.linspace(-10.0, 10.0, 3)
    places = np.meshgrid(y, z)
    _, v, w = wake.wind(np.full(places[0].shape, 75.0), *places, 1.0)
    flag = np.zeros(v.shape, int)
    flag[0, 0] = 1
    wrong = np.where(flag == 1, 100.0, 0.0)
    axes = {"z": z, "y": y}
    wind = xr.Dataset(
        {
            "v": (("z", "y"), v + 0.5 + wrong),
            "w": (("z", "y"), w - 0.25),
            "flag": (("z", "y"), flag),
        },
        coords=axes,
    )
    slab = Slab(
        Estimate(1.0, 1.1, 75.0, wind, None, ("a", "b"), {"wind": 0.2, "vortices": 0.1}), None
    )
    found = track_dataset([slab], wake)
    assert float(found["error_v"][0]) == pytest.approx(0.5)
    assert float(found["error_w"][0]) == pytest.approx(0.25)
    assert found["vectors"][0] == 14 and found["flags"][0] == "a; b"
    assert float(found["seconds"][0]) == pytest.approx(0.3)
