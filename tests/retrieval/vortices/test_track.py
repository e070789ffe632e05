"""The track of a pair over slabs: physics tests on simulated flights, and what bad input gets.
Detect errors that are stated 10 % too small or too large, a state that moves the wrong way, a fit
that is used though it must not be, a track that does not end."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.track import TrackSettings, first_track, updated
from lidar_mi.retrieval.vortices.track_motion import STRAIGHT
from tests.support.flights import (
    ERROR,
    RATE,
    SPEED,
    fit,
    flights,
    oblique,
    times,
    tracks,
    vector,
    wakes_in_space,
    wakes_that_walk,
)

PAIR = vector((23.5, -23.5), (0.0, 0.0))
STEADY = TrackSettings(wandering=STRAIGHT)


def assert_chi_square(squares, freedom, draws=None):
    """Mean within 3 sigma, and the distribution by Kolmogorov and Smirnov."""
    squares = np.ravel(squares)
    sigma = np.sqrt(2 * freedom / len(squares))
    assert abs(squares.mean() - freedom) < 3 * sigma, (squares.mean(), freedom, sigma)
    assert kstest(squares, chi2(freedom).cdf).pvalue > 1e-3


def assert_coverage(departures, tolerance=0.05):
    for limit, expected in ((1, 0.683), (2, 0.954)):
        assert abs(np.mean(np.abs(departures) < limit) - expected) < tolerance


@pytest.mark.slow
def test_errors_hold_where_the_wake_walks_as_stated():
    """100 flights. Innovations and errors of state and of the pair at the wing are chi-square."""
    found = flights(100, wakes_that_walk)
    assert_chi_square(found["innovations"], 10)
    assert_chi_square(found["state"], 14)
    assert_chi_square(found["arrival"], 10)
    assert_coverage(found["departures"])
    assert sum(t.rejected for t in found["tracks"]) < 10


def test_errors_grow_of_the_kind_that_misfits():
    """Places that jump by five stated errors: of them and the slopes, not of circulations."""
    track = first_track(fit(PAIR, ERROR), 0.0, 0.0, STEADY)
    for k in range(1, 9):
        jump = np.zeros(10)
        jump[[2, 3, 6, 7]] = 5 * (-1) ** k * np.sqrt(np.diagonal(ERROR)[[2, 3, 6, 7]])
        track = updated(track, fit(PAIR + jump, ERROR), 7.5 * k, 0.1 * k)
    places = [2, 3, 6, 7, 10, 11, 12, 13]
    others = np.delete(np.arange(14), places)
    assert (track.inflation[places] > 5).all() and (track.inflation[others] == 1).all()
    near = track.pair_at(track.x, track.time).covariance
    np.testing.assert_allclose(near[0, 0], track.covariance[0, 0])
    np.testing.assert_allclose(near[2, 2], track.inflation[2] * track.covariance[2, 2])


@pytest.mark.slow
def test_strongly_bent_wake_shows():
    """Crow waves of a fifth of the separation: nine of ten errors at the wing below two stated
    ones, and in most flights the innovations or rejected fits show that the wake is bent."""
    found = flights(40, wakes_in_space(crow=10.0, crossing=np.radians(10)))
    assert np.mean(np.abs(found["departures"]) < 2) > 0.85
    shown = [t.inflation.max() > 1 or t.rejected > 0 or len(t.slabs) < 16 for t in found["tracks"]]
    assert np.mean(shown) > 0.5


def test_five_slabs_of_an_oblique_wake():
    """What control needs after half a second: circulation to 5 %, cores to 0.5 m."""
    truth = oblique(0.17, -0.05)
    random = np.random.default_rng(2)
    x, t = times(5)
    for _ in range(20):
        last = tracks(random, [truth(*at) for at in zip(x, t, strict=True)])[-1]
        assert last.usable and last.updates == 5
        departure = last.state[:10] - truth(x[-1], t[-1])
        assert np.abs(departure[[0, 4]]).max() < 0.05 * 400
        assert np.abs(departure[[2, 3, 6, 7]]).max() < 0.5


def batch(pairs, x, t, settings):
    """Least squares of all fits at once, of the state in the last slab, by `scipy`."""
    prior = first_track(pairs[0], x[0], t[0], settings)
    roots = [np.linalg.inv(np.linalg.cholesky(pair.covariance)) for pair in pairs]
    first = np.linalg.inv(np.linalg.cholesky(prior.covariance))

    def forward(state, dx, dt):
        """In complex numbers, across the plane: slopes are small."""
        state = state.copy()
        state[[2, 3, 6, 7]] += dx * state[10:]
        apart = state[2] - state[6] + 1j * (state[3] - state[7])
        cores = [np.exp(2 * state[k]) for k in (1, 5)]
        spin = state[4] / (abs(apart) ** 2 + cores[1]) - state[0] / (abs(apart) ** 2 + cores[0])
        speed = state[8] + 1j * state[9] + 1j * spin * apart / (4 * np.pi)
        state[[2, 6]] += dt * speed.real
        state[[3, 7]] += dt * speed.imag
        return state

    def residuals(state):
        parts = [first @ (state - prior.state)]
        for pair, root, at, when in list(zip(pairs, roots, x, t, strict=True))[1:]:
            parts.append(root @ (forward(state, at - x[0], when - t[0])[:10] - pair.parameters))
        return np.concatenate(parts)

    found = least_squares(residuals, prior.state, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    return found.x, np.linalg.inv(found.jac.T @ found.jac), forward


@pytest.mark.parametrize("step, tolerance", [(1e-9, 1e-5), (0.1, 0.03)])
def test_of_a_straight_wake_it_is_the_batch_estimate(step, tolerance):
    """Without drift the problem is linear: equal to rounding (of differences, in the batch). With
    drift equal to a few hundredths of a standard error. Before the first slab and at its time, by
    the smoother, as well as in the newest."""
    random, settings = np.random.default_rng(4), replace(STEADY, gate=0.999999)
    truth = oblique(0.02, -0.01)
    x, t = 7.5 * np.arange(8), step * np.arange(8)
    drawn = [random.multivariate_normal(truth(*at), ERROR) for at in zip(x, t, strict=True)]
    pairs = [fit(one, ERROR) for one in drawn]
    track = first_track(pairs[0], x[0], t[0], settings)
    for pair, at, when in zip(pairs[1:], x[1:], t[1:], strict=True):
        track = updated(track, pair, at, when)
    assert track.updates == 8
    state, covariance, forward = batch(pairs, x, t, settings)
    spread = np.sqrt(np.diagonal(covariance))
    got = track.pair_at(0.0, 0.0)
    assert np.abs((got.parameters - state[:10]) / spread[:10]).max() < tolerance
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(got.covariance)), spread[:10], rtol=max(tolerance / 10, 1e-6)
    )
    newest = forward(state, x[-1], t[-1])
    spread = np.sqrt(np.diagonal(track.covariance))
    assert np.abs((track.state - newest) / spread).max() < tolerance


def test_pair_between_and_beyond_slabs():
    """Of an exact oblique wake: in any plane at any time, errors growing away from the slabs."""
    truth = oblique(0.17, -0.05)
    x, t = times(15, -50.0)
    exact = [truth(*at) for at in zip(x, t, strict=True)]
    track = first_track(fit(exact[0], ERROR), x[0], t[0])
    for one, at, when in zip(exact[1:], x[1:], t[1:], strict=True):
        track = updated(track, fit(one, ERROR), at, when)
    for at, when in ((-23.0, 2.0), (200.0, 1.4), (-120.0, 3.0), (x[-1], t[-1])):
        np.testing.assert_allclose(track.pair_at(at, when).parameters, truth(at, when), atol=0.05)
    spread = [np.sqrt(track.pair_at(at, 1.4).covariance[2, 2]) for at in (0.0, 60.0, 100.0, 200.0)]
    assert spread[0] < spread[1] < spread[2] < spread[3]
    # smoothed behind, filtered in the newest slab
    assert spread[0] < np.sqrt(track.covariance[2, 2])
    newest = track.pair_at(x[-1], t[-1])
    np.testing.assert_allclose(newest.covariance, track.covariance[:10, :10], atol=1e-12)
    assert newest.success and newest.model_error == 0.1


def test_fit_beyond_the_gate_is_rejected_and_a_lost_track_begins_anew():
    track = first_track(fit(PAIR, ERROR), 0.0, 0.0)
    far = PAIR + 300 * np.eye(10)[0]
    for k in range(1, 6):
        track = updated(track, fit(far, ERROR), 7.5 * k, 0.1 * k)
        assert (track.updates, track.rejected, track.missed) == (1, k, k)
        assert track.innovation[0] > 29.6 and track.innovation[1] == 10
    assert track.inflation.max() > 2 and track.lost and not track.usable
    assert track.pair_at(40.0, 1.0).reasons == ("no update in 5 slabs",)
    assert updated(track, None, 45.0, 0.6).lost
    track = updated(track, fit(far, ERROR), 45.0, 0.6)
    assert not track.lost and (track.updates, track.rejected) == (1, 0)
    np.testing.assert_allclose(track.pair_at(45.0, 0.6).parameters, far)


@pytest.mark.parametrize(
    "pair, rejected",
    [
        (None, 0),
        (fit(PAIR, ERROR, ("did not converge",)), 0),
        (fit(PAIR * np.nan, ERROR), 0),
        (fit(PAIR, ERROR * np.nan), 0),
        (fit(PAIR, np.zeros((10, 10))), 0),
        (fit(PAIR, -ERROR), 0),
        (fit(PAIR[[4, 5, 6, 7, 0, 1, 2, 3, 8, 9]], ERROR * 1e6), 1),
    ],
)
def test_fit_that_is_none_only_predicts(pair, rejected):
    before = first_track(fit(PAIR, ERROR), 0.0, 0.0)
    track = updated(before, pair, 7.5, 0.1)
    assert (track.updates, track.rejected, track.missed) == (1, rejected, 1)
    assert (np.diagonal(track.covariance) >= np.diagonal(before.covariance)).all()
    # the pair's drift: 0.1 s of the wind along y, and of the wind less the descent along z
    descent = 400 * 47 / (47**2 + 9) / (2 * np.pi)
    np.testing.assert_allclose(track.state[2:4], [23.6, 0.1 * (0.3 - descent)], rtol=1e-9)
    if pair is not None and not rejected:
        with pytest.raises(InputError, match="pair: "):
            first_track(pair, 0.0, 0.0)


def test_usable_when_certain():
    settings = TrackSettings(least_updates=2)
    track = first_track(fit(PAIR, ERROR), 0.0, 0.0, settings)
    assert not track.usable
    assert updated(track, fit(track.state[:10], ERROR), 7.5, 0.1).usable
    for index, error in ((0, 50.0), (7, 1.5)):
        wide = ERROR + error**2 * np.diag(np.eye(10)[index])
        track = first_track(fit(PAIR, wide), 0.0, 0.0, settings)
        track = updated(track, fit(track.state[:10], wide), 7.5, 0.1)
        assert track.updates == 2 and track.usable == (index == 0 and error < 40 * np.sqrt(2))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda track: updated(track, None, 7.5, 0.1), r"time: 0\.1 s is not allowed; the last"),
        (lambda track: updated(track, None, 7.5, 0.0), r"time: 0 s is not allowed; the last"),
        (lambda track: updated(track, None, np.nan, 0.2), "x: nan is not allowed"),
        (lambda track: track.pair_at(0.0, np.inf), "time: inf is not allowed"),
        (
            lambda track: updated(track, replace(fit(PAIR, ERROR), profile="lamb_oseen"), 7.5, 0.2),
            "'lamb_oseen' is not that of the track",
        ),
        (
            lambda track: first_track(fit(PAIR[[4, 5, 6, 7, 0, 1, 2, 3, 8, 9]], ERROR), 0.0, 0.0),
            "circulations of -400 ",
        ),
        (lambda track: TrackSettings(gate=1.0), r"track\.gate: 1\.0 is not allowed"),
        (lambda track: TrackSettings(patience=0), r"track\.patience: 0 is not allowed"),
        (lambda track: TrackSettings(slope=-1.0), r"track\.slope: -1\.0 is not allowed"),
    ],
)
def test_bad_input_gets_one_line(call, message):
    track = first_track(fit(PAIR, ERROR), 0.0, 0.1)
    with pytest.raises(InputError, match=message):
        call(track)


def test_memory_is_bounded_and_an_update_is_fast():
    track = first_track(fit(PAIR, ERROR), 0.0, 0.0, TrackSettings(memory=30, wandering=STRAIGHT))
    begin = time.process_time()
    for k in range(1, 41):
        truth = updated(track, None, 7.5 * k, 0.1 * k).state[:10]
        track = updated(track, fit(truth, ERROR), 7.5 * k, 0.1 * k)
    # two moves a step; 5 ms are allowed for one, and other programs may slow it
    assert (time.process_time() - begin) / 40 < 2 * 0.005 * 3
    assert len(track.slabs) == 30 and SPEED / RATE * 40 == track.x


@pytest.mark.parametrize("length", [1e6, 20.0, 0.0])
def test_an_error_that_slabs_share_does_not_average_out(length):
    """The variance of the mean of n errors, half of which are a Gauss-Markov process along x.

    Generalised least squares: 1 / sum of the inverse covariance.
    """
    number, part, track = 10, 0.5, None
    for x, at in zip(*times(number), strict=True):
        pair = replace(fit(oblique()(x, at), ERROR), shared=part * ERROR, shared_length=length)
        track = updated(track, pair, x, at) if track else first_track(pair, x, at, STEADY)
    along = times(number)[0]
    lag = np.abs(np.subtract.outer(along, along))
    together = np.exp(-lag / length) if length else np.eye(number)
    expected = 1 / np.linalg.inv(part * together + (1 - part) * np.eye(number)).sum()
    got = np.diagonal(track.covariance)[[0, 4]] / np.diagonal(ERROR)[[0, 4]]
    # places have slopes as well, and their errors correlate with those of the circulations
    np.testing.assert_allclose(got, expected, rtol=0.05)
