"""Light paths of a lidar: from the laser over the air's vertices to a point of the telescope.

`Lidar.forced` finds paths that end in a gate, `Lidar.analog` lets photons fly as nature draws them
and sees whether they do. Both bring back Stokes vectors about the instrument's horizontal axis.
"""

import drjit as dr
import mitsuba as mi

from .closed_paths import Way, closing_distance, near_density, quarter_turn, sample_near
from .media import Air, coefficients, collision, interaction, slabs, transmittance
from .polarization import apply_phase_function, rotate_stokes, transverse
from .random_numbers import generator, pair
from .resampling import choose

SPEED_OF_LIGHT = 299_792_458.0
FWHM_TO_SIGMA = 0.42466090014400953  # 1 / (2 sqrt(2 ln 2))

# Fraction of first vertices sampled where isotropic scattering closes paths most often.
NEAR_SHARE = 0.35
# Of last flights, the share whose direction is the phase function's, and the largest share that is
# looked for from the telescope.
PHASE_SHARE = 0.2
BACK_SHARE = 0.5
# Of flights between, the share whose direction is the phase function's; the others mostly stay in
# a field of view that is wider than the telescope's by this factor.
PHASE_FLIGHT_SHARE = 0.3
WIDER = 1.6
# Of flights between, the share that leaves as much of the path as first vertices do.
NEAR_FLIGHT_SHARE = 0.3
# Probability of survival over the weight of the last flight.
FOLLOWED = 30.0


class Photon:
    """Photons at the laser, each with the telescope point it will be connected to.

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
        self.low, self.high = self.air.bounds(sensor.get_medium())
        self.wavelengths = sensor.laser.wavelengths()
        self.channel = _channel(sensor.laser.wavelength)
        self.area = sensor.aperture_area()
        self.context = mi.PhaseFunctionContext()

    def emit(self, seed, beam, number) -> Photon:
        """Photons of beams by their index, with random numbers of their own."""
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
        """Stokes vector (about e_h) that a photon returns from its gate.

        ``low`` and ``high`` are twice the gate's ranges less the photon's delay, ``share`` (0 to
        1) says where between them this photon's whole path is. The sum of all orders up to
        ``max_order``; with ``split`` each order's S0 is also added to ``by_order``.
        """
        medium = mi.MediumPtr(self.sensor.get_medium())
        offset = photon.origin - photon.aperture
        path = dr.lerp(low, high, share)
        closure = closing_distance(offset, photon.direction, path)
        home = dr.normalize(photon.aperture - (photon.origin + photon.direction * closure))
        volume = (high - low) / (1 - dr.dot(photon.direction, home))
        total = self._connect(
            photon,
            photon.rng,
            photon.origin,
            photon.direction,
            closure,
            medium,
            photon.stokes,
            volume,
            (path > 0) & (closure > 0),
        )
        if split:
            _add(by_order, total[0], cell * max_order)
        if max_order == 1:
            return total
        further = self._forced_further(
            photon, medium, path, high - low, mi.UInt32(max_order), split, by_order, cell, max_order
        )
        return _sum(total, further)

    @dr.syntax
    def _forced_further(self, photon, medium, path, width, last, split, by_order, cell, max_order):
        """Orders from two on: the path is closed once from every vertex but the last."""
        # a local name, since the loop carries local variables, not what objects hold
        aperture, rng = photon.aperture, photon.rng
        total, order = _copied([0, 0, 0, 0]), mi.UInt32(2)
        path, medium = mi.Float(path), mi.MediumPtr(medium)
        position, direction = mi.Point3f(photon.origin), mi.Vector3f(photon.direction)
        stokes = _copied(photon.stokes)
        flight, weight = self._first_flight(rng, position, direction, aperture, path)
        active = flight > 0
        while dr.hint(active, label="scattering orders"):
            out, medium = transmittance(
                self.air,
                medium,
                position,
                direction,
                flight,
                self.channel,
                self.wavelengths,
                rng,
                active,
            )
            active &= medium != None
            position = mi.Point3f(position + direction * flight)
            mei = interaction(medium, position, direction, self.wavelengths)
            scattering, _ = coefficients(medium, mei, self.channel, active)
            weight *= out * scattering
            # the first vertex plays no roulette: in thin air it is the signal
            followed = dr.select(order == 2, 1, dr.minimum(FOLLOWED * weight, 1))
            active &= (weight > 0) & (rng.next_float32(active) < followed)
            stokes = _scaled(stokes, dr.select(active, weight / followed, 0))
            path -= flight

            away = position - aperture
            distance = dr.norm(away)
            away, budget = away / distance, path - distance
            active &= budget > 0
            _, room = slabs(self.low, self.high, position, -away)
            way = Way(away, distance, budget, self._half_field(photon.axes, away), room)
            closing, bent, leg, volume = self._last_flight(
                rng, photon, medium, mei, stokes, way, active
            )
            gain = self._connect(
                photon, rng, position, closing, leg, medium, bent, width * volume, volume > 0
            )
            total = _sum(total, gain)
            if dr.hint(split, mode="scalar"):
                _add(by_order, gain[0], cell * max_order + order - 1, active)

            order += 1
            active &= order <= last
            direction, stokes, flight, weight = self._next_flight(
                rng, medium, mei, stokes, way, active
            )
            active &= weight > 0
        return total

    def _first_flight(self, rng, origin, direction, aperture, path):
        """Length of a first flight and one over its density; -1 where the beam meets no air."""
        reach = closing_distance(origin - aperture, direction, path)
        enters, leaves = slabs(self.low, self.high, origin, direction)
        least, most = reach - dr.minimum(leaves, reach), reach - dr.maximum(enters, 0)
        # half the field of view's radius where the path turns back
        scale = 0.25 * path * self.sensor.m_fov_tan
        choice, near = pair(rng), sample_near(least, most, scale, pair(rng), rng.next_float32())
        # steeper phase functions than the isotropic one fall later
        steps = dr.log((most + scale) / (least + scale))
        far = (least + scale) * dr.exp(steps * choice.y) - scale
        left = dr.select(choice.x < NEAR_SHARE, near, far)
        density = dr.lerp(
            dr.rcp((left + scale) * steps), near_density(left, least, most, scale), NEAR_SHARE
        )
        return dr.select((path > 0) & (most > least), reach - left, -1), dr.rcp(density)

    def _half_field(self, axes, away):
        """Tangent of half the widest angle between a direction and one of the field of view."""
        local = axes.to_local(away)
        vertex = dr.norm(local.xy) / (1 + local.z)
        field = self._half_fov()
        return dr.select(vertex * field < 1, (vertex + field) / (1 - vertex * field), dr.inf)

    def _half_fov(self):
        return self.sensor.m_fov_tan / (1 + dr.sqrt(1 + dr.square(self.sensor.m_fov_tan)))

    def _last_flight(self, rng, photon, medium, mei, stokes, way, active):
        """Direction, Stokes vector and length of the flight to the last vertex; its weight.

        Of two candidates one is taken, by its contribution if nothing is in the way and the air
        is the same there. The weight includes d(length)/d(path).
        """
        phase, axes, path = medium.phase_function(), photon.axes, way.distance + way.budget
        # the telescope finds last vertices far off, in units of the field of view's radius
        beside = way.field / self._half_fov() - 1
        ahead = 0.5 * way.budget / (way.distance * self.sensor.m_fov_tan)
        far = dr.square(beside) + dr.square(ahead)
        backward = BACK_SHARE * (1 - dr.rcp(1 + far))
        sort = rng.next_float32(active)
        by_phase, by_back = sort < PHASE_SHARE, sort > 1 - backward

        drawn, _, _ = phase.sample(self.context, mei, rng.next_float32(active), pair(rng), active)
        aimed = way.sample(way.budget, pair(rng))
        inward = self._in_field(axes, rng)
        first = dr.select(by_phase, drawn, dr.select(by_back, inward, aimed))
        axis = dr.select(by_phase, -mei.wi, dr.select(by_back, axes.n, way.away))
        tried = []
        for wo in (first, quarter_turn(axis, first)):
            end = photon.aperture + wo * closing_distance(photon.aperture - mei.p, wo, path)
            wo = dr.select(by_back, dr.normalize(end - mei.p), wo)
            raised = way.raised(wo)
            leg = way.leg(way.budget, raised)
            volume = dr.rcp(way.slope(way.budget, raised, leg))
            end = mei.p + wo * leg
            seen = active & self.sensor.in_field_of_view(axes, end - photon.aperture)
            # both legs meet the ellipsoid under the same angle
            found = dr.select(seen, dr.square(leg / (path - leg)) / self._field_solid_angle(), 0)
            seen &= dr.all((end > self.low) & (end < self.high))
            bent, pdf = self._scatter(medium, mei, stokes, wo, seen)
            there = interaction(medium, end, wo, self.wavelengths)
            home = dr.normalize(photon.aperture - end)
            received, chance = self._scatter(medium, there, bent, home, seen)
            density = PHASE_SHARE * pdf + backward * found
            density += (1 - PHASE_SHARE - backward) * way.density(way.budget, raised)
            # never 0 where there may be light: the air may be another there
            worth = (0.95 * received[0] + 0.05 * bent[0] * chance) * volume
            worth = dr.select(seen & (density > 0), worth, 0)
            tried.append((worth, density, (wo, bent, leg, volume)))
        (wo, bent, leg, volume), weight = choose(rng, *tried)
        return wo, bent, leg, volume * weight

    def _next_flight(self, rng, medium, mei, stokes, way, active):
        """Direction, Stokes vector (of unchanged S0), length and weight of a flight between."""
        phase, way = medium.phase_function(), way.widened(WIDER)
        by_phase = rng.next_float32(active) < PHASE_FLIGHT_SHARE
        drawn, _, _ = phase.sample(self.context, mei, rng.next_float32(active), pair(rng), active)
        # optical paths to the gate differ little, so that any use of the budget is about as likely
        most, scale = 0.5 * way.budget, 0.5 * way.distance * self.sensor.m_fov_tan
        choice, near = pair(rng), sample_near(0, most, scale, pair(rng), rng.next_float32(active))
        left = dr.select(choice.x < NEAR_FLIGHT_SHARE, near, most * choice.y)
        spread = dr.lerp(dr.rcp(most), near_density(left, 0, most, scale), NEAR_FLIGHT_SHARE)
        spread *= 0.5
        used = way.budget - 2 * left
        sample = pair(rng)
        mirrored = mi.Point2f(1 - sample.x, sample.y + 0.25)
        # two candidates again, across each other; the steep one is paired with a flat one
        tried = []
        for wo in (
            dr.select(by_phase, drawn, way.sample(used, sample)),
            dr.select(by_phase, quarter_turn(-mei.wi, drawn), way.sample(used, mirrored)),
        ):
            raised = way.raised(wo)
            leg = way.leg(used, raised)
            bent, pdf = self._scatter(medium, mei, stokes, wo, active)
            density = dr.lerp(way.density(used, raised), pdf, PHASE_FLIGHT_SHARE)
            density *= way.slope(used, raised, leg) * spread
            end = mei.p + wo * leg
            inside = active & (leg > 0) & dr.all((end > self.low) & (end < self.high))
            worth = dr.select(inside & (density > 0), bent[0], 0)
            tried.append((worth, density, (wo, bent, leg)))
        (wo, bent, leg), weight = choose(rng, *tried)
        kept = dr.select(weight > 0, stokes[0] / bent[0], 0)
        return wo, _scaled(bent, kept), leg, dr.select(kept > 0, weight / kept, 0)

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

    def _connect(self, photon, rng, position, direction, distance, medium, stokes, volume, active):
        """Scatter at ``distance`` along a flight, where the path closes: Stokes vector about e_h.

        ``volume``: width of the gate (as whole path) times d(distance)/d(path).
        """
        vertex = position + direction * distance
        active = active & self.sensor.in_field_of_view(photon.axes, vertex - photon.aperture)
        out, medium = transmittance(
            self.air,
            medium,
            position,
            direction,
            distance,
            self.channel,
            self.wavelengths,
            rng,
            active,
            self.differentiable,
        )
        mei = interaction(medium, vertex, direction, self.wavelengths)
        active = active & (medium != None)
        scattering, _ = coefficients(medium, mei, self.channel, active)
        return self._receive(photon, rng, medium, mei, stokes, active, out * scattering * volume)

    def _receive(self, photon, rng, medium, mei, stokes, active, weight):
        """Next-event estimation from an interaction to the telescope point."""
        back = photon.aperture - mei.p
        distance = dr.norm(back)
        wo = back / distance
        active = active & self.sensor.in_field_of_view(photon.axes, -back)
        home, _ = transmittance(
            self.air,
            medium,
            mei.p,
            wo,
            distance,
            self.channel,
            self.wavelengths,
            rng,
            active,
            self.differentiable,
        )
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
        return apply_phase_function(value, stokes, self.channel), pdf

    @dr.syntax
    def analog(self, photon, max_order, base, gates, sums, products, split, by_order):
        """Analog free flights; every collision is connected to the telescope.

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
                self.air,
                medium,
                position,
                direction,
                2 * high - travelled,
                self.channel,
                self.wavelengths,
                rng,
                active,
            )
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
            stokes = apply_phase_function(value, stokes, self.channel)
            direction = mi.Vector3f(onward)
            active &= (density > 0) & (stokes[0] > 0)
            _deposit(sums, products, base + gate, held, began & ~active)


def _add(total, value, cell, active=True):
    # the default mode would compile the number of cells into the kernel
    dr.scatter_reduce(dr.ReduceOp.Add, total, value, cell, active, mode=dr.ReduceMode.Local)


def _deposit(sums, products, cell, held, active):
    """Add contributions of photons to their gates, and products of their components."""
    active = active & (held[0] != 0)
    for total, value in zip(sums, held, strict=True):
        _add(total, value, cell, active)
    for (i, j), total in products.items():
        _add(total, held[i] * held[j], cell, active)


def _copied(stokes):
    return [mi.Float(s) for s in stokes]


def _sum(first, second):
    return [a + b for a, b in zip(first, second, strict=True)]


def _scaled(stokes, factor):
    return [s * factor for s in stokes]


def _channel(wavelength: float) -> int:
    """Index of the spectrum's entry for the laser."""
    return (2 if wavelength < 490e-9 else 1 if wavelength < 580e-9 else 0) if mi.is_rgb else 0
