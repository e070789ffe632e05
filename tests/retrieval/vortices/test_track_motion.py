"""Motion of a pair from slab to slab against lines in space and against differences. Detects a
derivative that is off, a drift of the wrong sign, an oblique wake that sinks too slowly, random
walks that depend on the number of steps."""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.model import drift
from lidar_mi.retrieval.vortices.track_motion import (
    Wandering,
    advected,
    oblique_drift,
    unsteady,
    wandered,
)
from tests.support.flights import oblique
from tests.support.vortex_pairs import uneven, vector


def some_state():
    return np.array([*vector(*uneven(), mean=(1.0, -0.5)), 0.2, 0.05, 0.17, 0.08])


def test_lines_across_the_plane_drift_as_a_fit_does():
    state = some_state()
    state[10:] = 0
    for profile in ("lamb_oseen", "burnham_hallock"):
        got = oblique_drift(torch.as_tensor(state), profile)
        np.testing.assert_allclose(got, drift(torch.as_tensor(state[:10]), profile), rtol=1e-12)


@pytest.mark.parametrize("crossing, climb", [(0, 0), (10, -3), (45, 3), (70, 0)])
def test_oblique_lines_in_space(crossing, climb):
    """Where two lines that sink across their own axis cross another plane at another time.

    Small cores: the profile's departure from a line vortex is (3/47)^2 of the descent. Planes are
    exact; 3 s at 1.4 m/s leave 2 cm, and more where the core's ellipse is long.
    """
    truth = oblique(np.radians(crossing), np.radians(climb))
    slopes = (truth(1.0, 0.0) - truth(0.0, 0.0))[[2, 3, 6, 7]]
    state = np.concatenate([truth(0.0, 0.0), slopes])
    for dx, dt, tolerance in ((80.0, 0.0, 1e-9), (-80.0, 3.0, 0.06)):
        got, _, _ = advected(state, dx, dt, "burnham_hallock")
        np.testing.assert_allclose(got[:10], truth(dx, dt), atol=tolerance)


def test_derivatives_against_differences():
    state, step = some_state(), 1e-6
    _, along, later = advected(state, -40.0, 1.5, "lamb_oseen")
    differences = [
        advected(state + one, -40.0, 1.5, "lamb_oseen")[0]
        - advected(state - one, -40.0, 1.5, "lamb_oseen")[0]
        for one in step * np.eye(14)
    ]
    np.testing.assert_allclose(
        later @ along, np.transpose(differences) / (2 * step), rtol=1e-6, atol=1e-7
    )


def test_walks_do_not_depend_on_the_number_of_steps():
    state, wandering = some_state(), Wandering(circulation=0.01, dissipation=1e-3)
    _, move, _ = advected(state, 10.0, 0.0, "lamb_oseen")
    once, _ = wandered(state, 20.0, 0.0, wandering)
    half, _ = wandered(state, 10.0, 0.0, wandering)
    np.testing.assert_allclose(move @ half @ move.T + half, once, rtol=1e-12, atol=1e-15)
    for time in (1.0, -1.0):
        _, after = wandered(state, 0.0, time, wandering)
        # Kolmogorov: 6.5 epsilon t
        np.testing.assert_allclose(np.diagonal(after)[[8, 9]], 6.5e-3)
    # behind the slab the slopes displace the other way
    back, _ = wandered(state, -20.0, 0.0, wandering)
    assert back[2, 10] == -once[2, 10] < 0 and back[2, 2] == once[2, 2]


def test_steady_rates_grow_with_the_time():
    one, two = (np.diagonal(unsteady(some_state(), t, Wandering())) for t in (1.0, -2.0))
    np.testing.assert_allclose(two, 4 * one)
    assert one[0] == pytest.approx((0.01 * 300) ** 2) and one[3] == pytest.approx(0.035**2)
    bent = unsteady(some_state(), 2.0, Wandering(departure=0), np.array([0.1, 0.2]))
    assert bent[2, 6] == pytest.approx(0.04) and bent[3, 3] == pytest.approx(0.16)
    assert bent[2, 7] == 0


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_walk_of_no_length_is_refused(value):
    with pytest.raises(InputError, match=r"wandering\.slope"):
        Wandering(slope=value)
