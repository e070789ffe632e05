"""The scan that follows the pair. Unit tests, and one of rendered images.

Detects: a middle that leaves the pair, steps or angles beyond the limits, estimates used before
they are delivered, images of other places than they say.
"""

from dataclasses import replace

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.encounter.lidar.scan_window import ScanWindow, window_reach
from lidar_mi.encounter.lidar.slabs import gates_of
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from tests.support.encounters import small_encounter

SIZE = 60.0, 40.0
AHEAD = 0.0, 0.0


def experiment(latency="0.12 s", reach="20 deg"):
    flight = {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"}
    return small_encounter(
        encounter={
            "path": flight,
            "window": {"follow": True, "reach": reach},
            "control": {"latency": latency},
        }
    )


def following(latency="0.12 s", reach="20 deg"):
    return encounter_of(experiment(latency, reach))


def pair_at(y, z, probability=np.nan, slopes=None):
    parameters = np.array([300, 1, y + 12, z, -300, 1, y - 12, z, 0, 0.0])
    fit = VortexPairFit(parameters, np.eye(10), "lamb_oseen", 1, 1, 0, 0, probability=probability)
    return replace(fit, slopes=slopes)


def test_straight_ahead_by_default():
    encounter = encounter_of(small_encounter())
    assert ScanWindow(encounter, SIZE).at(1, AHEAD, pair_at(10, 5)) == (0, 0)
    assert window_reach(encounter) == 0


def test_the_middle_reaches_the_expected_pair_in_steps_of_a_tenth():
    """Of the farther slab: 7.5 m along the slopes; about the aircraft, which is aside."""
    window = ScanWindow(following(), SIZE)
    expected = pair_at(17.0, -9.0, slopes=np.array([0.2, 0.0]))
    found = np.array([window.at(k, (2.0, 1.0), expected) for k in range(6)])
    np.testing.assert_allclose(found[0], [6.0, -10.0 * 6 / 16.5])
    steps = np.abs(np.diff(found, axis=0)).max(0)
    assert steps[0] <= 6 + 1e-9 and steps[1] <= 4 + 1e-9
    np.testing.assert_allclose(found[-1], [17 + 0.2 * 7.5 - 2, -10.0])


def test_the_angle_is_limited():
    encounter = following(reach="5 deg")
    window = ScanWindow(encounter, SIZE)
    found = [window.at(k, AHEAD, pair_at(60.0, 80.0)) for k in range(30)]
    assert np.hypot(*found[-1]) == pytest.approx(150 * np.tan(np.radians(5)))
    assert found[-1][0] / found[-1][1] == pytest.approx(0.6 / 0.8)


@pytest.mark.parametrize(("latency", "delay"), [("0.12 s", 2), ("0.1 s", 1), ("0.3 s", 3)])
def test_a_probable_pair_is_followed_once_it_is_delivered(latency, delay):
    window = ScanWindow(following(latency), SIZE)
    moved = []
    for number in range(6):
        moved.append(window.at(number, AHEAD, None)[0])
        pair = pair_at(40.0, 0.0, probability=0.9 if number else np.nan)
        window.add(0.1 * number + float(latency.split()[0]), pair)
    assert np.flatnonzero(moved)[0] == 1 + delay


def test_without_a_probable_pair_it_looks_ahead_again():
    window = ScanWindow(following(), SIZE)
    for number in range(4):
        window.at(number, AHEAD, pair_at(20.0, 0.0))
    for number in range(4, 12):
        window.add(0.1 * (number - 1) + 0.12, pair_at(20.0, 0.0, probability=0.3))
        last = window.at(number, AHEAD, None)
    assert last == pytest.approx((0, 0), abs=1e-9)


def test_a_step_that_is_repeated_looks_to_the_same_place():
    window = ScanWindow(following(), SIZE)
    found = [window.at(k, AHEAD, pair_at(20.0, 5.0)) for k in (0, 1, 2, 2)]
    assert found[2] == found[3] != found[1]


def test_beams_go_to_the_nodes_about_the_middle():
    gates = gates_of(small_encounter())
    plan = gates.plan(1.5, (20.0, -8.0))
    y, z = gates.axes(plan, -1)
    np.testing.assert_allclose(y, gates.y + 20, atol=1e-9)
    np.testing.assert_allclose(z, gates.z - 8, atol=1e-9)
    direction = plan.directions().reshape(len(gates.z), len(gates.y), 3)
    met = direction * ((150 - 1.5 + 1.25) / direction[..., :1])
    np.testing.assert_allclose(met[0, :, 1], y[::-1], atol=1e-9)
    np.testing.assert_allclose(met[:, 0, 2], z[::-1], atol=1e-9)
    np.testing.assert_allclose(plan.obliquity(), 1 / direction[::-1, ::-1, 0], rtol=1e-12)


def test_images_show_the_air_where_they_say(monkeypatch):
    """A scan about another middle, by the texture at its places: a correlation above 0.9."""
    lidar = lm.VirtualLidar(experiment())
    middles = iter([(18.0, -9.0), (21.0, -7.0), (24.0, -5.0)])
    monkeypatch.setattr(lidar._window, "at", lambda *_: next(middles))
    lidar.step(0.0)
    estimate = lidar.step(0.1)
    image = lidar.images.first
    assert float(image["y"].min()) == pytest.approx(-30 + 20, abs=2.5)
    y, z = np.meshgrid(image["y"], image["z"])
    x = lidar.gates.slab(0) + 1.25 * np.linspace(-1, 1, 9)
    seen = np.mean([lidar.air.texture.at(place, y, z) for place in x], 0)
    assert np.corrcoef(seen.ravel(), image.values.ravel())[0, 1] > 0.9
    # the pair is at the edge of this image, or beyond: places of accepted fits are true
    if estimate.pair.success:
        truth = lidar.wake.vortices(estimate.x, estimate.time)
        assert np.abs(estimate.pair.parameters[[2, 6]] - [o.y for o in truth]).max() < 1.0
