"""The track of a pair over slabs. Detects a state that moves the wrong way, a fit that is used
though it must not be, a track that does not end."""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import first_track, updated

PAIR = np.array([400.0, 1.1, 23.5, 0.0, -400.0, 1.1, -23.5, 0.0, 1.0, 0.2])
SPREAD = np.array([8, 0.05, 0.2, 0.2, 8, 0.05, 0.2, 0.2, 0.05, 0.05])


def fit(parameters=PAIR, reasons=(), spread=SPREAD):
    return VortexPairFit(
        np.array(parameters), np.diag(spread**2), "lamb_oseen", 1.0, 0.9, 0.1, 5.0, reasons
    )


def test_fit_beyond_the_gate_is_rejected_and_a_lost_track_begins_anew():
    track = first_track(fit(), 0.0, 0.0)
    far = PAIR.copy()
    far[0] += 300
    for k in range(1, 6):
        track = updated(track, fit(far), 7.5 * k, 0.1 * k)
        assert (track.updates, track.rejected, track.missed) == (1, k, k)
        assert track.innovation[0] > 29.6
    assert track.lost and not track.pair_at(40.0, 1.0).success
    track = updated(track, fit(far), 45.0, 0.6)
    assert not track.lost and (track.updates, track.rejected) == (1, 0)
    np.testing.assert_allclose(track.pair_at(45.0, 0.6).parameters, far)


def test_time_that_runs_backwards_is_refused():
    with pytest.raises(InputError, match="time: 0 s is not allowed"):
        updated(first_track(fit(), 0.0, 0.1), fit(), 7.5, 0.0)
