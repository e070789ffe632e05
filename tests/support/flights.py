"""Flights past a wake for the tests of the track: truths that are not the filter's own model, fits
with the errors of a least-squares fit of wind vectors."""

import numpy as np

from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import first_track, updated
from lidar_mi.retrieval.vortices.track_motion import Wandering

SPEED, RATE = 75.0, 10.0
"""Of the aircraft, m/s, and slabs a second."""
AHEAD = 2.0
"""Time of flight to the newest slab, s."""
CIRCULATION, SEPARATION, RADIUS = 400.0, 47.1, 3.0
WIND = (1.0, 0.3)


def vector(y, z, circulation=CIRCULATION, radius=RADIUS, wind=WIND):
    """Parameters (10,) of a port and a starboard vortex at y (2,) and z (2,)."""
    rows = [[s * circulation, np.log(radius), *at] for s, *at in zip((1, -1), y, z, strict=True)]
    return np.array([*np.ravel(rows), *wind])


def oblique(crossing=0.0, climb=0.0, crow=0.0, decay_time=np.inf, phase=0.0):
    """Parameters of two lines in space as a function of x and time, by geometry alone.

    Angles in rad; both lines are displaced by ``crow`` (m) times a sine along the axis, at 45
    degrees, outward and up. They sink, across their axis, by the velocity of two line vortices, and
    pass the path's origin at time 0.
    """
    c, s = np.cos(crossing), np.sin(crossing)
    axis = np.array([c * np.cos(climb), s, -c * np.sin(climb)])
    left = np.array([-s * np.cos(climb), c, s * np.sin(climb)])
    up = np.cross(axis, left)
    number = 2 * np.pi / (8.6 * SEPARATION)

    def truth(x, time):
        steady = np.isinf(decay_time)
        fraction = 1.0 if steady else np.exp(-time / decay_time)
        sunk = CIRCULATION / (2 * np.pi * SEPARATION)
        sunk *= time if steady else decay_time * (1 - fraction)
        centre = np.array([0.0, *WIND]) * time - sunk * up
        places = []
        for side in (1, -1):
            start = centre + side * SEPARATION / 2 * left
            along = (x - start[0]) / axis[0]
            bent = crow * np.sin(number * along + phase) * (side * left + up) / np.sqrt(2)
            # the displaced line crosses the plane a little earlier or later
            along -= bent[0] / axis[0]
            places.append((start + along * axis + bent)[1:])
        radius = RADIUS / np.sqrt(axis[0])
        return vector(*np.transpose(places), fraction * CIRCULATION, radius)

    return truth


def walking(random, wandering, length, stride=SPEED / RATE, steps=2):
    """Parameters slab by slab, and in the planes of the slabs at any later time.

    Steps shorter than the slabs, each along the path and in time by the standard deviations of
    ``wandering``, the drift that of two line vortices in complex numbers.
    """
    state, slopes = vector((23.5, -23.5), (0.0, 0.0)), random.normal(0, 0.01, 4)
    slopes += np.tile(random.normal(0, 0.1, 2), 2)
    rate = random.normal(0, wandering.decay)
    own = random.normal(0, wandering.departure, 4)
    places, circulations = [2, 3, 6, 7], [0, 4]
    turbulence = 8 / 3 * (50 * wandering.dissipation) ** (2 / 3) / 50

    def later(state, dt):
        state = state.copy()
        state[8:10] += random.normal(0, np.sqrt(6.5 * wandering.dissipation * dt), 2)
        state[circulations] *= 1 - rate * dt
        port, starboard = state[2] + 1j * state[3], state[6] + 1j * state[7]
        # v - i w of a line at distance: Gamma / (2 pi i distance)
        conjugate = (state[4] - state[0]) / 2 / (2j * np.pi * (port - starboard))
        state[places] += dt * own
        state[[2, 6]] += dt * (conjugate.real + state[8])
        state[[3, 7]] += dt * (-conjugate.imag + state[9])
        return state

    found = [(state, slopes)]
    for _ in range(length - 1):
        state = state.copy()
        for _ in range(steps):
            dx = stride / steps
            root = np.sqrt(dx)
            new = slopes + random.normal(0, wandering.slope * root, 4)
            state[places] += dx * (slopes + new) / 2
            # what a walk with straight pieces lacks of its integral
            state[places] += random.normal(0, wandering.slope * root**3 / np.sqrt(12), 4)
            state[places] += random.normal(0, wandering.place * root, 4)
            state[circulations] *= 1 + random.normal(0, wandering.circulation * root, 2)
            state[[1, 5]] += random.normal(0, wandering.log_radius * root, 2)
            state[8:10] += random.normal(0, np.sqrt(turbulence * dx), 2)
            slopes = new
            state = later(state, dx / SPEED)
        found.append((state, slopes))
    return found, later


def errors_of_a_fit(noise=1.5):
    """Covariance (10, 10) of a least-squares fit to vectors on a 3 m grid with white noise, m/s.

    Derivatives by finite differences of the Burnham-Hallock pair.
    """
    y, z = np.meshgrid(np.arange(-54.0, 55, 3), np.arange(-34.0, 35, 3))

    def wind(theta):
        speed = (theta[8] + 1j * theta[9]) * np.ones(y.shape, complex)
        for first in (0, 4):
            circulation, log_radius, at_y, at_z = theta[first : first + 4]
            away = y - at_y + 1j * (z - at_z)
            speed += (
                1j * circulation / (2 * np.pi) * away / (abs(away) ** 2 + np.exp(2 * log_radius))
            )
        return np.concatenate([speed.real.ravel(), speed.imag.ravel()])

    theta = vector((23.5, -23.5), (0.0, 0.0))
    steps = 1e-5 * np.eye(10)
    slopes = np.array([(wind(theta + step) - wind(theta - step)) / 2e-5 for step in steps])
    return noise**2 * np.linalg.inv(slopes @ slopes.T)


def fit(parameters, covariance, reasons=()):
    return VortexPairFit(
        np.array(parameters), covariance, "burnham_hallock", 1.0, 0.9, 0.1, 5.0, reasons
    )


def times(number, start=0.0):
    """Planes and times of slabs, from ``start`` m on."""
    index = np.arange(number)
    return start + SPEED / RATE * index, index / RATE


ERROR = errors_of_a_fit()
"""Covariance of the fits that `drawn` makes."""


def drawn(random, truths):
    """Fits that scatter about the truths (10,) of slabs with `ERROR`."""
    return [fit(random.multivariate_normal(truth, ERROR), ERROR) for truth in truths]


def tracks(random, truths, start=0.0, settings=None, measure=drawn):
    """The track after each slab."""
    x, t = times(len(truths), start)
    pairs = measure(random, truths)
    found = [first_track(pairs[0], x[0], t[0], settings)]
    for pair, at, time in zip(pairs[1:], x[1:], t[1:], strict=True):
        found.append(updated(found[-1], pair, at, time))
    return found


def normalised(departure, covariance):
    """Square of a departure in units of its covariance."""
    return float(departure @ np.linalg.solve(covariance, departure))


def arrival(track):
    """Plane of the slab that the wing meets next, and when; of a young track, of its first."""
    slab = track.slabs[-min(round(0.75 * AHEAD * RATE), len(track.slabs))]
    return slab.x, slab.time + AHEAD


def flights(number, make, settings=None, seed=11, length=16, measure=drawn):
    """What a number of flights left.

    Parameters
    ----------
    make : callable
        Of a generator and a number of slabs: the truths in the slabs, the state at the end, a
        function of the last track that gives the truth at the wing, and where the slabs begin.
    measure : callable
        Of a generator and truths: fits.

    Returns
    -------
    dict
        Squares of the innovations, of the errors of the last state and of the pair at the wing,
        each normalised; departures of the latter over their stated errors; the last tracks.
    """
    random = np.random.default_rng(seed)
    found = {"innovations": [], "state": [], "arrival": [], "departures": [], "tracks": []}
    for _ in range(number):
        truths, at_end, at_arrival, start = make(random, length)
        every = tracks(random, truths, start, settings, measure)
        last = every[-1]
        found["tracks"].append(last)
        # that of the second slab is the prior's of the slopes, which are no draw from it
        found["innovations"] += [t.innovation[0] for t in every[2:] if t.innovation]
        size = len(at_end)
        found["state"].append(normalised(at_end - last.state[:size], last.covariance[:size, :size]))
        pair = last.pair_at(*arrival(last))
        departure = at_arrival(last) - pair.parameters
        found["arrival"].append(normalised(departure, pair.covariance))
        found["departures"].append(departure / np.sqrt(np.diagonal(pair.covariance)))
    return found


def wakes_in_space(**properties):
    """Flights past straight or deformed lines, of a random phase and place along the path."""

    def make(random, length):
        truth = oblique(phase=random.uniform(0, 2 * np.pi), **properties)
        start = random.uniform(-150, 0)
        x, t = times(length, start)
        truths = [truth(*at) for at in zip(x, t, strict=True)]
        return truths, truths[-1], lambda track: truth(*arrival(track)), start

    return make


def wakes_that_walk(random, length):
    states, later = walking(random, Wandering(), length)

    def at_arrival(track):
        state = states[-round(0.75 * AHEAD * RATE)][0]
        for _ in range(20):
            state = later(state, AHEAD / 20)
        return state

    return [state for state, _ in states], np.concatenate(states[-1]), at_arrival, 0.0
