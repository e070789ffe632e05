"""Light paths of a lidar: from the laser over vertices in the air to a point of the telescope.

`Lidar.single` and `Lidar.further` sample paths that end in a gate, `Lidar.analog` samples free
flights from their physical distribution. All give Stokes vectors about the instrument's horizontal
axis.
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from .bodies import first_hit, slabs
from .bounds import Bounds
from .closed_paths import (
    OpenPath,
    ahead_density,
    closed,
    closing_distance,
    near_density,
    quarter_turn,
    sample_ahead,
    sample_near,
    shortened,
)
from .gate_sampling import pulse_in_gate
from .laser import channel_of
from .media import coefficients, collision, interaction, narrowest_peak, transmittance
from .mitsuba_tables import has_tables, off_the_poles
from .polarization import apply_phase_function, rotate_stokes, transverse
from .random_numbers import pair
from .resampling import choose
from .surfaces import Air, media_of
from .variant_types import (
    Float,
    Frame,
    Generator,
    Interaction,
    Mask,
    MediumPtr,
    Point,
    Scene,
    Sensor,
    Stokes,
    UInt,
    Vector,
)

Products: TypeAlias = Mapping[tuple[int, int], Float]
"""Sums of products of two Stokes components, by their indices."""

SPEED_OF_LIGHT = 299_792_458.0
FWHM_TO_SIGMA = 0.42466090014400953  # 1 / (2 sqrt(2 ln 2))

# Of first vertices, the fraction sampled anywhere in front of the gate, and of the others that
# sampled where isotropic scattering closes paths most often.
EVEN_FRACTION = 0.3
NEAR_FRACTION = 0.35
# Of intermediate flights, the fraction with directions sampled from the phase function; the others
# mostly stay in a field of view that is wider than the telescope's by this factor.
PHASE_FLIGHT_FRACTION = 0.4
WIDER = 2.5
# Of intermediate flights, the fraction that ends anywhere on the way to the gate, as likely in each
# part of it; the others end in front of where the path would close.
EVEN_FLIGHT_FRACTION = 0.6
# Distances in front of that place are sampled evenly in their logarithm, beyond half the radius of
# the field of view or, if that is less, this fraction of the width of the forward peak times the
# way back through air: light scattered back is scattered forwards again on that way.
NEAREST = 0.03
# Least of them, over half the field's radius.
LEAST_NEAREST = 1e-6
# Russian roulette: probability of survival over the weight.
ROULETTE_FACTOR = 30.0
# Of the way to a surface, what is left out in front of it.
SKIN = 1e-6


class Sample:
    """Monte Carlo samples at the laser, each with the telescope point it will be connected to.

    World coordinates. ``frame`` holds the beam's axes in the lidar's own frame and ``start`` its
    origin there, ``axes`` its axes in the world, ``time`` its time. ``delay`` is half the light
    path (m) by which the sample is emitted after the middle of the pulse. ``stokes`` refers to
    ``mi.mueller.stokes_basis(direction)``.
    """

    def __init__(
        self,
        rng: Generator,
        frame: Frame,
        start: Point,
        time: Float,
        axes: Frame,
        origin: Point,
        direction: Vector,
        aperture: Point,
        delay: Float,
        stokes: Stokes,
    ) -> None:
        self.rng, self.frame, self.start, self.time, self.axes = rng, frame, start, time, axes
        self.origin, self.direction, self.aperture = origin, direction, aperture
        self.delay, self.stokes = delay, stokes


class Orders:
    """Sums of S0 by scattering order, in rows of few samples: one sum of millions loses digits."""

    def __init__(self, rows: int, max_order: int) -> None:
        self.sums = dr.zeros(mi.Float, rows * max_order)
        dr.make_opaque(self.sums)
        self.rows, self.max_order = dr.opaque(mi.UInt32, rows), max_order

    def add(self, value: Float, order: UInt, row: UInt, active: Mask = True) -> None:
        """Add values of samples, each to its row."""
        add(self.sums, value, (order - 1) * self.rows + row, active)

    def totals(self, parts: int) -> list[Float]:
        """Of each order, the sums of so many rows each."""
        row = dr.arange(mi.UInt32, dr.width(self.sums) // self.max_order)
        first = (self.rows * dr.opaque(mi.UInt32, k) for k in range(self.max_order))
        return [dr.block_sum(dr.gather(mi.Float, self.sums, row + k), parts) for k in first]


class Lidar:
    """A scene and the lidar in it: emission, scattering and connection of a wavefront."""

    def __init__(
        self, scene: Scene, sensor: Sensor, bounds: Bounds, differentiable: bool = False
    ) -> None:
        self.air, self.sensor = Air(scene, sensor), sensor
        self.bounds, self.differentiable = bounds, differentiable
        self.rounded = has_tables(media_of(scene, sensor))
        self.low, self.high = self.air.bounds
        self.wavelengths = sensor.laser.wavelengths()
        self.channel = channel_of(sensor.laser.wavelength)
        self.area = sensor.aperture_area()
        # standard deviation of the delays in range, half the path
        self.pulse_sigma = None
        if sensor.laser.pulse_duration > 0:
            sigma = FWHM_TO_SIGMA * sensor.laser.pulse_duration * SPEED_OF_LIGHT / 2
            self.pulse_sigma = dr.opaque(mi.Float, sigma)
        self.context = mi.PhaseFunctionContext()
        self.peak = narrowest_peak(media_of(scene, sensor), self.wavelengths)
        # replaced by that of each sample's beam in `emit`
        self.field_tan = sensor.field_tangent(mi.UInt32(0))
        # last vertices drawn in the field of view that rounding puts outside
        self.rejected = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self.rejected)

    def emit(self, rng: Generator, beam: UInt) -> Sample:
        """Samples of beams by their index."""
        sensor = self.sensor
        self.field_tan = sensor.field_tangent(beam)
        to_world = sensor.world_transform()
        frame = sensor.beam_frame(beam)
        start, time = sensor.beam_origin(beam), sensor.beam_time(beam)
        origin, direction, aperture = self._ends(rng, frame, start)
        axes = mi.Frame3f(*(to_world @ axis for axis in (frame.s, frame.t, frame.n)))
        delay = mi.Float(0)
        if self.pulse_sigma is not None:
            delay = self.pulse_sigma * mi.warp.square_to_std_normal(pair(rng)).x
        stokes = self._emitted(axes, direction)
        return Sample(rng, frame, start, time, axes, origin, direction, aperture, delay, stokes)

    def _ends(self, rng: Generator, frame: Frame, start: Point) -> tuple[Point, Vector, Point]:
        """Origin and direction of a ray of the laser, and a point of the telescope."""
        sensor, to_world = self.sensor, self.sensor.world_transform()
        origin, direction = sensor.laser.sample_local(pair(rng), pair(rng))
        pose = sensor.laser.m_pose
        origin = to_world @ mi.Point3f(start + frame.to_world(mi.Vector3f(pose @ origin)))
        direction = dr.normalize(to_world @ frame.to_world(pose @ direction))
        aperture = to_world @ mi.Point3f(start + sensor.sample_aperture(frame, pair(rng)))
        return origin, direction, aperture

    def _emitted(self, axes: Frame, direction: Vector) -> Stokes:
        """The laser's Stokes vector about Mitsuba's axes of a direction."""
        if not mi.is_polarized:
            return [mi.Float(1)]
        laser = self.sensor.laser
        return rotate_stokes(
            laser.m_stokes,
            direction,
            transverse(axes.to_world(laser.m_pose @ mi.Vector3f(1, 0, 0)), direction),
            mi.mueller.stokes_basis(direction),
        )

    def single(self, sample: Sample, path: Float, width: Float) -> Stokes:
        """Stokes vector (about e_h) of the light scattered once, for whole paths of a length.

        ``width`` is that of the gate, as whole path, over the density of ``path`` relative to a
        uniform one.
        """
        medium = mi.MediumPtr(self.sensor.get_medium())
        closure, volume = closed(sample.origin, sample.direction, sample.aperture, path)
        (received,) = self._connect(
            sample,
            sample.rng,
            sample.origin,
            sample.direction,
            closure,
            medium,
            [sample.stokes],
            width * volume,
            (path > 0) & (closure > 0),
        )
        return received

    def reflected(self, sample: Sample, low: Float, high: Float) -> Stokes:
        """Stokes vector (about e_h) of the light that a diffuse surface reflects to the telescope.

        ``low`` and ``high`` are twice the gate's ranges less the sample's delay.
        """
        si, back, path = self._target(sample)
        active = (path >= low) & (path < high)
        medium = mi.MediumPtr(self.sensor.get_medium())
        # ends in front of the surface, which would occlude itself
        out, medium = transmittance(
            self.air,
            self.bounds,
            medium,
            sample.origin,
            sample.direction,
            si.t * (1 - SKIN),
            self.channel,
            self.wavelengths,
            sample.time,
            sample.rng,
            active,
            self.differentiable,
        )
        return self._from_target(sample, sample.rng, si, back, medium, out, active)

    def _target(self, sample: Sample) -> tuple[Interaction, Vector, Float]:
        """Where a sample meets a diffuse surface, the way back, and the length of the path."""
        ray = mi.Ray3f(sample.origin, sample.direction, sample.time, self.wavelengths)
        si = self.air.targets.ray_intersect(ray)
        back = sample.aperture - si.p
        return si, back, si.t + dr.norm(back)

    def _from_target(
        self,
        sample: Sample,
        rng: Generator,
        si: Interaction,
        back: Vector,
        medium: MediumPtr,
        weight: Float,
        active: Mask,
    ) -> Stokes:
        """Light from a diffuse surface at the telescope, unpolarised, of light of that weight."""
        distance = dr.norm(back)
        wo = back / distance
        active = active & si.is_valid() & self._in_view(sample.axes, -back)
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(wo), active)
        value = (value[0, 0] if mi.is_polarized else value)[self.channel]
        active = active & (value > 0)
        place = si.spawn_ray(wo).o
        out, _ = transmittance(
            self.air,
            self.bounds,
            medium,
            place,
            wo,
            distance,
            self.channel,
            self.wavelengths,
            sample.time,
            rng,
            active,
            self.differentiable,
        )
        cosine = -dr.dot(wo, sample.axes.n)
        light = weight * out * value * self.area * cosine / dr.square(distance)
        return [dr.select(active, light, 0), mi.Float(0), mi.Float(0), mi.Float(0)]

    @dr.syntax
    def by_contribution(
        self, sample: Sample, low: Float, high: Float, candidates: UInt
    ) -> tuple[Sample, Float, Float]:
        """A sample of light scattered once, of several by its contribution; its path and weight.

        ``low`` and ``high`` are twice the gate's ranges. Candidates have rays of the laser and
        points of the telescope of their own. The gate and the pulse distribute their whole paths,
        each of which is drawn from another of so many equally probable parts. Contributions are
        compared without attenuation and phase function (resampled importance sampling, Talbot et
        al. 2005). Not for scenes with open surfaces, whose media are known behind one another only.
        """
        rng, axes, time = sample.rng, sample.axes, sample.time
        around = mi.MediumPtr(self.sensor.get_medium())
        origin, direction = mi.Point3f(sample.origin), mi.Vector3f(sample.direction)
        aperture, path = mi.Point3f(sample.aperture), mi.Float(0)
        total, target, number = mi.Float(0), mi.Float(0), mi.UInt32(0)
        pulse = None if self.pulse_sigma is None else 2 * self.pulse_sigma
        while dr.hint(number < candidates, label="candidates"):
            start, onward, end = self._ends(rng, sample.frame, sample.start)
            part = (mi.Float(number) + rng.next_float32()) / mi.Float(candidates)
            length, weight = pulse_in_gate(part, low, high, pulse)
            closure, volume = closed(start, onward, end, length)
            place = start + onward * closure
            active = (length > 0) & (closure > 0)
            active &= self._in_view(axes, place - end)
            crossings = self.air.crossings(start, onward)
            _, _, _, medium, _ = self.air.next_surface(
                crossings, start, onward, closure, mi.Float(dr.inf), around, active
            )
            active &= medium != None
            mei = interaction(medium, place, onward, self.wavelengths, time)
            scattering, _ = coefficients(medium, mei, self.channel, active)
            contribution = scattering * volume / dr.squared_norm(place - end)
            counts = dr.select(active, weight * contribution, 0)
            total += counts
            takes = rng.next_float32() * total < counts
            origin, direction = dr.select(takes, start, origin), dr.select(takes, onward, direction)
            aperture, path = dr.select(takes, end, aperture), dr.select(takes, length, path)
            target = dr.select(takes, contribution, target)
            number += 1
        chosen_weight = dr.select(target > 0, total / (target * mi.Float(candidates)), 0)
        chosen = Sample(
            rng,
            sample.frame,
            sample.start,
            time,
            axes,
            origin,
            direction,
            aperture,
            sample.delay,
            self._emitted(axes, direction),
        )
        return chosen, path, chosen_weight

    def further(
        self,
        sample: Sample,
        low: Float,
        high: Float,
        position: Float,
        max_order: UInt,
        by_order: Orders | None,
        row: UInt,
    ) -> Stokes:
        """The sum of all orders from the second up to ``max_order``, as `single` gives the first.

        ``low`` and ``high`` are twice the gate's ranges less the sample's delay, ``position`` (0
        to 1) is the place of the sample's whole path between them. Each order's S0 is also added
        to ``by_order``.
        """
        medium = mi.MediumPtr(self.sensor.get_medium())
        path = dr.lerp(low, high, position)
        return self._further(sample, medium, path, high - low, max_order, by_order, row)

    @dr.syntax
    def _further(
        self,
        sample: Sample,
        medium: MediumPtr,
        path: Float,
        width: Float,
        last: UInt,
        by_order: Orders | None,
        row: UInt,
    ) -> Stokes:
        """Orders from two on: the path is closed once from every vertex but the last."""
        # local names, as the loop records local variables only
        aperture, rng = sample.aperture, sample.rng
        total, order = _copied([0, 0, 0, 0]), mi.UInt32(2)
        medium = mi.MediumPtr(medium)
        position, direction = mi.Point3f(sample.origin), mi.Vector3f(sample.direction)
        stokes = _copied(sample.stokes)
        flight, excess, weight = self._first_flight(rng, position, direction, aperture, path)
        active = flight > 0
        while dr.hint(active, label="scattering orders"):
            out, medium = transmittance(
                self.air,
                self.bounds,
                medium,
                position,
                direction,
                flight,
                self.channel,
                self.wavelengths,
                sample.time,
                rng,
                active,
            )
            active &= medium != None
            position = mi.Point3f(position + direction * flight)
            mei = interaction(medium, position, direction, self.wavelengths, sample.time)
            scattering, _ = coefficients(medium, mei, self.channel, active)
            weight *= out * scattering
            # no roulette at the first vertex: all light of two scatterings passes it, and in thin
            # air its weight is always small
            survival = dr.select(order == 2, 1, dr.minimum(ROULETTE_FACTOR * weight, 1))
            active &= (weight > 0) & (rng.next_float32(active) < survival)
            stokes = _scaled(stokes, dr.select(active, weight / survival, 0))
            open_path, gains, active = self._close(
                sample, rng, medium, mei, stokes, excess, width, active
            )
            gain = gains[0]
            total = _sum(total, gain)
            _split(by_order, gain[0], order, row, active)

            order += 1
            active &= order <= last
            direction, stokes, flight, excess, weight = self._next_flight(
                rng, medium, mei, stokes, open_path, active
            )
            active &= weight > 0
        return total

    def _close(
        self,
        sample: Sample,
        rng: Generator,
        medium: MediumPtr,
        mei: Interaction,
        stokes: Stokes,
        excess: Float,
        width: Float,
        active: Mask,
        others: Sequence[Stokes] = (),
    ) -> tuple[OpenPath, list[Stokes], Mask]:
        """The path closed by one more vertex.

        ``excess`` is that of the remaining path, handed on from flight to flight: as the difference
        of path and distance it would have few digits. Returns the open path at the vertex, the
        Stokes vectors of the light about e_h of ``stokes`` and of ``others``, and where the path is
        still open.
        """
        away = mei.p - sample.aperture
        distance = dr.norm(away)
        away = away / distance
        active = active & (excess > 0)
        _, reach = slabs(self.low, self.high, mei.p, -away)
        # as long as the path is open, its remainder exceeds the straight way back
        open_path = OpenPath(away, distance, excess, self._half_field(sample.axes, away), reach)
        with dr.suspend_grad():
            closing, scattered, leg, volume = self._last_flight(
                rng, sample, medium, mei, stokes, open_path, active
            )
        if self.differentiable:
            # of a direction that stays where it was drawn
            scattered, _ = self._scatter(medium, mei, stokes, closing, volume > 0)
        several = [scattered]
        if others:
            more, _ = self._scatter_all(medium, mei, others, closing, volume > 0)
            several += more
        # once more by the coordinates that the connection uses
        end = mei.p + closing * leg - sample.aperture
        self._reject((volume > 0) & ~self._in_view(sample.axes, end))
        gains = self._connect(
            sample, rng, mei.p, closing, leg, medium, several, width * volume, volume > 0
        )
        return open_path, gains, active

    def _reject(self, lost: Mask) -> None:
        """Count samples that left their sampler's domain."""
        dr.scatter_reduce(
            dr.ReduceOp.Add,
            self.rejected,
            mi.UInt32(1),
            mi.UInt32(0),
            lost,
            mode=dr.ReduceMode.Local,
        )

    def _first_flight(
        self, rng: Generator, origin: Point, direction: Vector, aperture: Point, path: Float
    ) -> tuple[Float, Float, Float]:
        """Length of a first flight, the excess length that it leaves, the inverse of its density.

        The length is -1 where there is no air.
        """
        offset = origin - aperture
        reach = closing_distance(offset, direction, path)
        enters, leaves = slabs(self.low, self.high, origin, direction)
        least, most = reach - dr.minimum(leaves, reach), reach - dr.maximum(enters, 0)
        # half the field of view's radius at half the path: nearer vertices send most of what they
        # scatter through the field, farther ones past it
        scale = 0.25 * path * self.field_tan
        choice, near = pair(rng), sample_near(least, most, scale, pair(rng), rng.next_float32())
        # for phase functions with a stronger forward peak than the isotropic one, and for paths
        # that go on
        depth, nearest = most - least, least + self._nearest(scale, most)
        ahead = least + sample_ahead(depth, nearest, choice.y)
        gap = dr.select(choice.x < NEAR_FRACTION * (1 - EVEN_FRACTION), near, ahead)
        gap = dr.select(choice.x > 1 - EVEN_FRACTION, dr.lerp(least, most, choice.y), gap)
        density = dr.lerp(
            ahead_density(gap - least, depth, nearest),
            near_density(gap, least, most, scale),
            NEAR_FRACTION,
        )
        density = dr.lerp(density, dr.rcp(depth), EVEN_FRACTION)
        excess = shortened(offset + direction * reach, direction, gap)
        flight = dr.select((path > 0) & (most > least), reach - gap, -1)
        return flight, excess, dr.rcp(density)

    def _nearest(self, scale: Float, way: Float) -> Float:
        """Distance from which on places in front of the one that closes a path are sampled."""
        return dr.clip(NEAREST * self.peak * way, LEAST_NEAREST * scale, scale)

    def _half_field(self, axes: Frame, away: Vector) -> Float:
        """Tangent of half the widest angle between a direction and one of the field of view."""
        local = axes.to_local(away)
        vertex = dr.norm(local.xy) / (1 + local.z)
        # the tangent of half the angle
        field = self.field_tan / (1 + dr.sqrt(1 + dr.square(self.field_tan)))
        return dr.select(vertex * field < 1, (vertex + field) / (1 - vertex * field), dr.inf)

    def _in_view(self, axes: Frame, to_source: Vector) -> Mask:
        return self.sensor.in_field_of_view(axes, to_source, self.field_tan)

    def _last_flight(
        self,
        rng: Generator,
        sample: Sample,
        medium: MediumPtr,
        mei: Interaction,
        stokes: Stokes,
        open_path: OpenPath,
        active: Mask,
    ) -> tuple[Vector, Stokes, Float, Float]:
        """Direction, Stokes vector and length of the flight to the last vertex; its weight.

        Of three candidates, one from the phase function, one towards the field of view and one from
        the telescope, selected by its contribution if there is no obstacle and the medium is the
        same. The weight includes d(length)/d(path).
        """
        phase, axes = medium.phase_function(), sample.axes
        path = open_path.distance + open_path.excess
        drawn, _, _ = phase.sample(self.context, mei, rng.next_float32(active), pair(rng), active)
        aimed = open_path.sample(open_path.excess, pair(rng))
        inward = open_path.from_telescope(self._in_field(axes, rng))
        tried = []
        for wo in (drawn, aimed, inward):
            one_plus_cosine = open_path.one_plus_cosine(wo)
            leg = open_path.leg(open_path.excess, one_plus_cosine)
            volume = dr.rcp(open_path.slope(open_path.excess, one_plus_cosine, leg))
            end = mei.p + wo * leg
            # not from the end's coordinates, which are rounded to those of the world
            to_end = open_path.away * open_path.distance + wo * leg
            in_view = active & self._in_view(axes, to_end)
            if wo is inward:
                self._reject(active & ~in_view)
            # both legs meet the ellipsoid at the same angle
            from_telescope = dr.square(leg / (path - leg)) / self._field_solid_angle()
            from_telescope = dr.select(in_view, from_telescope, 0)
            in_view &= dr.all((end > self.low) & (end < self.high))
            scattered, pdf = self._scatter(medium, mei, stokes, wo, in_view)
            last_vertex = interaction(medium, end, wo, self.wavelengths, sample.time)
            back = dr.normalize(sample.aperture - end)
            received, back_pdf = self._scatter(medium, last_vertex, scattered, back, in_view)
            density = pdf + open_path.density(open_path.excess, wo) + from_telescope
            # never 0 where there may be light: the medium may be a different one there
            target = (0.95 * received[0] + 0.05 * scattered[0] * back_pdf) * volume
            target = dr.select(in_view & (density > 0), target, 0)
            tried.append((target, density, (wo, scattered, leg, volume)))
        (wo, scattered, leg, volume), weight = choose(rng, *tried)
        return wo, scattered, leg, volume * weight

    def _next_flight(
        self,
        rng: Generator,
        medium: MediumPtr,
        mei: Interaction,
        stokes: Stokes,
        open_path: OpenPath,
        active: Mask,
    ) -> tuple[Vector, Stokes, Float, Float, Float]:
        """A further flight: direction, Stokes vector (of unchanged S0), length, excess, weight.

        The excess length is what the flight leaves.
        """
        phase, open_path = medium.phase_function(), open_path.widened(WIDER)
        by_phase = rng.next_float32(active) < PHASE_FLIGHT_FRACTION
        drawn, _, _ = phase.sample(self.context, mei, rng.next_float32(active), pair(rng), active)
        most, scale = 0.5 * open_path.excess, 0.5 * open_path.distance * self.field_tan
        nearest = self._nearest(scale, open_path.reach)
        # transmittances to the gate differ little: any part of the way is about as likely
        choice, sample = pair(rng), pair(rng)
        even = choice.x < EVEN_FLIGHT_FRACTION
        gap = dr.select(even, most * choice.y, sample_ahead(most, nearest, choice.y))
        mirrored = mi.Point2f(1 - sample.x, sample.y + 0.25)
        used = open_path.excess - 2 * gap
        # two candidates, with opposite azimuth and complementary polar sample
        tried = []
        for wo in (
            dr.select(by_phase, drawn, open_path.sample(used, sample)),
            dr.select(by_phase, quarter_turn(-mei.wi, drawn), open_path.sample(used, mirrored)),
        ):
            one_plus_cosine = open_path.one_plus_cosine(wo)
            # what is drawn after its direction is a length, so that it ends in the air
            _, leaves = slabs(self.low, self.high, mei.p, wo)
            whole = open_path.leg(open_path.excess, one_plus_cosine)
            longest = dr.minimum(whole, leaves)
            short = sample_ahead(longest, nearest, choice.y)
            short = dr.select(even, longest * choice.y, short)
            leg = dr.select(by_phase, longest - short, open_path.leg(used, one_plus_cosine))
            half_excess = 0.5 * dr.select(
                by_phase, open_path.remaining(wo, whole - longest + short, whole), 2 * gap
            )
            scattered, pdf = self._scatter(medium, mei, stokes, wo, active)
            consumed = open_path.excess - 2 * half_excess
            density = open_path.density(consumed, wo)
            density *= 0.5 * open_path.slope(consumed, one_plus_cosine, leg)
            density *= _even_or_ahead(half_excess, most, nearest)
            pdf *= _even_or_ahead(dr.select(by_phase, short, longest - leg), longest, nearest)
            density = 2 * dr.lerp(density, pdf, PHASE_FLIGHT_FRACTION)
            end = mei.p + wo * leg
            inside = (
                active
                & (leg > 0)
                & (half_excess > 0)
                & dr.all((end > self.low) & (end < self.high))
            )
            target = dr.select(inside & (density > 0), scattered[0], 0)
            tried.append((target, density, (wo, scattered, leg, 2 * half_excess)))
        (wo, scattered, leg, excess), weight = choose(rng, *tried)
        # the change of S0 goes into the weight, on which roulette is played
        factor = dr.select(weight > 0, stokes[0] / scattered[0], 0)
        weight = dr.select(factor > 0, weight / factor, 0)
        return wo, _scaled(scattered, factor), leg, excess, weight

    def _field_solid_angle(self) -> Float:
        cosine = dr.rsqrt(1 + dr.square(self.field_tan))
        return dr.two_pi * dr.square(self.field_tan * cosine) / (1 + cosine)

    def _in_field(self, axes: Frame, rng: Generator) -> Vector:
        """A direction of the field of view, uniform in solid angle."""
        sample = pair(rng)
        # 1 - cos, without the difference of numbers next to one: fields of view are milliradians
        below = sample.x * self._field_solid_angle() * dr.inv_two_pi
        sine = dr.safe_sqrt(below * (2 - below))
        sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample.y)
        return axes.to_world(mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, 1 - below))

    def _connect(
        self,
        sample: Sample,
        rng: Generator,
        position: Point,
        direction: Vector,
        distance: Float,
        medium: MediumPtr,
        several: Sequence[Stokes],
        volume: Float,
        active: Mask,
    ) -> list[Stokes]:
        """Scatter at ``distance`` along a flight, where the path closes: Stokes vectors about e_h.

        ``volume``: width of the gate (as whole path) times d(distance)/d(path).
        """
        vertex = position + direction * distance
        active = active & self._in_view(sample.axes, vertex - sample.aperture)
        out, medium = transmittance(
            self.air,
            self.bounds,
            medium,
            position,
            direction,
            distance,
            self.channel,
            self.wavelengths,
            sample.time,
            rng,
            active,
            self.differentiable,
        )
        mei = interaction(medium, vertex, direction, self.wavelengths, sample.time)
        active = active & (medium != None)
        scattering, _ = coefficients(medium, mei, self.channel, active)
        return self._receive(sample, rng, medium, mei, several, active, out * scattering * volume)

    def _receive(
        self,
        sample: Sample,
        rng: Generator,
        medium: MediumPtr,
        mei: Interaction,
        several: Sequence[Stokes],
        active: Mask,
        weight: Float,
    ) -> list[Stokes]:
        """Next-event estimation from an interaction to the telescope point."""
        back = sample.aperture - mei.p
        distance = dr.norm(back)
        wo = back / distance
        active = active & self._in_view(sample.axes, -back)
        out, _ = transmittance(
            self.air,
            self.bounds,
            medium,
            mei.p,
            wo,
            distance,
            self.channel,
            self.wavelengths,
            sample.time,
            rng,
            active,
            self.differentiable,
        )
        # the telescope's point is uniform on its disc: area, cosine and distance make it a solid
        # angle
        weight = weight * out * self.area * -dr.dot(wo, sample.axes.n) / (distance * distance)
        several, _ = self._scatter_all(medium, mei, several, wo, active)
        axis = mi.mueller.stokes_basis(wo) if mi.is_polarized else None
        light = []
        for received in several:
            if not mi.is_polarized:
                received = [*received, mi.Float(0), mi.Float(0), mi.Float(0)]
            else:
                received = rotate_stokes(received, wo, axis, transverse(sample.axes.s, wo))
            light.append([dr.select(active, r * weight, 0) for r in received])
        return light

    def _scatter(
        self, medium: MediumPtr, mei: Interaction, stokes: Stokes, wo: Vector, active: Mask
    ) -> tuple[Stokes, Float]:
        """Stokes vector after scattering into a direction (per steradian), and its pdf."""
        (scattered,), pdf = self._scatter_all(medium, mei, [stokes], wo, active)
        return scattered, pdf

    def _scatter_all(
        self,
        medium: MediumPtr,
        mei: Interaction,
        several: Sequence[Stokes],
        wo: Vector,
        active: Mask,
    ) -> tuple[list[Stokes], Float]:
        """The same of several Stokes vectors."""
        if self.rounded:
            # Mitsuba's tables are 0 where rounding puts a cosine beyond 1
            wo = off_the_poles(mei.wi, wo)
        value, pdf = medium.phase_function().eval_pdf(self.context, mei, wo, active)
        return [apply_phase_function(value, stokes, self.channel) for stokes in several], pdf

    def unscattered(self, sample: Sample, low: Float, high: Float) -> tuple[Stokes, Float, Mask]:
        """Light that meets a diffuse surface and no air on its way, of an analog free flight.

        It is the first one of `analog`, with the same random numbers. ``low`` and ``high`` are
        ranges. Returns the Stokes vector (about e_h), the range, and where there is light.
        """
        rng, active = mi.PCG32(sample.rng), mi.Bool(True)
        medium = mi.MediumPtr(self.sensor.get_medium())
        si, back, path = self._target(sample)
        range_ = 0.5 * path + sample.delay
        near = si.t * (1 - SKIN)
        _, medium, collided = collision(
            self.air,
            self.bounds,
            medium,
            sample.origin,
            sample.direction,
            2 * (high - sample.delay),
            self.channel,
            self.wavelengths,
            sample.time,
            rng,
            active,
        )
        first, _ = first_hit(self.air.opaque, sample.origin, sample.direction, active)
        active = ~collided & (first >= near) & (range_ >= low) & (range_ < high)
        light = self._from_target(sample, rng, si, back, medium, mi.Float(1), active)
        return light, range_, active & (light[0] > 0)

    @dr.syntax
    def analog(
        self,
        sample: Sample,
        max_order: UInt,
        row: UInt,
        parts: UInt,
        gates: UInt,
        sums: Sequence[Float],
        products: Products,
        largest: UInt,
        magnified: float,
        by_order: Orders | None,
    ) -> None:
        """Analog free flights; every collision is connected to the telescope.

        Adds contributions to ``sums``, and their products, each factor ``magnified``, to
        ``products``; ``largest`` becomes the bits of the largest square. ``row`` is a sample's
        place in them for the first gate, ``parts`` the step from gate to gate.

        A sample's apparent range does not decrease from one order to the next (triangle
        inequality), so its contribution to a gate is complete when a later gate is reached: only
        then is it squared.
        """
        rng, aperture = sample.rng, sample.aperture
        low, high = self.sensor.ranges(sample.frame.n, sample.start)
        position, direction = mi.Point3f(sample.origin), mi.Vector3f(sample.direction)
        stokes = _copied(sample.stokes)
        medium = mi.MediumPtr(self.sensor.get_medium())
        travelled, order = mi.Float(2 * sample.delay), mi.UInt32(1)
        gate, in_gate = mi.UInt32(0), _copied([0, 0, 0, 0])
        active = mi.Bool(True)
        if dr.hint(self.air.targets is not None, mode="scalar"):
            # a sample of whose light none is scattered in the air: it adds to no other
            light, place, meets = self.unscattered(sample, low, high)
            at = mi.UInt32(dr.select(meets, (place - low) / (high - low) * gates, 0))
            at = row + dr.minimum(at, gates - 1) * parts
            _deposit(sums, products, largest, magnified, at, light, meets)
            _split(by_order, light[0], order, at, meets)
        while dr.hint(active, label="scattering orders"):
            began = mi.Bool(active)
            flight, medium, active = collision(
                self.air,
                self.bounds,
                medium,
                position,
                direction,
                2 * high - travelled,
                self.channel,
                self.wavelengths,
                sample.time,
                rng,
                active,
            )
            position = mi.Point3f(position + direction * flight)
            travelled += flight
            mei = interaction(medium, position, direction, self.wavelengths, sample.time)
            scattering, extinction = coefficients(medium, mei, self.channel, active)
            # absorption weighs, and ends no sample
            albedo = dr.select(active, scattering / extinction, 0)
            stokes = _scaled(stokes, albedo)
            range_ = 0.5 * (travelled + dr.norm(aperture - position))
            fraction = (range_ - low) / (high - low)
            counts = active & (fraction >= 0) & (fraction < 1)
            # the distance to the last vertex is drawn, not forced: it has no weight of its own
            gains = self._receive(sample, rng, medium, mei, [stokes], counts, mi.Float(1))
            gain = gains[0]
            now = dr.minimum(mi.UInt32(dr.select(counts, fraction * gates, 0)), gates - 1)
            now = dr.select(counts, now, gate)
            done = now != gate
            _deposit(sums, products, largest, magnified, row + gate * parts, in_gate, done)
            in_gate = _sum(_scaled(in_gate, dr.select(done, 0, 1)), gain)
            gate = now
            _split(by_order, gain[0], order, row + gate * parts, counts)
            order += 1
            # later orders arrive from farther away still
            active &= (order <= max_order) & (range_ < high)
            onward, value, density = medium.phase_function().sample(
                self.context, mei, rng.next_float32(active), pair(rng), active
            )
            stokes = apply_phase_function(value, stokes, self.channel)
            direction = mi.Vector3f(onward)
            active &= (density > 0) & (stokes[0] > 0)
            ended = began & ~active
            _deposit(sums, products, largest, magnified, row + gate * parts, in_gate, ended)


def _split(by_order: Orders | None, value: Float, order: UInt, row: UInt, active: Mask) -> None:
    if by_order is not None:
        by_order.add(value, order, row, active)


def _even_or_ahead(distance: Float, most: Float, nearest: Float) -> Float:
    """Density of where intermediate flights end in front of the place where paths close."""
    ahead = ahead_density(distance, most, nearest)
    return dr.lerp(ahead, dr.rcp(most), EVEN_FLIGHT_FRACTION)


def add(total: Float, value: Float, cell: UInt, active: Mask = True) -> None:
    """Add values of samples to the sums of their cells."""
    # the default mode would compile the number of cells into the kernel
    dr.scatter_reduce(dr.ReduceOp.Add, total, value, cell, active, mode=dr.ReduceMode.Local)


def _deposit(
    sums: Sequence[Float],
    products: Products,
    largest: UInt,
    magnified: float,
    cell: UInt,
    light: Stokes,
    active: Mask,
) -> None:
    """Add contributions of samples to their gates, and products of their components."""
    active = active & (light[0] != 0)
    for total, value in zip(sums, light, strict=True):
        add(total, value, cell, active)
    for (i, j), total in products.items():
        add(total, magnified * light[i] * (magnified * light[j]), cell, active)
    # positive floats are ordered as their bits, of which every backend has an atomic maximum
    square = dr.reinterpret_array(mi.UInt32, dr.square(magnified * light[0]))
    dr.scatter_reduce(dr.ReduceOp.Max, largest, square, cell, active, mode=dr.ReduceMode.Local)


def _copied(stokes: Sequence[Float]) -> Stokes:
    return [mi.Float(s) for s in stokes]


def _sum(first: Stokes, second: Stokes) -> Stokes:
    return [a + b for a, b in zip(first, second, strict=True)]


def _scaled(stokes: Stokes, factor: Float) -> Stokes:
    return [s * factor for s in stokes]
