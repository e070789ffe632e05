"""The preview from the lidar's track: whose slabs, for which plane, at which moment.

Detects a wind of the wrong plane or time, a track that is thrown away when it is lost, scans in the
wrong rhythm, an expectation of another slab, errors of places that are not small against a core.
"""

import numpy as np
import pytest

from lidar_mi.aircraft.state import AircraftState
from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.encounter.ahead.preview import WakeTracker
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import SyntheticLidar, encounter_keys

PERIOD, STRIDE = 0.1, 7.5


class Exact(SyntheticLidar):
    """Keeps what was expected of each slab."""

    def __init__(self, wake, **options):
        super().__init__(wake, **options)
        self.expected = []

    def step(self, t, pose=None, expected=None):
        self.expected.append(expected)
        return super().step(t, pose, expected)


def tracked(lidar, until, latest=np.inf):
    """The tracker of an aircraft on its nominal path, up to a time."""
    tracker = WakeTracker(lidar, PERIOD, STRIDE, latest)
    for time in np.arange(0, until + 1e-9, 0.01):
        tracker.update(AircraftState(time=float(time), x=75 * float(time)))
    return tracker


@pytest.fixture(scope="module")
def wake():
    return wake_along_path(check(encounter_keys(), "test"))


def test_wind_is_that_of_the_plane_at_the_time_of_arrival(wake):
    """2 s later, vortices have sunk by 3 m; noise of the places is 0.15 m."""
    tracker = tracked(Exact(wake), 1.6)
    for x in (100.0, 140.0, 160.0):
        time = x / 75
        y, z = np.linspace(-30, 30, 61), np.full(61, 1.0)
        _, v, w = tracker.wind(np.full(61, x), y, z, time)
        _, true_v, true_w = wake.wind(np.full(61, x), y, z, time)
        strength = np.sqrt(np.mean(true_v**2 + true_w**2))
        assert np.sqrt(np.mean((v - true_v) ** 2 + (w - true_w) ** 2)) < 0.1 * strength
        # the wind when the slab was seen is another
        _, early_v, early_w = tracker.wind(np.full(61, x), y, z, time - 1.5)
        assert np.sqrt(np.mean((early_v - true_v) ** 2 + (early_w - true_w) ** 2)) > 0.1 * strength


def test_scans_keep_their_rhythm(wake):
    lidar = Exact(wake)
    tracker = tracked(lidar, 1.0, latest=0.65)
    assert lidar.steps == pytest.approx(PERIOD * np.arange(7))
    # all scans but those that were not delivered yet
    assert len(tracker.slabs) == 7 and tracker.slabs[0].track is None


def test_next_slab_is_expected_where_it_is(wake):
    lidar = Exact(wake)
    tracked(lidar, 1.2)
    assert lidar.expected[0] is None and lidar.expected[1] is None
    number = 12
    x, time = STRIDE * (number - 1) + 75, (number - 0.5) * PERIOD
    truth = wake.vortices(x, time)
    pair = lidar.expected[number]
    stderr = np.sqrt(np.diagonal(pair.covariance))
    for k, one in ((2, truth[0].y), (3, truth[0].z), (6, truth[1].y), (7, truth[1].z)):
        assert abs(pair.parameters[k] - one) < 4 * stderr[k] < 2


def test_lost_track_is_good_for_what_it_saw(wake):
    """Slabs up to 75 + 9 x 7.5 m are seen; then the lidar is blind, and then it sees again."""
    tracker = tracked(Exact(wake, blind=lambda number: number > 10), 2.5)
    assert tracker.track is not None and tracker.track.lost
    assert tracker.covers(75 + 9 * 7.5) and not tracker.covers(75 + 18 * 7.5 + 1)
    again = tracked(Exact(wake, blind=lambda number: 10 < number < 17), 2.5)
    assert not again.track.lost and again.covers(75 + 22 * 7.5)
    x = 75 + 5 * 7.5
    there = [np.atleast_1d(a) for a in (x, 5.0, 0.0)]
    assert np.allclose(again.wind(*there, x / 75), tracker.wind(*there, x / 75))


def test_an_upset_aircraft_does_not_look(wake):
    lidar = Exact(wake)
    WakeTracker(lidar, PERIOD, STRIDE).update(AircraftState(time=0.5, x=40.0, departed=True))
    assert lidar.steps == []


def test_wind_of_many_planes_and_times_is_that_of_each(wake):
    """Against the parameters that the track states for one plane and one time."""
    tracker = tracked(Exact(wake), 1.6)
    x, time = np.array([100.0, 140.0, 215.0])[:, None], np.array([1.4, 1.9, 2.8])[:, None]
    y, z = np.linspace(-20, 20, 9), np.zeros(9)
    found = np.stack(tracker.wind(x, y, z, time))
    assert found.shape == (3, 3, 9)
    for k in range(3):
        pair = tracker.track.pair_at(float(x[k, 0]), float(time[k, 0]))
        expected = velocity((pair.port, pair.starboard), y, z)
        for a, b, mean in zip(found[1:, k], expected, pair.mean_wind, strict=True):
            np.testing.assert_allclose(a, b + mean, atol=1e-9)
