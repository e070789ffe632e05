"""An independent analog simulation of a lidar over a homogeneous slab, in plain numpy.

It is independent of the plugins: float64, its own Stokes algebra with explicit reference axes,
free flights from the exponential law, every collision connected to a random telescope point.
Geometry: telescope at the origin looking along x, slab between two planes, vacuum around it.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Case:
    """A dense slab (m, m^-1, radians); the phase function is Rayleigh or Henyey-Greenstein (g)."""

    extinction: float = 0.02
    albedo: float = 1.0
    asymmetry: float | None = None  # None: Rayleigh, polarised
    slab: tuple[float, float] = (500.0, 600.0)
    beam_radius: float = 0.1
    divergence_half: float = 1e-3
    aperture: float = 0.5
    fov_half: float = 50e-3
    gates: tuple[float, ...] = tuple(np.arange(500.0, 601.0, 10.0))


def simulate(case: Case, samples: int, max_order: int, seed: int):
    """Received Stokes (I, Q about the horizontal axis) over emitted energy.

    Returns
    -------
    mean, error : (gates, orders, 2) and (gates, 2) arrays
        Order by order, and the standard error of the sum over orders of each sample.
    """
    rng = np.random.default_rng(seed)
    gates = len(case.gates) - 1
    mean, total, square = np.zeros((gates, max_order, 2)), 0.0, np.zeros((gates, 2))
    for start in range(0, samples, 250_000):
        batch = min(250_000, samples - start)
        received = np.zeros((batch, gates, 2))
        for order, sample, gate, stokes in _histories(case, batch, max_order, rng):
            np.add.at(received, (sample, gate), stokes)
            np.add.at(mean[:, order], gate, stokes)
        total = total + received.sum(0)
        square += (received**2).sum(0)
    mean /= samples
    variance = square / samples - (total / samples) ** 2
    return mean, np.sqrt(variance / samples)


def _histories(case, count, max_order, rng):
    """Yield (order, samples, gates, Stokes I and Q) for every connection in view."""
    radius = case.beam_radius * np.sqrt(-0.5 * np.log(1 - rng.random(count)))
    turn = 2 * np.pi * rng.random(count)
    position = np.stack([np.zeros(count), radius * np.cos(turn), radius * np.sin(turn)], 1)
    tangent = case.divergence_half * np.sqrt(-0.5 * np.log(1 - rng.random(count)))
    turn = 2 * np.pi * rng.random(count)
    direction = _unit(np.stack([np.ones(count), tangent * np.cos(turn), tangent * np.sin(turn)], 1))
    axis = _across(np.broadcast_to([0.0, 1.0, 0.0], direction.shape), direction)
    stokes = np.zeros((count, 4))
    stokes[:, :2] = 1.0
    radius, turn = case.aperture * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    telescope = np.stack([np.zeros(count), radius * np.cos(turn), radius * np.sin(turn)], 1)
    area = np.pi * case.aperture**2
    # free flights count only inside the slab: start at its face
    path = (case.slab[0] - position[:, 0]) / direction[:, 0]
    position = position + direction * path[:, None]
    number = np.arange(count)
    for order in range(max_order):
        flight = -np.log(1 - rng.random(len(path))) / case.extinction
        position = position + direction * flight[:, None]
        path = path + flight
        inside = (position[:, 0] > case.slab[0]) & (position[:, 0] < case.slab[1])
        inside &= path < 2 * case.gates[-1]
        position, direction, axis, stokes, path, telescope, number = (
            a[inside] for a in (position, direction, axis, stokes, path, telescope, number)
        )
        stokes = stokes * case.albedo
        back = telescope - position
        distance = np.linalg.norm(back, axis=1)
        back = back / distance[:, None]
        gate = np.searchsorted(case.gates, 0.5 * (path + distance), side="right") - 1
        in_view = (gate >= 0) & (gate < len(case.gates) - 1) & (-back[:, 0] > np.cos(case.fov_half))
        through = (position[:, 0] - case.slab[0]) / -back[:, 0]
        weight = area * -back[:, 0] / distance**2 * np.exp(-case.extinction * through)
        received, arrived = _scatter(case, stokes, axis, direction, back)
        level = _across(np.broadcast_to([0.0, 1.0, 0.0], back.shape), back)
        received = _turn(received, arrived, level, back) * weight[:, None]
        yield order, number[in_view], gate[in_view], received[in_view, :2]
        onward, density = _sample(case, direction, rng)
        stokes, axis = _scatter(case, stokes, axis, direction, onward)
        stokes = stokes / density[:, None]
        direction = onward


def _density(case, cosine):
    """Phase function of natural light, per steradian."""
    if case.asymmetry is None:
        return 3 / (16 * np.pi) * (1 + cosine**2)
    g = case.asymmetry
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def _sample(case, direction, rng):
    """Directions by rejection (Rayleigh) or inversion (Henyey-Greenstein), and their density."""
    n = len(direction)
    if case.asymmetry is None:
        cosine = 2 * rng.random(n) - 1
        redo = np.flatnonzero(rng.random(n) > (1 + cosine**2) / 2)
        while len(redo):
            cosine[redo] = 2 * rng.random(len(redo)) - 1
            redo = redo[rng.random(len(redo)) > (1 + cosine[redo] ** 2) / 2]
    else:
        g = case.asymmetry
        cosine = (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * rng.random(n))) ** 2) / (2 * g)
    sine = np.sqrt(np.maximum(0, 1 - cosine**2))
    turn = 2 * np.pi * rng.random(n)
    helper = np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = _across(helper, direction)
    second = np.cross(direction, first)
    onward = (
        cosine[:, None] * direction
        + (sine * np.cos(turn))[:, None] * first
        + (sine * np.sin(turn))[:, None] * second
    )
    return _unit(onward), _density(case, cosine)


def _scatter(case, stokes, axis, direction, onward):
    """Stokes vectors (per steradian) after scattering, and their axes (in the scattering plane)."""
    cosine = (direction * onward).sum(1)
    normal = np.cross(direction, onward)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-12, normal / np.maximum(length, 1e-300), axis)
    plane_in, plane_out = np.cross(normal, direction), np.cross(normal, onward)
    if case.asymmetry is not None:
        out = np.zeros_like(stokes)
        out[:, 0] = stokes[:, 0] * _density(case, cosine)
        return out, plane_out
    i, q, u, v = _turn(stokes, axis, plane_in, direction).T
    scale = 3 / (16 * np.pi)
    even, odd = scale * (1 + cosine**2), -scale * (1 - cosine**2)
    out = [even * i + odd * q, odd * i + even * q, 2 * scale * cosine * u, 2 * scale * cosine * v]
    return np.stack(out, 1), plane_out


def _turn(stokes, axis, target, direction):
    """Refer Stokes vectors to another axis: rotation by the angle from axis to target."""
    cosine = (axis * target).sum(1)
    sine = (np.cross(axis, target) * direction).sum(1)
    angle = 2 * np.arctan2(sine, cosine)
    i, q, u, v = stokes.T
    return np.stack(
        [i, np.cos(angle) * q + np.sin(angle) * u, np.cos(angle) * u - np.sin(angle) * q, v], 1
    )


def _across(vector, direction):
    return _unit(vector - direction * (vector * direction).sum(1, keepdims=True))


def _unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
