"""Geometry of paths that must close: what is left of a path's length at a vertex, and its use.

With the telescope at the distance h and a path l still to go, home included, the *budget* l - h is
what the path is longer than the way straight home. A flight at the angle theta from the direction
away from home uses up the more of it the less it leads home: far from the telescope 1 + cos(theta)
times its length. All ends of flights that use up the same lie on an ellipsoid around the vertex and
the telescope.

A vertex in air of the same extinction all around brings the more the shorter ways use up a budget:
as 1 / (1 + cos(theta)), flights homeward by far the most. `Way.sample` draws such directions.
"""

import drjit as dr
import mitsuba as mi


class Way:
    """What a path has left at a vertex.

    Parameters
    ----------
    away : direction from the telescope point to the vertex.
    distance : between them, m.
    budget : length of the rest of the path less the distance, m.
    field : tangent of half the widest angle, as seen from the telescope, between the vertex and
        anything in the field of view.
    room : how far homeward there may be any air, m.
    """

    def __init__(self, away, distance, budget, field, room):
        self.away, self.distance, self.budget = away, distance, budget
        self.field, self.room = field, room

    def widened(self, factor):
        """The same with a wider field."""
        return Way(self.away, self.distance, self.budget, factor * self.field, self.room)

    def raised(self, direction):
        """1 + cos(theta), exact where it is small."""
        return 0.5 * dr.squared_norm(self.away + direction)

    def leg(self, used, raised):
        """Length of a flight that uses up ``used`` of the budget."""
        return used * (0.5 * used + self.distance) / (used + self.distance * raised)

    def slope(self, used, raised, leg):
        """Derivative of the budget used up with respect to the length of the flight."""
        return (used + self.distance * raised) / (self.distance + used - leg)

    def sample(self, used, sample):
        """Direction of a flight that uses up ``used``; two numbers in [0, 1)."""
        least, most, soft = self._span(used)
        raised = dr.clip(least * dr.exp(dr.log(most / least) * sample.x) - soft, 0, 2)
        sine = dr.sqrt(raised * (2 - raised))
        sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample.y)
        local = mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, raised - 1)
        return mi.Frame3f(self.away).to_world(local)

    def density(self, used, raised):
        """Of `sample`, per steradian."""
        least, most, soft = self._span(used)
        place = raised + soft
        inside = (place >= least) & (place <= most)
        return dr.select(inside, dr.inv_two_pi / (dr.log(most / least) * place), 0)

    def _span(self, used):
        """Least and greatest ``raised + soft`` of flights that end in view, and ``soft``.

        On an ellipsoid of eccentricity e the angles psi and theta at its foci obey
        tan(psi / 2) = (1 - e) / (1 + e) tan(theta / 2); here (1 - e) / (1 + e) is
        used / (used + 2 distance). Flights homeward end where the air does; twice that far, since
        its border need not be square to them.
        """
        soft = used / self.distance
        wide = dr.square(self.field * (2 * self.distance + used))
        least = 2 * dr.square(used) / (dr.square(used) + wide)
        least = dr.maximum(least, used / (used + 2 * self.room))
        return least + soft, 2 + soft, soft


def quarter_turn(axis, direction):
    """A direction turned by 90 degrees about an axis."""
    return axis * dr.dot(axis, direction) + dr.cross(axis, direction)


def closing_distance(offset, direction, path):
    """Where a flight must end for the rest of its path to be ``path`` long.

    From ``offset`` (start minus goal) along ``direction`` to t, and from there to the goal:
    t + |offset + t direction| = path, t = (path^2 - |offset|^2) / (2 (path + offset.direction)).
    -1 where the path is shorter than the straight line.
    """
    length = dr.norm(offset)
    end = (path - length) * (path + length) / (2 * (path + dr.dot(offset, direction)))
    return dr.select(path > length, end, -1)


def sample_near(least, most, scale, sample, again):
    """Distance of a vertex from where a flight along the beam would close the path.

    Of directions of isotropic scattering there, weighted by the length they close at, a fraction of
    ln(1 + (scale / left)^2) leads back into view. Uniform, if that falls out of the range.
    """
    left = scale * sample.x * dr.tan(0.5 * dr.pi * sample.y)
    return dr.select((left > least) & (left < most), left, dr.lerp(least, most, again))


def near_density(left, least, most, scale):
    """Of `sample_near`, per metre."""
    outside = 1 - _near_chance(most, scale) + _near_chance(least, scale)
    density = dr.log(1 + dr.square(scale / left)) / (dr.pi * scale)
    return density + outside / (most - least)


def _near_chance(left, scale):
    """Integral of ln(1 + (scale / left)^2) / (pi scale) from 0 on."""
    value = left * dr.log(1 + dr.square(scale / left)) + 2 * scale * dr.atan(left / scale)
    return dr.select(left > 0, value / (dr.pi * scale), 0)
