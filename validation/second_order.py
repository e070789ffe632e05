"""Light scattered twice in a homogeneous slab, by quadrature in double precision.

It is independent of the plugins: a pencil beam, a telescope of finite size and its field of view,
whose light of order two is an integral in six dimensions. Coordinates are chosen such that the
integrand has no singularity, and Sobol' points make an error of about 1e-4 in a second.

The last vertex lies in the field of view at A + rho w, seen from a point A of the telescope. Its
volume element rho^2 d(rho) d(w) cancels the squared distance to the telescope. The first vertex
follows from the whole path L. With u, how much nearer the last vertex lies than the end of the
longest path in its direction, and h its distance from the beam, dL/(path slope) over the squared
distance of both vertices is 1 / (2 (u^2 + h^2 / 4)) du in narrow fields, so that u = h / 2 tan(t)
(equiangular, Kulla & Fajardo 2012, CGF 31(4)); the remaining 1 / h is cancelled by polar
coordinates about the beam. Nothing is approximated: these are coordinates only.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.stats.qmc


@dataclass(frozen=True)
class Bistatic:
    """A pencil beam, a telescope at the origin that looks along x, and a slab across x (m, rad).

    The phase function is Rayleigh (polarised) for ``asymmetry`` None, Henyey-Greenstein else.
    """

    extinction: float = 0.03
    albedo: float = 1.0
    asymmetry: float | None = 0.0
    slab: tuple[float, float] = (100.0, 150.0)
    gate: tuple[float, float] = (110.0, 120.0)
    aperture: float = 0.2
    fov_half: float = 1e-3
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)


def second_order(case: Bistatic, power: int = 19, seed: int = 0):
    """Stokes I and Q of order two over emitted energy, and d ln I / d ln(extinction).

    The laser is polarised along y, the axis of Q. ``2**power`` points, scrambled by ``seed``.
    """
    numbers = scipy.stats.qmc.Sobol(6, seed=seed).random_base2(power)
    total, count = np.zeros(3), 2**power
    for part in np.array_split(numbers, max(1, count >> 17)):
        total += _contributions(case, *part.T).sum(1)
    i, q, slope = total / count
    return i, q, slope / i


def _contributions(case, first, second, third, fourth, fifth, sixth):
    """Contributions to I, Q and dI/d ln(extinction), (3, n)."""
    start, beam = np.array(case.origin), np.array([1.0, *np.tan(case.tilt)])
    beam /= np.linalg.norm(beam)
    # evenly in radius: where the beam is out of view, the light falls as its inverse
    radius, turn = case.aperture * first, 2 * np.pi * second
    telescope = np.stack([np.zeros_like(turn), radius * np.cos(turn), radius * np.sin(turn)], -1)
    path = 2 * (case.gate[0] + (case.gate[1] - case.gate[0]) * third)
    weight = 2 * np.pi * case.aperture * radius * 2 * (case.gate[1] - case.gate[0])
    # the direction from the telescope, about that in which it sees the end of the beam
    offset = start - telescope
    reach = _closing(offset, beam, path)
    seen = offset + reach[:, None] * beam
    centre = seen[:, 1:] / seen[:, :1]
    angle, away, jacobian = _about(centre, math.tan(case.fov_half), fourth, fifth)
    slopes = centre + away[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    view = np.concatenate([np.ones((len(slopes), 1)), slopes], 1)
    cosine = 1 / np.linalg.norm(view, axis=1)
    view *= cosine[:, None]
    # slopes to solid angle, and the cosine at the aperture
    weight = weight * jacobian * cosine**4
    # the last vertex
    longest = _closing(-offset, view, path)
    half = 0.5 * away * reach
    nearest = case.slab[0] / view[:, 0]
    farthest = np.minimum(longest, case.slab[1] / view[:, 0])
    low, high = (np.arctan((longest - end) / half) for end in (farthest, nearest))
    t, jacobian = _turned(case, low, np.maximum(low, high), sixth)
    back = longest - half * np.tan(t)
    weight = weight * jacobian * half / np.cos(t) ** 2
    last = telescope + back[:, None] * view
    # the first one, from how much farther than the last it lies: it is often millimetres away
    straight = np.linalg.norm(last - start, axis=1)
    tilt = (last - start) / straight[:, None] - beam
    excess, bent = path - back - straight, 0.5 * (tilt**2).sum(1)
    beyond = (0.5 * excess**2 - straight**2 * bent) / (excess + straight * bent)
    vertex = start + (straight + beyond)[:, None] * beam
    between = straight[:, None] * tilt - beyond[:, None] * beam
    distance = np.linalg.norm(between, axis=1)
    between /= distance[:, None]
    inside = (vertex[:, 0] > case.slab[0]) & (vertex[:, 0] < case.slab[1]) & (back > nearest)
    # a vertex farther by ds lengthens the path by ds (1 - cosine to the last vertex)
    turned = between @ beam
    one_minus = 0.5 * ((between - beam) ** 2).sum(1)
    slope = np.where(turned > 0.5, one_minus, 1 - turned)
    scattering = case.albedo * case.extinction
    weight = np.where(inside, weight * scattering**2 / (distance**2 * slope), 0)
    depth = (vertex[:, 0] - case.slab[0]) / beam[0] + distance
    depth = case.extinction * (depth + (last[:, 0] - case.slab[0]) / view[:, 0])
    weight = weight * np.exp(-depth)
    i, q = _scattered(case, beam, between, -view)
    return weight * np.stack([i, q, i * (2 - depth)])


def _closing(offset, direction, path):
    """Length t of a flight with t + |offset + t direction| = path; goal at the origin."""
    dot = (offset * direction).sum(-1)
    return 0.5 * (path**2 - (offset**2).sum(-1)) / (path + dot)


def _about(centre, radius, fourth, fifth):
    """Polar coordinates of a disc about a point, and the inverse of their density.

    Azimuth and distance from ``centre`` of a place in the disc of a radius about 0, each uniform
    between its limits.
    """
    out = np.linalg.norm(centre, axis=1)
    towards = np.arctan2(-centre[:, 1], -centre[:, 0])
    widest = np.where(
        out > radius, np.arcsin(np.minimum(radius / np.maximum(out, radius), 1)), np.pi
    )
    angle = (2 * fourth - 1) * widest
    # along the ray to the disc's ends
    middle = out * np.cos(angle)
    chord = np.sqrt(np.maximum(radius**2 - (out * np.sin(angle)) ** 2, 0))
    least, most = np.maximum(middle - chord, 0), middle + chord
    away = least + (most - least) * fifth
    return towards + angle, away, 2 * widest * (most - least) * away


def _turned(case, low, high, number):
    """The angle t between two limits, and the inverse of its density.

    In narrow fields 2 t is the first scattering angle and the second one its supplement: t is drawn
    with the density of forward peaks at both ends, (w^2 + (2 t)^2)^(-3/2) in the lower half.
    """
    width = 1 - abs(case.asymmetry or 0)
    whole = 0.5 * np.pi / math.hypot(width, 0.5 * np.pi)

    def below(t):
        angle = 2 * np.minimum(t, 0.5 * np.pi - t)
        part = 0.5 * angle / np.hypot(width, angle) / whole
        return np.where(t < 0.25 * np.pi, part, 1 - part)

    least, most = below(low), below(high)
    place = least + (most - least) * number
    sine = 2 * whole * np.minimum(place, 1 - place)
    angle = width * sine / np.sqrt(1 - sine**2)
    density = width**2 / np.hypot(width, angle) ** 3 / whole
    return np.where(place < 0.5, angle, np.pi - angle) / 2, (most - least) / density


def _scattered(case, beam, between, back):
    """I and Q after two scatterings, per squared steradian."""
    if case.asymmetry is not None:
        g = case.asymmetry
        value = np.ones(len(back))
        for cosine in (between @ beam, (between * back).sum(1)):
            value = value * (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
        return value, 0 * value
    # electric fields: the projection across the direction, twice
    level = np.array([0.0, 1.0, 0.0])
    field = level - beam * (level @ beam)
    field = field / np.linalg.norm(field)
    for onward in (between, back):
        field = field - onward * (field * onward).sum(-1, keepdims=True)
    across = level - back * back[:, 1:2]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = (field * across).sum(1) ** 2
    i = (field**2).sum(1)
    return (3 / (8 * np.pi)) ** 2 * i, (3 / (8 * np.pi)) ** 2 * (2 * along - i)
