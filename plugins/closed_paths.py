"""Geometry of paths that must close: the excess length of a path at a vertex, and its use.

With the telescope at the distance h and a remaining path l, up to the telescope, the *excess
length* is l - h: the remaining path less the straight distance. A flight at the angle theta from
the direction away from the telescope consumes part of it, far from the telescope 1 + cos(theta)
times its length. The ends of all flights that consume the same part lie on an ellipsoid whose foci
are the vertex and the telescope point.

In air of uniform extinction the contribution of a direction is proportional to d(length)/d(excess),
about 1 / (1 + cos(theta)): flights towards the telescope contribute by far the most.
`OpenPath.sample` draws such directions.
"""

import drjit as dr
import mitsuba as mi

from .polarization import level_frame
from .variant_types import Float, Point, Vector

# of the components of the sum of two unit vectors in single precision
ROUNDING = 4e-7
# m, of what is divided by
TINY = 1e-30


class OpenPath:
    """The remaining part of a path at a vertex, before it is closed.

    Parameters
    ----------
    away : direction from the telescope point to the vertex.
    distance : between them, m.
    excess : length of the remaining path less the distance, m.
    field : tangent of half the widest angle, as seen from the telescope, between the vertex and
        anything in the field of view.
    reach : how far towards the telescope there may be any air, m.
    """

    def __init__(
        self, away: Vector, distance: Float, excess: Float, field: Float, reach: Float
    ) -> None:
        self.away, self.distance, self.excess = away, distance, excess
        self.field, self.reach = field, reach

    def widened(self, factor: float) -> "OpenPath":
        """The same with a wider field."""
        return OpenPath(self.away, self.distance, self.excess, factor * self.field, self.reach)

    def one_plus_cosine(self, direction: Vector) -> Float:
        """1 + cos(theta), exact where it is small."""
        # as 1 + cos(theta) of a scalar product it would be rounding alone, near the telescope
        return 0.5 * dr.squared_norm(self.away + direction)

    def leg(self, used: Float, one_plus_cosine: Float) -> Float:
        """Length of a flight that consumes ``used`` of the excess length."""
        return used * (0.5 * used + self.distance) / (used + self.distance * one_plus_cosine)

    def remaining(self, direction: Vector, gap: Float, whole: Float) -> Float:
        """Excess length after a flight that ends ``gap`` before it would close the path.

        ``whole`` is the length of the flight that closes it.
        """
        return shortened(self.away * self.distance + direction * whole, direction, gap)

    def from_telescope(self, direction: Vector) -> Vector:
        """Direction from the vertex to where one from the telescope closes the path."""
        one_plus_cosine = 0.5 * dr.squared_norm(direction - self.away)
        consumed = self.excess + self.distance * one_plus_cosine
        # how much farther from the telescope the path closes than the vertex lies, as one fraction:
        # a difference of both distances would cancel
        beyond = 0.5 * dr.square(self.excess) - dr.square(self.distance) * one_plus_cosine
        across = self.distance * (direction - self.away)
        return dr.normalize(direction * (beyond / consumed) + across)

    def slope(self, used: Float, one_plus_cosine: Float, leg: Float) -> Float:
        """Derivative of the excess length consumed with respect to the length of the flight."""
        return (used + self.distance * one_plus_cosine) / (self.distance + used - leg)

    def sample(self, used: Float, sample: Point) -> Vector:
        """Direction of a flight that consumes ``used``; two numbers in [0, 1)."""
        *_, logarithm = self._limits(used)
        offset = used / self.distance
        # of the density 1 / (1 + cos(theta) + offset) per solid angle, by its inverse. Whichever of
        # 1 + cos and 1 - cos is the smaller one keeps its digits
        x = logarithm * sample.x
        one_plus = dr.clip((2 + offset) * dr.exp(-x) - offset, 0, 2)
        one_minus = (2 + offset) * _one_minus_exp(x)
        forward = one_minus < 1
        one_plus = dr.select(forward, 2 - one_minus, one_plus)
        one_minus = dr.select(forward, one_minus, 2 - one_plus)
        sine = dr.sqrt(one_plus * one_minus)
        sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample.y)
        local = mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, one_plus - 1)
        return level_frame(self.away).to_world(local)

    def density(self, used: Float, direction: Vector) -> Float:
        """Density of `sample`, per steradian."""
        least, width, logarithm = self._limits(used)
        one_plus = self.one_plus_cosine(direction)
        one_minus = 0.5 * dr.squared_norm(self.away - direction)
        # wherever a sample may lie, whose direction was rounded
        inside = one_plus >= least - ROUNDING * (dr.sqrt(2 * one_plus) + ROUNDING)
        inside &= one_minus <= width + ROUNDING * (dr.sqrt(2 * one_minus) + ROUNDING)
        density = dr.inv_two_pi / (logarithm * (one_plus + used / self.distance))
        return dr.select(inside, density, 0)

    def _limits(self, used: Float) -> tuple[Float, Float, Float]:
        """Least 1 + cos(theta) of flights that end in view, 2 less that, and a logarithm.

        The logarithm is of the largest over the least `one_plus_cosine` + ``used`` / distance. On
        an ellipsoid of eccentricity e the angles psi and theta at its foci obey tan(psi / 2) = (1 -
        e) / (1 + e) tan(theta / 2); here (1 - e) / (1 + e) is used / (used + 2 distance). Flights
        towards the telescope end where the air does; twice that far, as its boundary may be
        oblique.
        """
        narrow = dr.square(used / (self.field * (2 * self.distance + used)))
        towards = used / (used + 2 * self.reach)
        least = dr.maximum(2 / (1 + dr.rcp(narrow)), towards)
        width = dr.minimum(2 / (1 + narrow), 2 - towards)
        offset = used / self.distance
        most = 2 + offset
        # ln(most / (least + offset)), whose digits a ratio near one would not have
        near_one = 2 * dr.atanh(dr.minimum(width, 1) / (2 * most - dr.minimum(width, 1)))
        return least, width, dr.select(width < 1, near_one, dr.log(most / (least + offset)))


def _one_minus_exp(x: Float) -> Float:
    """1 - exp(-x), without cancellation."""
    half = dr.tanh(0.5 * x)
    return 2 * half / (1 + half)


def quarter_turn(axis: Vector, direction: Vector) -> Vector:
    """A direction rotated by 90 degrees about an axis."""
    return axis * dr.dot(axis, direction) + dr.cross(axis, direction)


def closing_distance(offset: Vector, direction: Vector, path: Float) -> Float:
    """Length of the flight whose path, from its start to the goal, is ``path`` long.

    From ``offset`` (start minus goal) along ``direction`` to t, and from there to the goal:
    t + |offset + t direction| = path, t = (path^2 - |offset|^2) / (2 (path + offset.direction)).
    -1 where the path is shorter than the straight line.
    """
    length = dr.norm(offset)
    excess = path - length
    # path + offset.direction, without the cancellation of a flight towards the goal
    consumed = excess + 0.5 * dr.squared_norm(offset + direction * length) / dr.maximum(
        length, TINY
    )
    return dr.select(excess > 0, 0.5 * excess * (path + length) / consumed, -1)


def shortened(end: Vector, direction: Vector, gap: Float) -> Float:
    """By how much a path is shortened by ending a flight earlier: gap + |end| - |end - gap d|.

    ``end`` is the flight's end less the goal; without the difference of both distances.
    """
    total = dr.norm(end) + dr.norm(end - direction * gap)
    return gap * (1 + (2 * dr.dot(direction, end) - gap) / total)


def closed(origin: Point, direction: Vector, goal: Point, path: Float) -> tuple[Float, Float]:
    """The closing distance of a flight from a point, and d(distance)/d(path)."""
    distance = closing_distance(origin - goal, direction, path)
    back = dr.normalize(goal - (origin + direction * distance))
    # a vertex farther by ds lengthens the path by ds less its component along the way back
    return distance, dr.rcp(1 - dr.dot(direction, back))


def sample_ahead(most: Float, scale: Float, sample: Float) -> Float:
    """A distance from 0 to ``most``, of a density proportional to 1 / (distance + scale)."""
    x = _steps(most, scale) * sample
    # exp(x) - 1, without cancellation
    half = dr.tanh(0.5 * dr.minimum(x, 1))
    return scale * dr.select(x < 1, 2 * half / (1 - half), dr.exp(x) - 1)


def ahead_density(distance: Float, most: Float, scale: Float) -> Float:
    """Density of `sample_ahead`, per metre."""
    return dr.rcp((distance + scale) * _steps(most, scale))


def _steps(most: Float, scale: Float) -> Float:
    """ln(1 + most / scale), without cancellation."""
    ratio = most / scale
    return dr.select(ratio < 1, 2 * dr.atanh(dr.minimum(ratio, 1) / (2 + ratio)), dr.log(1 + ratio))


def sample_near(least: Float, most: Float, scale: Float, sample: Point, again: Float) -> Float:
    """Distance of a vertex in front of the point where the beam would close the path.

    Of isotropic scattering there, weighted by the length at which directions close the path, the
    fraction that returns into view is proportional to ln(1 + (scale / gap)^2). Uniform, if that
    is out of the range.
    """
    # a Cauchy number times a uniform one has this density: the logarithm has no closed inverse
    gap = scale * sample.x * dr.tan(0.5 * dr.pi * sample.y)
    return dr.select((gap > least) & (gap < most), gap, dr.lerp(least, most, again))


def near_density(gap: Float, least: Float, most: Float, scale: Float) -> Float:
    """Density of `sample_near`, per metre."""
    # of the draws that fall out of the range and are replaced by uniform ones
    outside = 1 - _near_chance(most, scale) + _near_chance(least, scale)
    density = dr.log(1 + dr.square(scale / gap)) / (dr.pi * scale)
    return density + outside / (most - least)


def _near_chance(gap: Float, scale: Float) -> Float:
    """Integral of ln(1 + (scale / gap)^2) / (pi scale) from 0 to ``gap``."""
    value = gap * dr.log(1 + dr.square(scale / gap)) + 2 * scale * dr.atan(gap / scale)
    return dr.select(gap > 0, value / (dr.pi * scale), 0)
