"""Light paths of a lidar: from the laser over the air's vertices to a point of the telescope.

`Lidar.forced` finds paths that end in a gate, `Lidar.analog` lets photons fly as nature draws them
and sees whether they do. Both bring back Stokes vectors about the instrument's horizontal axis.
"""

import drjit as dr
import mitsuba as mi

from .media import Air, coefficients, collision, interaction, transmittance
from .polarization import rotate_stokes, transverse
from .random_numbers import generator, pair

SPEED_OF_LIGHT = 299_792_458.0
FWHM_TO_SIGMA = 0.42466090014400953  # 1 / (2 sqrt(2 ln 2))

# Of the photons that go on after single scattering, the share whose first flight is free: these
# scatter long before the gate, as paths of many orders do.
FREE_SHARE = 0.4
# How far such a photon's density is counted where it arrives (its transmittance is not known).
FREE_ARRIVAL = 0.2
# The others' first vertex is put near the gate: the share of these that is put closest to it.
NEAR_SHARE = 0.7
# Of later flights, the share that is as short as such a vertex is near.
SHORT_SHARE = 0.3
# A photon goes on with this times the weight its last flight has left it.
FOLLOWED = 3.0


class Photon:
    """Photons as they leave the laser, each with the telescope point it will be connected to.

    World coordinates. ``frame`` holds the beam's axes in the lidar's own frame, ``axes`` in the
    world. ``delay`` is half the light path (m) by which the photon left after the middle of the
    pulse. ``stokes`` refers to ``mi.mueller.stokes_basis(direction)``.
    """

    def __init__(self, rng, frame, axes, origin, direction, aperture, delay, stokes):
        self.rng, self.frame, self.axes = rng, frame, axes
        self.origin, self.direction, self.aperture = origin, direction, aperture
        self.delay, self.stokes = delay, stokes


class Lidar:
    """A scene and the lidar in it: emission, scattering and connection of a wavefront."""

    def __init__(self, scene, sensor, differentiable=False):
        self.air, self.sensor, self.differentiable = Air(scene), sensor, differentiable
        self.wavelengths = sensor.laser.wavelengths()
        self.channel = _channel(sensor.laser.wavelength)
        self.area = sensor.aperture_area()
        self.context = mi.PhaseFunctionContext()

    def emit(self, seed, beam, number) -> Photon:
        rng = generator(seed, beam, number)
        sensor, laser = self.sensor, self.sensor.laser
        to_world = sensor.world_transform()
        frame = sensor.beam_frame(beam)
        origin, direction = laser.sample_local(pair(rng), pair(rng))
        origin = to_world @ mi.Point3f(frame.to_world(mi.Vector3f(origin)))
        direction = dr.normalize(to_world @ frame.to_world(direction))
        aperture = to_world @ sensor.sample_aperture(frame, pair(rng))
        axes = mi.Frame3f(*(to_world @ axis for axis in (frame.s, frame.t, frame.n)))
        delay = mi.Float(0)
        if laser.pulse_duration > 0:
            sigma = FWHM_TO_SIGMA * laser.pulse_duration * SPEED_OF_LIGHT / 2
            delay = sigma * mi.warp.square_to_std_normal(pair(rng)).x
        stokes = [mi.Float(1)]
        if mi.is_polarized:
            stokes = rotate_stokes(
                [mi.Float(s) for s in laser.stokes],
                direction,
                transverse(axes.s, direction),
                mi.mueller.stokes_basis(direction),
            )
        return Photon(rng, frame, axes, origin, direction, aperture, delay, list(stokes))

    def forced(self, photon, low, high, share, max_order, split, by_order, cell):
        """Stokes vector (about e_h) a photon brings back from its gate.

        ``low`` and ``high`` are twice the gate's ranges less the photon's delay, ``share`` (0 to
        1) says where between them this photon's whole path is. The sum of all orders up to
        ``max_order``; with ``split`` each order's S0 is also added to ``by_order``.
        """
        medium = mi.MediumPtr(self.sensor.get_medium())
        offset = photon.origin - photon.aperture
        path = dr.lerp(low, high, share)
        closure = _closing(offset, photon.direction, path)
        total = self._connect(
            photon, photon.rng, photon.origin, photon.direction, closure, medium, photon.stokes,
            high - low, (path > 0) & (closure > 0),
        )  # fmt: skip
        if split:
            _add(by_order, total[0], cell * max_order)
        if max_order == 1:
            return total
        further = self._forced_further(
            photon, photon.rng, photon.origin, photon.direction, photon.stokes, medium, low, high,
            path, mi.UInt32(max_order), split, by_order, cell, max_order,
        )  # fmt: skip
        return _sum(total, further)

    @dr.syntax
    def _forced_further(
        self, photon, rng, position, direction, stokes, medium, low, high, path, last, split,
        by_order, cell, max_order,
    ):  # fmt: skip
        """Orders from two on.

        Three ways lead to a path's last vertex: along the photon's flight to where the path closes
        (``ahead``); from the telescope, along a direction of the field of view, to where it closes
        (``back``); and a flight that happens to end in the gate (``free``), which covers vertices
        of small scattering angle, where a range says little about a place.
        """
        aperture, axes = photon.aperture, photon.axes
        width = high - low
        total, order = _copied([0, 0, 0, 0]), mi.UInt32(1)
        position, direction = mi.Point3f(position), mi.Vector3f(direction)
        stokes, medium = _copied(stokes), mi.MediumPtr(medium)
        low, high, path = mi.Float(low), mi.Float(high), mi.Float(path)
        density = mi.Float(0)  # of the flight's direction; 0: the laser's
        thickness = mi.Float(0)  # extinction coefficient where the flight begins
        active = high > 0
        while dr.hint(active, label="scattering orders"):
            # the next vertex: no later than the far end of the gate
            reach = _closing(position - aperture, direction, high)
            active &= reach > 0
            first = order == 1
            free = active & first & (rng.next_float32(active) < FREE_SHARE)
            scale = self._near_scale(high)
            left = _sample_left(reach, scale, pair(rng))
            flight = dr.select(
                first, reach - left, _sample_flight(thickness, reach, left, pair(rng))
            )
            flown, behind, found = collision(
                self.air, medium, position, direction, reach, self.channel, self.wavelengths,
                rng, free,
            )  # fmt: skip
            flight = dr.select(free, flown, flight)
            active &= (flight > 0) & (found | ~free)
            out, medium = transmittance(
                self.air, medium, position, direction, flight, self.channel, self.wavelengths,
                rng, active & ~free,
            )  # fmt: skip
            medium = dr.select(free, behind, medium)
            active &= medium != None
            vertex = mi.Point3f(position + direction * flight)
            mei = interaction(medium, vertex, direction, self.wavelengths)
            scattering, extinction = coefficients(medium, mei, self.channel, active)
            drawn = dr.select(
                first,
                _left_density(reach - flight, reach, scale),
                _flight_density(thickness, reach, scale, flight),
            )
            # two ways of finding the first vertex; any partition of one keeps the mean
            part = (1 - FREE_SHARE) * drawn
            part /= part + FREE_SHARE * FREE_ARRIVAL * extinction
            forced = out * scattering / drawn * dr.select(first, part / (1 - FREE_SHARE), 1)
            chosen = scattering / extinction * (1 - part) / FREE_SHARE
            weight = dr.select(free, chosen, forced)
            stokes = _scaled(stokes, dr.select(active, weight, 0))
            active &= stokes[0] > 0
            low, high, path = low - flight, high - flight, path - flight

            # free: this vertex may be the last one
            home = aperture - vertex
            outside = dr.norm(home)
            in_gate = active & (order > 1) & (outside >= low) & (outside < high)
            slope = 1 - dr.dot(direction, home / outside)
            chance = drawn * width
            aimed = self._aimed(axes, home, outside, flight)
            share = chance / (chance + slope * (1 + aimed / density))
            gain = self._receive(photon, rng, medium, mei, stokes, in_gate, share)
            total = _sum(total, gain)
            if dr.hint(split, mode="scalar"):
                _add(by_order, gain[0], cell * max_order + order - 1, in_gate)
            order += 1
            followed = dr.select(first, 1, dr.minimum(FOLLOWED * weight, 1))
            stokes = _scaled(stokes, dr.rcp(followed))
            active &= (order <= last) & (rng.next_float32(active) < followed)
            position, thickness = mi.Point3f(vertex), mi.Float(extinction)

            # back: the last vertex looked for from the telescope
            homeward = home / outside
            turning = 0.5 / (1 + 0.5 * (high - outside) / self._footprint(outside))
            inward = self._in_field(axes, rng)
            outside = _closing(aperture - vertex, inward, path)
            end = aperture + inward * outside
            leg = dr.norm(end - vertex)
            outward = (end - vertex) / leg
            seen = active & (outside > 0) & (leg > 0)
            bent, density = self._scatter(medium, mei, stokes, outward, seen)
            density = self._direction_density(medium, mei, density, turning, homeward, outward, seen)
            aimed = dr.square(leg / outside) / self._field_solid_angle()
            gain = self._connect(
                photon, rng, vertex, outward, leg, medium, _scaled(bent, dr.rcp(aimed)), width,
                seen, (aimed, density, aimed, thickness, high),
            )  # fmt: skip

            # ahead: along the photon's next flight
            turned = rng.next_float32(active) < turning
            guide = interaction(
                medium, vertex, dr.select(turned, homeward, direction), self.wavelengths
            )
            onward, _, density = medium.phase_function().sample(
                self.context, guide, rng.next_float32(active), pair(rng), active
            )
            active &= density > 0
            stokes, density = self._scatter(medium, mei, stokes, onward, active)
            density = self._direction_density(medium, mei, density, turning, homeward, onward, active)
            active &= density > 0
            stokes = _scaled(stokes, dr.select(active, dr.rcp(density), 0))
            closure = _closing(vertex - aperture, onward, path)
            home = aperture - (vertex + onward * closure)
            aimed = self._aimed(axes, home, dr.norm(home), closure)
            gain = _sum(gain, self._connect(
                photon, rng, vertex, onward, closure, medium, stokes, width,
                active & (closure > 0), (density, density, aimed, thickness, high),
            ))  # fmt: skip
            total = _sum(total, gain)
            if dr.hint(split, mode="scalar"):
                _add(by_order, gain[0], cell * max_order + order - 1, active)
            direction = mi.Vector3f(onward)
        return total

    def _footprint(self, distance):
        """Radius of the field of view at a distance."""
        return distance * self.sensor.m_fov_tan

    def _near_scale(self, path):
        """Half the field of view's radius where a path of this length turns back."""
        return 0.5 * self._footprint(0.5 * path)

    def _direction_density(self, medium, mei, density, turning, homeward, wo, active):
        """Of a flight that turns homeward now and then; ``density`` is the phase function's."""
        guide = interaction(medium, mei.p, homeward, self.wavelengths)
        _, turned = medium.phase_function().eval_pdf(self.context, guide, wo, active)
        return dr.lerp(density, turned, turning)

    def _aimed(self, axes, home, outside, leg):
        """Density, per solid angle of the flight, of finding its end from the telescope.

        Flight and return meet an ellipsoid under the same angle, so the solid angles of a piece
        of it, seen from its foci, are as one over the distances squared.
        """
        visible = self.sensor.in_field_of_view(axes, -home)
        return dr.select(visible, dr.square(leg / outside) / self._field_solid_angle(), 0)

    def _connect(
        self, photon, rng, position, direction, distance, medium, stokes, width, active,
        densities=None,
    ):  # fmt: skip
        """Scatter at ``distance`` along a flight, where the path closes: Stokes vector about e_h.

        ``width`` (of the gate, as whole path) times d(distance)/d(path) makes a path length a
        volume. ``densities`` for the balance heuristic, without which this is the only way here: of
        the direction as it was drawn here, along a flight and from the telescope; then what the
        flight's length depends on, the extinction coefficient at its start and the far end of the
        gate (as what is left of the path).
        """
        vertex = position + direction * distance
        active = active & self.sensor.in_field_of_view(photon.axes, vertex - photon.aperture)
        out, medium = transmittance(
            self.air, medium, position, direction, distance, self.channel, self.wavelengths,
            rng, active, self.differentiable,
        )  # fmt: skip
        mei = interaction(medium, vertex, direction, self.wavelengths)
        active = active & (medium != None)
        scattering, _ = coefficients(medium, mei, self.channel, active)
        slope = 1 - dr.dot(direction, dr.normalize(photon.aperture - vertex))
        volume = width / slope
        weight = out * scattering * volume
        if densities:
            own, density, aimed, thickness, high = densities
            reach = _closing(position - photon.aperture, direction, high)
            scale = self._near_scale(high)
            free = density * _flight_density(thickness, reach, scale, distance) * volume
            weight *= own / (density + aimed + free)
        return self._receive(photon, rng, medium, mei, stokes, active, weight)

    def _receive(self, photon, rng, medium, mei, stokes, active, weight):
        """Next-event estimation from an interaction to the telescope point."""
        back = photon.aperture - mei.p
        distance = dr.norm(back)
        wo = back / distance
        active = active & self.sensor.in_field_of_view(photon.axes, -back)
        home, _ = transmittance(
            self.air, medium, mei.p, wo, distance, self.channel, self.wavelengths, rng, active,
            self.differentiable,
        )  # fmt: skip
        weight = weight * home * self.area * -dr.dot(wo, photon.axes.n) / (distance * distance)
        received, _ = self._scatter(medium, mei, stokes, wo, active)
        if not mi.is_polarized:
            received = [*received, mi.Float(0), mi.Float(0), mi.Float(0)]
        else:
            received = rotate_stokes(
                received, wo, mi.mueller.stokes_basis(wo), transverse(photon.axes.s, wo)
            )
        return [dr.select(active, r * weight, 0) for r in received]

    def _scatter(self, medium, mei, stokes, wo, active):
        """Stokes vector after scattering into a direction (per steradian), and its pdf."""
        value, pdf = medium.phase_function().eval_pdf(self.context, mei, wo, active)
        return _apply(value, stokes, self.channel), pdf

    def _field_solid_angle(self):
        cosine = dr.rsqrt(1 + dr.square(self.sensor.m_fov_tan))
        return dr.two_pi * dr.square(self.sensor.m_fov_tan * cosine) / (1 + cosine)

    def _in_field(self, axes, rng):
        """A direction of the field of view, uniform in solid angle."""
        sample = pair(rng)
        # 1 - cos, kept apart from 1: fields of view are milliradians
        below = sample.x * self._field_solid_angle() * dr.inv_two_pi
        sine = dr.safe_sqrt(below * (2 - below))
        sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample.y)
        return axes.to_world(mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, 1 - below))

    @dr.syntax
    def analog(self, photon, max_order, base, gates, sums, products, split, by_order):
        """Free flights as nature draws them; every collision is connected to the telescope.

        A photon's apparent range never falls from one order to the next (triangle inequality), so
        what it brings to a gate is complete when a later gate is reached: only then is it squared.
        """
        rng, aperture = photon.rng, photon.aperture
        low, high = self.sensor.ranges(photon.frame.n)
        position, direction = mi.Point3f(photon.origin), mi.Vector3f(photon.direction)
        stokes = _copied(photon.stokes)
        medium = mi.MediumPtr(self.sensor.get_medium())
        travelled, order = mi.Float(2 * photon.delay), mi.UInt32(1)
        gate, held = mi.UInt32(0), _copied([0, 0, 0, 0])
        active = mi.Bool(True)
        while dr.hint(active, label="scattering orders"):
            began = mi.Bool(active)
            flight, medium, active = collision(
                self.air, medium, position, direction, 2 * high - travelled, self.channel,
                self.wavelengths, rng, active,
            )  # fmt: skip
            position = mi.Point3f(position + direction * flight)
            travelled += flight
            mei = interaction(medium, position, direction, self.wavelengths)
            scattering, extinction = coefficients(medium, mei, self.channel, active)
            albedo = dr.select(active, scattering / extinction, 0)
            stokes = _scaled(stokes, albedo)
            range_ = 0.5 * (travelled + dr.norm(aperture - position))
            share = (range_ - low) / (high - low)
            counts = active & (share >= 0) & (share < 1)
            gain = self._receive(photon, rng, medium, mei, stokes, counts, mi.Float(1))
            now = dr.select(counts, mi.UInt32(dr.clip(share * gates, 0, gates - 1)), gate)
            done = now != gate
            _deposit(sums, products, base + gate, held, done)
            held = _sum(_scaled(held, dr.select(done, 0, 1)), gain)
            gate = now
            if dr.hint(split, mode="scalar"):
                _add(by_order, gain[0], (base + gate) * max_order + order - 1, counts)
            order += 1
            active &= (order <= max_order) & (range_ < high)
            onward, value, density = medium.phase_function().sample(
                self.context, mei, rng.next_float32(active), pair(rng), active
            )
            stokes = _apply(value, stokes, self.channel)
            direction = mi.Vector3f(onward)
            active &= (density > 0) & (stokes[0] > 0)
            _deposit(sums, products, base + gate, held, began & ~active)


def _add(total, value, cell, active=True):
    # the default mode would compile the number of cells into the kernel
    dr.scatter_reduce(dr.ReduceOp.Add, total, value, cell, active, mode=dr.ReduceMode.Local)


def _deposit(sums, products, cell, held, active):
    """Add what photons have brought to their gates, and products of its components."""
    active = active & (held[0] != 0)
    for total, value in zip(sums, held):
        _add(total, value, cell, active)
    for (i, j), total in products.items():
        _add(total, held[i] * held[j], cell, active)


def _closing(offset, direction, path):
    """Where a flight must end for the rest of its path to be ``path`` long.

    From ``offset`` (start minus goal) along ``direction`` to t, and from there to the goal:
    t + |offset + t direction| = path, t = (path^2 - |offset|^2) / (2 (path + offset.direction)).
    -1 where the path is shorter than the straight line.
    """
    length = dr.norm(offset)
    end = (path - length) * (path + length) / (2 * (path + dr.dot(offset, direction)))
    return dr.select(path > length, end, -1)


def _sample_left(reach, scale, sample):
    """Distance of a first vertex from the far end of the gate, seen along the beam.

    Half the field of view's radius is the natural scale: from there on the share of directions
    that lead back into view falls with the distance squared. Steeper phase functions fall later.
    """
    choice, where = sample.x, sample.y
    near = scale * dr.tan(dr.atan(reach / scale) * where)
    far = scale * (dr.exp(dr.log(1 + reach / scale) * where) - 1)
    return dr.select(choice < NEAR_SHARE, near, far)


def _left_density(left, reach, scale):
    near = scale / ((left * left + scale * scale) * dr.atan(reach / scale))
    far = dr.rcp((left + scale) * dr.log(1 + reach / scale))
    return dr.lerp(far, near, NEAR_SHARE)


def _sample_flight(thickness, reach, near, sample):
    """A later flight that ends before ``reach``: exponential, or ``near`` where it begins.

    ``thickness`` is the extinction coefficient where it begins, a guess for all of the way.
    """
    collides = 1 - dr.exp(-thickness * reach)
    return dr.select(sample.x < SHORT_SHARE, near, -dr.log(1 - collides * sample.y) / thickness)


def _flight_density(thickness, reach, scale, distance):
    collides = 1 - dr.exp(-thickness * reach)
    exponential = thickness * dr.exp(-thickness * distance) / collides
    return dr.lerp(exponential, _left_density(distance, reach, scale), SHORT_SHARE)


def _apply(value, stokes, channel):
    """A phase function's value (Mueller matrix or number) times a Stokes vector."""
    if not mi.is_polarized:
        return [value[channel] * stokes[0]]
    matrix = [[value[row, column][channel] for column in range(4)] for row in range(4)]
    scattered = [sum(m * s for m, s in zip(row, stokes)) for row in matrix]
    # scalar phase functions answer with a multiple of the unit matrix in *any* pair of axes
    scalar = matrix[0][0]
    depolarises = (matrix[0][1] == 0) & (matrix[1][0] == 0)
    depolarises &= (matrix[1][1] == scalar) & (matrix[2][2] == scalar) & (matrix[3][3] == scalar)
    return [scattered[0], *(dr.select(depolarises, 0, s) for s in scattered[1:])]


def _copied(stokes):
    return [mi.Float(s) for s in stokes]


def _sum(first, second):
    return [a + b for a, b in zip(first, second, strict=True)]


def _scaled(stokes, factor):
    return [s * factor for s in stokes]


def _channel(wavelength: float) -> int:
    """Index of the spectrum's entry that stands for the laser."""
    return (2 if wavelength < 490e-9 else 1 if wavelength < 580e-9 else 0) if mi.is_rgb else 0
