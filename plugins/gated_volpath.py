"""
.. _integrator-gated_volpath:

Time-gated polarised volume transport (``gated_volpath``)
---------------------------------------------------------

Renders all beams of a :ref:`scanning_lidar <sensor-scanning_lidar>` in one wavefront: for every
beam and gate the Stokes vector of the received light as *received energy over emitted pulse
energy*, and the standard error of its first component.

============================ ======= ======================================================= =======
Parameter                    Type    Meaning                                                 Default
============================ ======= ======================================================= =======
``max_order``                int     highest scattering order; only 1, single scattering,    1
                                     is available
``estimator``                string  ``gated``: the collision is forced into the gate;       gated
                                     ``analog``: free flights as nature draws them, most
                                     photons miss the gate (for validation)
``samples_per_pass``         int     photons in flight at once; bounds the memory, does not  4194304
                                     change the result
============================ ======= ======================================================= =======

Both estimators connect the collision to a sampled point of the telescope, check the field of view
and carry the transmittance of all media on the way; they have the same expectation.

``mi.render(scene)`` returns a tensor (height, width, 5 x gates) with the channels
``gateNNN.S0`` ... ``gateNNN.S3``, ``gateNNN.S0_stderr``, gate by gate; row 0 is the top of the
scan. The Stokes vector refers to the beam's horizontal axis e_h, as the emitted one does: to its
part across the returning light, as seen by an analyser fixed to the telescope. Unpolarised
variants carry intensity only: S1 to S3 are 0 there. In RGB variants the colour channel nearest to
the laser's wavelength is used.

``sample_count`` of the sensor's sampler (or ``spp``) is the number of photons a beam. The gated
estimator spreads them evenly over the gates and rounds up, so that every gate gets the same
number, at least two. Photons are independent; the random numbers of a photon depend on the seed,
its beam and its number alone. Phase functions that know no polarisation (``isotropic``, ``hg``)
depolarise completely.

.. code-block:: xml

    <integrator type="gated_volpath"> <string name="estimator" value="gated"/> </integrator>
"""

import drjit as dr
import mitsuba as mi

from .media import coefficients, collision, interaction, transmittance
from .parameters import choice, fail, whole
from .polarization import rotate_stokes, transverse

NAME, KIND = "gated_volpath", "integrator"

SPEED_OF_LIGHT = 299_792_458.0
STOKES = ("S0", "S1", "S2", "S3")
FWHM_TO_SIGMA = 0.42466090014400953  # 1 / (2 sqrt(2 ln 2))


def define():
    class GatedVolpath(mi.CppADIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.max_order = whole(props, NAME, "max_order", 1, 1)
            if self.max_order > 1:
                fail(NAME, "max_order", self.max_order, "1 (single scattering)")
            self.estimator = choice(props, NAME, "estimator", "gated", ("gated", "analog"))
            self.samples_per_pass = whole(props, NAME, "samples_per_pass", 1 << 22, 1)
            # called with (photons done, photons in all) after every pass, when set
            self.progress = None

        def aov_names(self):
            return []

        def channel_names(self, sensor) -> list[str]:
            """Names of the last axis of the rendered tensor."""
            return [
                f"gate{gate:03d}.{quantity}"
                for gate in range(sensor.gate_count)
                for quantity in (*STOKES, "S0_stderr")
            ]

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if isinstance(sensor, int):
                sensor = scene.sensors()[sensor]
            if not hasattr(sensor, "beam_frame"):
                fail(NAME, "sensor", type(sensor).__name__, "a sensor of type 'scanning_lidar'")
            _check_gate_meets_medium(scene, sensor)
            photons = int(spp) or sensor.sampler().sample_count()
            gates = sensor.gate_count
            if self.estimator == "gated":
                photons = gates * max(2, -(-photons // gates))
            elif photons < 2:
                fail(NAME, "sample_count", photons, "at least 2, for a standard error")
            seed = mi.UInt32(seed)
            dr.make_opaque(seed)  # a new seed compiles nothing
            with dr.suspend_grad():
                image = self._render_passes(scene, sensor, seed, photons)
            width, height = sensor.film().size()
            return mi.TensorXf(image, (height, width, gates * (len(STOKES) + 1)))

        def _render_passes(self, scene, sensor, seed, photons):
            """All beams, a few at a time; a beam's photons in several passes if they are many."""
            gates, beams = sensor.gate_count, sensor.beam_count
            # gated photons come in rounds of one photon a gate
            unit = gates if self.estimator == "gated" else 1
            rounds = photons // unit
            rounds_at_once = min(rounds, max(2, self.samples_per_pass // unit))
            beams_at_once = max(1, self.samples_per_pass // (rounds_at_once * unit))
            trace = self._gated if self.estimator == "gated" else self._analog
            quantities = len(STOKES) + 1
            image = dr.zeros(mi.Float, beams * gates * quantities)
            done = 0
            for first in range(0, beams, beams_at_once):
                count = min(beams_at_once, beams - first)
                total = None
                start = 0
                while start < rounds:
                    now = min(rounds_at_once, rounds - start)
                    if rounds - start - now == 1:
                        now += 1  # a pass of one photon has no variance
                    part = trace(scene, sensor, seed, first, count, start, now)
                    total = part if total is None else _merge(total, part)
                    start += now
                    done += count * now * unit
                    if self.progress:
                        dr.eval(total[1:])
                        dr.sync_thread()
                        self.progress(done, beams * photons)
                _, means, squares = total
                number = _opaque(total[0])
                cell = dr.arange(mi.UInt32, count * gates) + dr.opaque(mi.UInt32, first * gates)
                error = dr.sqrt(squares / (number * (number - 1.0)))
                for index, values in enumerate((*means, error)):
                    dr.scatter(image, values, cell * quantities + index)
                dr.eval(image)
            return image

        def _gated(self, scene, sensor, seed, first, count, start, rounds):
            """Mean Stokes vector and sum of squared deviations, collisions forced into the gates.

            A photon belongs to one gate; its range is uniform in the gate. The point of the
            laser's ray that closes the path laser - collision - telescope on twice that range is
            t = (4 R^2 - m^2) / (4 R + 2 m.d), with m from the telescope point to the ray's origin.
            """
            gates = sensor.gate_count
            lane = dr.arange(mi.UInt32, count * gates * rounds)
            # opaque, so that neither the number of photons nor the pass is baked into the kernel
            rounds_ = dr.opaque(mi.UInt32, rounds)
            cell = lane // rounds_
            beam, gate = cell // gates, cell % gates
            number = (lane - cell * rounds_ + dr.opaque(mi.UInt32, start)) * gates + gate
            beam += dr.opaque(mi.UInt32, first)
            photon = _Photon(scene, sensor, seed, beam, number)

            low, high = sensor.ranges(photon.frame.n)
            width = (high - low) / gates
            range_ = low + width * (gate + photon.random())
            half_path = range_ - photon.delay
            offset = photon.origin - photon.aperture
            along = dr.dot(offset, photon.direction)
            distance = (4 * half_path * half_path - dr.squared_norm(offset)) / (
                4 * half_path + 2 * along
            )
            active = (half_path > 0) & (distance > 0)
            out, medium = photon.transmittance(distance, active)
            position = photon.origin + photon.direction * distance
            mei = interaction(medium, position, photon.direction, photon.wavelengths)
            active &= medium != None
            scattering, _ = coefficients(medium, mei, photon.channel, active)
            back = photon.aperture - position
            # d(distance) / d(range)
            jacobian = 2 * dr.rcp(1 - dr.dot(photon.direction, dr.normalize(back)))
            weight = out * scattering * jacobian * width
            stokes = photon.connect(medium, mei, weight, active)
            return rounds, *_moments_by_block(stokes, rounds)

        def _analog(self, scene, sensor, seed, first, count, start, rounds):
            """The same, free flights as nature draws them."""
            gates = sensor.gate_count
            lane = dr.arange(mi.UInt32, count * rounds)
            rounds_ = dr.opaque(mi.UInt32, rounds)
            local = lane // rounds_
            number = lane - local * rounds_ + dr.opaque(mi.UInt32, start)
            photon = _Photon(scene, sensor, seed, local + dr.opaque(mi.UInt32, first), number)

            low, high = sensor.ranges(photon.frame.n)
            distance, medium, found = photon.collision(2 * high)
            position = photon.origin + photon.direction * distance
            mei = interaction(medium, position, photon.direction, photon.wavelengths)
            back = dr.norm(photon.aperture - position)
            share = (0.5 * (distance + back) + photon.delay - low) / (high - low)
            gate = mi.UInt32(dr.clip(share * gates, 0, gates - 1))
            found &= (share >= 0) & (share < 1)
            scattering, extinction = coefficients(medium, mei, photon.channel, found)
            stokes = photon.connect(medium, mei, scattering / extinction, found)
            return rounds, *_moments_by_scatter(stokes, local * gates + gate, count * gates, rounds)

        def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
            fail(NAME, "gradients", "requested", "rendering without gradients")

        def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
            fail(NAME, "gradients", "requested", "rendering without gradients")

        def to_string(self):
            return f"GatedVolpath[max_order={self.max_order}, estimator={self.estimator}]"

    return GatedVolpath


class _Photon:
    """The photons of a wavefront: emitted into their beams, each with its point of the telescope.

    Positions and directions are in world coordinates. ``delay`` is half the light path (m) by
    which the photon left after the middle of the pulse.
    """

    def __init__(self, scene, sensor, seed, beam, number):
        self.scene, self.sensor = scene, sensor
        self.rng = _generator(seed, beam, number)
        laser = sensor.laser
        self.wavelengths = laser.wavelengths()
        self.channel = _channel(laser.wavelength)
        to_world = sensor.world_transform()
        self.frame = sensor.beam_frame(beam)
        origin, direction = laser.sample_local(self._pair(), self._pair())
        self.origin = to_world @ mi.Point3f(self.frame.to_world(mi.Vector3f(origin)))
        self.direction = dr.normalize(to_world @ self.frame.to_world(direction))
        self.aperture = to_world @ sensor.sample_aperture(self.frame, self._pair())
        self.axes = mi.Frame3f(
            *(to_world @ axis for axis in (self.frame.s, self.frame.t, self.frame.n))
        )
        self.delay = mi.Float(0)
        if laser.pulse_duration > 0:
            sigma = FWHM_TO_SIGMA * laser.pulse_duration * SPEED_OF_LIGHT / 2
            self.delay = sigma * mi.warp.square_to_std_normal(self._pair()).x

    def random(self):
        return self.rng.next_float32()

    def _pair(self):
        return mi.Point2f(self.random(), self.random())

    def transmittance(self, distance, active):
        """Along the photon's way out: transmittance, and the medium at its end."""
        return transmittance(
            self.scene, self.sensor.get_medium(), self.origin, self.direction, distance,
            self.channel, self.wavelengths, self.rng, active,
        )  # fmt: skip

    def collision(self, distance):
        return collision(
            self.scene, self.sensor.get_medium(), self.origin, self.direction, distance,
            self.channel, self.wavelengths, self.rng, mi.Bool(True),
        )  # fmt: skip

    def connect(self, medium, mei, weight, active):
        """Next-event estimation: the Stokes vector that reaches the telescope point, about e_h."""
        back = self.aperture - mei.p
        distance = dr.norm(back)
        wo = back / distance
        active = active & self.sensor.in_field_of_view(self.axes, -back)
        home, _ = transmittance(
            self.scene, medium, mei.p, wo, distance,
            self.channel, self.wavelengths, self.rng, active,
        )  # fmt: skip
        weight = weight * home * self.sensor.aperture_area()
        weight *= -dr.dot(wo, self.axes.n) / (distance * distance)
        phase = medium.phase_function()
        value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo, active)
        if mi.is_polarized:
            stokes = self._scatter(value, wo)
        else:
            stokes = (value[self.channel], mi.Float(0), mi.Float(0), mi.Float(0))
        return [dr.select(active, s * weight, 0) for s in stokes]

    def _scatter(self, value, wo):
        """Mueller matrix of a phase function times the laser's Stokes vector."""
        matrix = [[value[row, column][self.channel] for column in range(4)] for row in range(4)]
        emitted = rotate_stokes(
            [mi.Float(s) for s in self.sensor.laser.stokes],
            self.direction,
            transverse(self.axes.s, self.direction),
            mi.mueller.stokes_basis(self.direction),
        )
        scattered = [sum(m * s for m, s in zip(row, emitted)) for row in matrix]
        # scalar phase functions answer with a multiple of the unit matrix in *any* pair of axes
        scalar = matrix[0][0]
        depolarises = (matrix[0][1] == 0) & (matrix[1][0] == 0)
        depolarises &= (matrix[1][1] == scalar) & (matrix[2][2] == scalar)
        depolarises &= matrix[3][3] == scalar
        scattered[1:] = [dr.select(depolarises, 0, s) for s in scattered[1:]]
        return rotate_stokes(
            scattered, wo, mi.mueller.stokes_basis(wo), transverse(self.axes.s, wo)
        )


def _generator(seed, beam, number):
    """Independent random numbers for every seed, beam and photon number."""
    key, counter = mi.sample_tea_32(seed, beam)
    state, stream = mi.sample_tea_32(key, counter + number)
    rng = mi.PCG32()
    rng.seed(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))
    return rng


def _channel(wavelength: float) -> int:
    """Index of the spectrum's entry that stands for the laser."""
    return (2 if wavelength < 490e-9 else 1 if wavelength < 580e-9 else 0) if mi.is_rgb else 0


def _opaque(number: float):
    """A number that changes from scan to scan without being compiled into a kernel."""
    return dr.opaque(mi.Float, number)


def _moments_by_block(stokes, count: int):
    """Means, and S0's sum of squared deviations, over runs of ``count`` photons."""
    dr.eval(stokes)
    means = [dr.block_sum(s, count) / _opaque(count) for s in stokes]
    run = dr.arange(mi.UInt32, dr.width(stokes[0])) // dr.opaque(mi.UInt32, count)
    deviation = stokes[0] - dr.gather(mi.Float, means[0], run)
    return means, dr.block_sum(deviation * deviation, count)


def _moments_by_scatter(stokes, cell, cells: int, count: int):
    """The same where a photon may fall into any cell; photons elsewhere count as zeros."""
    # all sums before any is read: reading one makes Dr.Jit run the kernel so far
    *sums, squares = (dr.zeros(mi.Float, cells) for _ in range(len(STOKES) + 1))
    for total, value in zip((*sums, squares), (*stokes, stokes[0] * stokes[0])):
        # the default mode would compile the number of cells into the kernel
        dr.scatter_reduce(dr.ReduceOp.Add, total, value, cell, value != 0, mode=dr.ReduceMode.Local)
    number = _opaque(count)
    means = [total / number for total in sums]
    return means, dr.maximum(squares - number * means[0] * means[0], 0)


def _merge(first, second):
    """Moments of two sets of photons together (Chan, Golub & LeVeque 1983)."""
    n1, means1, squares1 = first
    n2, means2, squares2 = second
    share, weight = _opaque(n2 / (n1 + n2)), _opaque(n1 * n2 / (n1 + n2))
    means = [a + (b - a) * share for a, b in zip(means1, means2)]
    difference = means2[0] - means1[0]
    return n1 + n2, means, squares1 + squares2 + difference * difference * weight


def _check_gate_meets_medium(scene, sensor):
    """A gate without any medium in it is a mistake of the scene, not a black image."""
    if sensor.get_medium() is not None:
        return
    near, far = sensor.nearest_and_farthest()
    origin = sensor.world_transform() @ mi.Point3f(0)
    position = mi.ScalarPoint3f(origin.x[0], origin.y[0], origin.z[0])
    spans = []
    for shape in scene.shapes():
        if shape.interior_medium() is None and shape.exterior_medium() is None:
            continue
        box = shape.bbox()
        corners = [dr.norm(box.corner(i) - position) for i in range(8)]
        spans.append((float(box.distance(position)), float(max(corners))))
    if not any(first <= far and last >= near for first, last in spans):
        where = ", ".join(f"{a:g} to {b:g} m" for a, b in spans) or "nowhere"
        fail(NAME, "gates", f"{near:g} to {far:g} m", f"ranges with a medium (there is one: {where})")
