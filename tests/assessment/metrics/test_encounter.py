"""Numbers of a flight into a wake, from time series whose answers are known.

Detects a roll of the wrong flight, a fraction of the wrong two differences, a lead time that counts
from the first scan, errors of slabs without a track, an innovation that is not per degree of
freedom.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.encounter import (
    encounter_metrics,
    felt_from,
    fraction_added,
    measured_in_flight,
    prediction_error,
    residual_moment,
)

TIME = np.linspace(0, 4, 401)
NAMES = ("circulation", "core_radius", "y", "z")
TRUE = {"circulation": 300.0, "core_radius": 3.0, "y": 20.0, "z": 0.0}


def flight(roll, control, predicted=np.nan):
    """A wake from 2 s to 3 s that rolls to ``roll``; controls cancel a fraction of it."""
    wake = np.where((TIME >= 2) & (TIME <= 3), 1e5, 0.0)
    values = {
        "x": 75 * TIME,
        "roll": roll * np.sin(np.pi * TIME / 4),
        "roll_rate": 2 * roll * np.cos(np.pi * TIME / 4),
        "airspeed": np.full(401, 75.0),
        "departed": np.zeros(401),
        "roll_moment": wake,
        "force_z": -0.2 * wake,
        "control_roll_moment": -control * wake,
        "predicted_roll_moment": predicted * wake,
    }
    found = xr.Dataset({k: ("time", v) for k, v in values.items()}, {"time": TIME})
    return found.assign(largest_control_roll_moment=2e5)


@pytest.fixture
def series():
    flights = [flight(0.5, 0.0), flight(-0.14, 0.75, 0.9), flight(0.05, 0.9), flight(-0.2, 0.6)]
    names = ["off", "feedforward", "perfect", "autopilot"]
    names = xr.DataArray(names, dims="flight", name="flight")
    return xr.concat(flights, names)


@pytest.fixture
def track():
    """Ten slabs, 7.5 m apart from 75 m on; usable from the fourth, 2 % and 0.5 m wrong."""
    n = np.arange(10)
    found = xr.Dataset(coords={"slab": n, "source": ["estimate", "track", "truth"]})
    for name, values in {
        "time": 0.1 * n + 0.05,
        "delivered": 0.1 * n + 0.12,
        "x": 75 + 7.5 * n,
        "accepted": (n > 0) * 1.0,
        "usable": (n > 2) * 1.0,
        "updates": n * 1.0,
        "rejected": np.zeros(10),
        "innovation": np.where(n > 1, 8.0, np.nan),
        "innovation_dof": np.where(n > 1, 10.0, np.nan),
        "vectors": np.full(10, 63.0),
        "error_v": np.full(10, 0.3),
        "error_w": np.full(10, 0.4),
    }.items():
        found[name] = ("slab", values)
    for side, sign in (("port", 1), ("starboard", -1)):
        for name in NAMES:
            true = TRUE[name] * (sign if name in ("circulation", "y") else 1)
            wrong = true * 1.02 if name == "circulation" else true + 0.3 * (name == "y")
            wrong += 0.4 * (name == "z")
            values = np.tile([[wrong], [wrong], [true]], 10)
            values[:2, :3] = np.nan
            found[f"{side}_{name}"] = (("source", "slab"), values)
            stderr = 10.0 if name == "circulation" else 0.18
            found[f"{side}_{name}_stderr"] = (("source", "slab"), np.full((3, 10), stderr))
    return found


def test_roll_and_moments(series):
    found = encounter_metrics(series, None)
    assert found["encounter.off.largest_roll"] == pytest.approx(0.5)
    assert found["encounter.feedforward.largest_roll"] == pytest.approx(0.14)
    assert found["encounter.perfect.largest_roll_rate"] == pytest.approx(0.1)
    assert found["encounter.removed_beyond_autopilot.largest_roll"] == pytest.approx(0.06 / 0.15)
    assert found["encounter.perfect.largest_lift"] == pytest.approx(2e4)
    assert found["encounter.feedforward.residual_moment"] == pytest.approx(0.25)
    assert found["encounter.off.roll_control_ratio"] == pytest.approx(0.5)
    # 0.14 rad are 8 degrees, 0.05 rad are 3
    assert [found[f"encounter.{m}.hazardous"] for m in series["flight"].values] == [1, 1, 0, 1]
    assert not any("track" in key for key in found)


def test_no_fraction_of_nothing():
    """A lidar is judged only where perfect preview removes something beyond the autopilot."""
    found = fraction_added([5.0, 5.0, 1.0], [2.0, 6.0, 0.5], [1.0, 1.0, 0.6], 0.5)
    assert np.array_equal(found, [0.75, -0.25, np.nan], equal_nan=True)


def test_still_air_has_no_fraction(series):
    calm = series.assign(roll_moment=0 * series["roll_moment"])
    assert np.isnan(residual_moment(calm.isel(flight=0))) and np.isnan(felt_from(calm))
    assert "encounter.off.residual_moment" not in encounter_metrics(calm, None)


def test_a_wake_in_turbulence_is_felt_by_its_own_moment(series):
    """Turbulence of a tenth of the wake's moment from the beginning on; the wake comes at 2.5 s."""
    rough = series.assign(
        roll_moment=series["roll_moment"] + 2e4,
        wake_roll_moment=("time", np.where(TIME >= 2.5, 1e5, 0.0)),
    )
    assert felt_from(rough) == pytest.approx(2.5)
    assert felt_from(rough.drop_vars("wake_roll_moment")) == 0


def test_the_lidar_in_flight(series, track):
    found = encounter_metrics(series, track)
    assert prediction_error(series.isel(flight=1)) == pytest.approx(0.1)
    assert found["encounter.slabs_to_track"] == 3 and found["encounter.usable_slabs"] == 7
    # felt from 2 s on; a preview from the start
    assert found["encounter.lead_time"] == pytest.approx(2.0, abs=0.011)
    # 75 m are 1 s, less the delivery 0.12 s after the first slab's scan
    assert found["encounter.look_ahead"] == pytest.approx(0.88)
    assert found["encounter.after_5_slabs.circulation_error"] == pytest.approx(0.02)
    assert found["encounter.after_5_slabs.core_error"] == pytest.approx(0.5)
    # z is 0.4 m wrong, by more than 2 x 0.18 m: 2 of 6
    assert found["encounter.tracked.within_2_sigma"] == pytest.approx(4 / 6)
    assert found["encounter.normalised_innovation"] == pytest.approx(0.8)


def test_slabs_after_a_loss_do_not_count(series, track):
    lost = track["slab"] > 7
    for name in ("port_y", "starboard_z"):
        track[name] = track[name].where(~lost)
    track["usable"] = track["usable"].where(~lost, 0.0)
    found = encounter_metrics(series, track)
    assert found["encounter.tracked.core_error"] == pytest.approx(0.5)


def test_rows_of_the_requirements(series, track):
    found = measured_in_flight(series, track, 2.5)
    assert found["slabs_per_second"] == 10 and found["points_per_slab"] == 63
    assert found["range"] == pytest.approx(0.88 * 75)
    assert (found["error_v"], found["error_w"]) == pytest.approx((0.3, 0.4))


def test_load_increments(series):
    """From the trim, to the larger side; bending of the larger wing; shares as of the roll."""
    peaks = xr.DataArray([0.8, -0.5, 0.3, 0.7], dims="flight")
    bump = xr.DataArray(np.sin(np.pi * TIME / 4), dims="time")
    loads = {
        "load_factor": 0.996 + peaks * bump,
        "port_bending": 1e5 * peaks * bump,
        "starboard_bending": -2e5 * peaks * bump,
    }
    found = encounter_metrics(series.assign(loads), None)
    for mode, peak in (("off", 0.8), ("feedforward", 0.5), ("perfect", 0.3), ("autopilot", 0.7)):
        assert found[f"encounter.{mode}.largest_load_increment"] == pytest.approx(peak)
        assert found[f"encounter.{mode}.largest_bending_increment"] == pytest.approx(2e5 * peak)
    share = found["encounter.removed_beyond_autopilot.largest_load_increment"]
    assert share == pytest.approx(0.2 / 0.4)
    assert not any("increment" in name for name in encounter_metrics(series, None))
