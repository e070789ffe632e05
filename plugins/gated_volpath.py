"""
.. _integrator-gated_volpath:

Time-gated polarised volume transport (``gated_volpath``)
---------------------------------------------------------

Renders all beams of a :ref:`scanning_lidar <sensor-scanning_lidar>` in one wavefront. The result
for every beam and gate is the Stokes vector of the received light as *received energy over emitted
pulse energy*, and the standard error of its first component.

============================ ======= ======================================================= =======
Parameter                    Type    Meaning                                                 Default
============================ ======= ======================================================= =======
``max_order``                int     highest scattering order that is followed               1
``estimator``                string  ``gated``: the last collision is forced into the gate;  gated
                                     ``analog``: free flights from their physical
                                     distribution, most samples miss the gate (for
                                     validation)
``candidates``               int     single-scattering paths, of which each sample selects    1
                                     one by its contribution: with 16, a long pulse at a
                                     bright slab needs 25 to 50 times fewer samples, each of
                                     which takes twice as long
``orders``                   bool    also give S0 of every scattering order                  false
``covariance``               bool    also give the standard errors of S1, S2 and S3 and the  false
                                     correlation of the errors of S0 and S1 (for the error of
                                     the depolarisation ratio)
``shares``                   bool    also give the largest fraction of the variance of S0     false
                                     that is due to one sample
``random_numbers``           string  ``independent``, the default: every beam and gate has
                                     its own; ``common``: all have the same (``gated`` only)
``samples_per_pass``         int     Monte Carlo samples that are traced at once; limits the 4194304
                                     memory, does not change the result
============================ ======= ======================================================= =======

Both estimators connect every collision to a sampled point of the telescope, test the field of view
and multiply by the transmittance of all media on the way. They have the same expectation. In the
gated estimator every sample belongs to a gate and has a range R in it. The last vertex of each
scattering order is placed such that the whole path is 2 R long: on the ellipsoid whose foci are the
vertex before it and the telescope point. Of three directions, one from the phase function, one
towards the field of view and one from the telescope, one is selected in proportion to its
contribution (Talbot, Cline & Egbert 2005).
With several ``candidates`` the path of single scattering is selected in the same way. Each
candidate has its own ray of the laser and point of the telescope, and its place is stratified over
the gate and the pulse. Gradients, and scenes with open surfaces between media, use one candidate.

``mi.render(scene)`` returns a tensor (height, width, channels) with the channels ``gateNNN.S0`` ...
``gateNNN.S3``, ``gateNNN.S0_stderr``, gate by gate; row 0 is the top of the scan. With ``orders``
each gate has ``gateNNN.order1.S0``, ``gateNNN.order2.S0``, ... after these, with ``covariance``
``gateNNN.S1_stderr``, ``gateNNN.S0_S1_correlation``, ``gateNNN.S2_stderr`` and
``gateNNN.S3_stderr`` after these, with ``shares`` ``gateNNN.S0_largest_share`` after all.

If one sample contributes half of the variance or more, the standard error is uncertain by a factor
of two at least, and most of the light may not have been sampled. Without ``shares``, a warning is
given if this holds for more than 1 % of the pixels that receive light. The integrator's attributes
``untrusted`` and ``lit`` are the numbers of such pixels and of all pixels that receive light. Light
that no sample has reached cannot be detected in this way. An integrator warns once, at its first
such image.

Coordinates are in single precision. Its attribute ``rejected`` is the number of samples whose last
vertex was drawn in the field of view and rounded out of it; about as much of the light of order two
and higher is lost. There is a warning from 0.1 % on: 1 km from the origin of coordinates with a
field of view of 0.05 mrad (half angle).

The Stokes vector of the received light, like that of the emitted light, refers to the horizontal
axis e_h of the beam, projected perpendicular to the returning light, as for an analyser fixed to
the telescope. Unpolarised variants compute intensity only: S1 to S3 are 0. RGB variants use the
colour channel nearest to the wavelength of the laser.

``sample_count`` of the sensor's sampler (or ``spp``) is the number of Monte Carlo samples per beam.
The gated estimator distributes them evenly over the gates and rounds up, so that every gate gets
the same number, at least two. Of few samples a gate the standard error is itself uncertain: for
normal ones, the value plus and minus 1.96 of it holds the truth in 70 % of the pixels with 2
samples, 86 % with 4, 91 % with 8, 93 % with 16, instead of 95 % (Student's t). Samples of a beam
are independent; the random numbers of a sample depend only on the seed, its beam, its gate and its
number. With ``random_numbers`` ``common`` they depend on the seed and the number alone: every beam
and gate, and every image of the same seed, is sampled by the same rays of the laser, points of the
telescope and places in the gate, and their errors are nearly the same where the air is the same.
The standard error of a pixel is unchanged. ``gateNNN.S0_mc_error``, behind the orders, is then one
realisation of the Monte Carlo error of S0: half the difference of the means of samples of even and
of odd number, which is correlated among pixels, gates and images as the errors themselves are.
Unpolarised phase functions (``isotropic``, ``hg``)
depolarise completely; in polarised variants a ``blendphase`` must not mix them with polarised ones.

S0 to S3 of all orders are differentiable, in reverse and forward mode (``dr.backward`` and
``dr.forward_to`` of what ``mi.render(scene, params)`` returns), with the gated estimator: with
respect to extinction coefficients and albedos, to weights of a ``blendphase``, g of ``hg``, tables
of :ref:`mueller <phase-mueller>`, and the flow of a :ref:`moving_volume <volume-moving_volume>`.
Gradients use other random samples than the image. Memory does not grow with the number of orders.
Gradients with respect to anything else raise an error of one line. Other channels, such as standard
errors, are constants in a loss: they have no gradient.

Ground, walls and calibration targets are surfaces with Mitsuba's ``diffuse`` BSDF, which is also
that of a shape without any: reflectance rho, rho / pi per steradian, unpolarised. One that faces
away is dark, unless it is ``twosided``. The light that the laser sends straight to a surface is
received in the gate of its range, attenuated by the air before it, as scattered once (order 1).
Light that is scattered in the air before or after it is reflected is not followed: for the part of
it that stays in view, the air counts as if it absorbed.

A scene is refused if a medium, Mitsuba's own included, has a negative, infinite or undefined
extinction coefficient, an albedo or a weight of a blend outside 0 to 1, if ``hg`` has a g beyond
0.99 in magnitude, or if a shape or volume has a transform that is not finite. Values are checked
before the first rendering and whenever they are replaced.

Other features of Mitsuba scenes are either supported or refused with an error of one line before
anything is rendered:

===================================== =============================================================
Feature of a scene                    Treatment
===================================== =============================================================
film: ``width``, ``height``           honoured: the beams
film: crop, ``sample_border``         refused
film: ``rfilter``                     ``box``, or none stated: each beam is one pixel; others are
                                      refused
film: formats of pixel and file       no effect: the tensor is single precision and its channels
                                      have names
other films than ``hdrfilm``          refused
sampler                               ``independent``; others are refused, and its ``seed``: it is
                                      given to ``mi.render``
sensor: shutter                       refused; each beam has its own time, see ``beams``
sensor: clipping, fields of cameras   unknown parameters: refused by Mitsuba
sensor: medium                        honoured; refused if it is not that of the shape in which the
                                      telescope is. If none is stated, the shape's
several sensors                       the one that ``mi.render`` is asked for
arguments of ``mi.render``            ``spp``, ``seed``, ``sensor``, ``integrator`` and ``params``
                                      are honoured
other emitters than the sensor's      refused: area, environment, point, a second laser
BSDF ``null``                         light passes: a surface between media
BSDF that transmits otherwise         refused: ``mask``, ``blendbsdf``, ``thindielectric``,
                                      dielectrics, etalons
BSDF ``diffuse``, ``twosided``        the surface blocks all light, and reflects what reaches it
                                      from the laser to the telescope. Refused around a medium
any other BSDF                        the surface blocks all light; what it reflects is not
                                      followed. Refused around a medium
cube, sphere, closed mesh             honoured: the interior is what it encloses, whatever the
                                      order of a mesh's corners and however its transform mirrors
                                      it
``flip_normals``                      honoured: exchanges interior and exterior
rectangle, disk, cylinder, open mesh  honoured: the exterior is on the side of the normal. Refused
                                      where a beam first meets the side of another medium
other shapes around media             refused; instances always
shapes that touch, nest, overlap      honoured, without a minimum distance. Where closed shapes
                                      overlap, the smallest one's medium holds
exterior medium                       if none is stated, what surrounds the shape; beside open
                                      surfaces a vacuum. Refused if it is neither the sensor's nor
                                      that of another shape
``merge``, shapes that Mitsuba merges honoured: they are separated again
medium: ``scale``, chromatic values   honoured, at the laser's wavelength
medium: ``sample_emitters``           no effect: there is no emitter to sample
volume: all parameters                honoured, of extinction and albedo
grid of three channels                as Mitsuba reads colours: the laser's channel in RGB
                                      variants, the luminance in ``mono`` ones
phase function ``tabphase``           honoured within rounding of 0 and 180 degrees as well
``mi.traverse``                       all parameters that it lists can be changed, poses of shapes
                                      included. Media cannot be exchanged
===================================== =============================================================

.. code-block:: xml

    <integrator type="gated_volpath"> <integer name="max_order" value="4"/> </integrator>
"""

import contextlib
import functools
import gc
import warnings
from collections.abc import Iterator, Mapping
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from .bounds import Bounds
from .differentiable import differentiable
from .laser import channel_of
from .parameters import choice, fail, whole
from .passes import Batches, Progress, stored_passes
from .path_gradients import gradients
from .path_sampling import Lidar, Orders, Sample, add
from .physical import Physical
from .random_numbers import generator
from .registration import register
from .supported import check_air, check_supported
from .surfaces import media_of
from .variant_types import Float, Parameters, Properties, Scene, Sensor, Tensor, UInt

# how samples scatter and where they fly next is in `path_sampling`, of both estimators
NAME, KIND = "gated_volpath", "integrator"

STOKES = ("S0", "S1", "S2", "S3")
Moments: TypeAlias = tuple[int, list[Float], list[Float], Float]
"""Of the samples of some cells: their number, means, summed products of deviations and the largest
squared deviation of S0. Numbers by cell, but for the first."""

# products of deviations that are summed: that of S0 alone, or all that the errors of components and
# of the depolarisation ratio need
PRODUCTS = ((0, 0), (1, 1), (0, 1), (2, 2), (3, 3))
COVARIANCE = ("S1_stderr", "S0_S1_correlation", "S2_stderr", "S3_stderr")
# Deviations are multiplied by it before they are squared: a signal of 1e-19 has squares that
# underflow in single precision. A power of two, so that nothing is rounded.
MAGNIFIED = 2.0**50
# Fraction of the variance of S0 that comes from one sample from which on the standard error is
# unreliable. A little less than one half: of two samples each has exactly that.
HALF = 0.4999
# Samples of a row. Rows are summed first: one sum of millions of samples loses digits.
ROW = 1024
# Fraction of samples lost to rounding from which on it is said: about that of the light.
REJECTED = 1e-3


def define() -> type:
    """The plugin's class in the variant in force."""

    class GatedVolpath(mi.CppADIntegrator):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            self.max_order = whole(props, NAME, "max_order", 1, 1)
            self.estimator = choice(props, NAME, "estimator", "gated", ("gated", "analog"))
            self.orders = bool(props.get("orders", False))
            self.covariance = bool(props.get("covariance", False))
            self.shares = bool(props.get("shares", False))
            self.samples_per_pass = whole(props, NAME, "samples_per_pass", 1 << 22, 1)
            self.candidates = whole(props, NAME, "candidates", 1, 1)
            numbers = ("independent", "common")
            self.random_numbers = choice(props, NAME, "random_numbers", numbers[0], numbers)
            if self.common and self.estimator != "gated":
                fail(NAME, "random_numbers", "common", "independent for free flights")
            # pixels of the last image that receive light, those of them whose standard error is
            # unreliable, and samples that were lost to rounding
            self.lit, self.untrusted, self.rejected = 0, 0, 0
            self.warned = False
            # lowest order that counts, for tests of single orders
            self.lowest_order = 1
            self.physical = Physical(NAME)
            self.bounds = Bounds()
            # set by the caller
            self.progress: Progress | None = None
            self.batches: Batches | None = None

        def aov_names(self) -> list[str]:
            return []

        @property
        def common(self) -> bool:
            """Whether all beams and gates have the same random numbers."""
            return self.random_numbers == "common"

        def quantities(self) -> list[str]:
            """Quantities that are rendered for every gate."""
            orders = range(1, self.max_order + 1) if self.orders else ()
            more = COVARIANCE if self.covariance else ()
            by_order = (f"order{order}.S0" for order in orders)
            error = ("S0_mc_error",) if self.common else ()
            shares = ("S0_largest_share",) if self.shares else ()
            return [*STOKES, "S0_stderr", *by_order, *error, *more, *shares]

        def channel_names(self, sensor: Sensor) -> list[str]:
            """Names of the last axis of the rendered tensor."""
            return [
                f"gate{gate:03d}.{quantity}"
                for gate in range(sensor.gate_count)
                for quantity in self.quantities()
            ]

        def render(
            self,
            scene: Scene,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Tensor:
            sensor, seed, samples = self._prepare(scene, sensor, seed, spp)
            gates, beams = sensor.gate_count, sensor.beam_count
            quantities = len(self.quantities())
            trace = self._gated if self.estimator == "gated" else self._analog
            size = beams * gates * quantities
            before, arrays = stored_passes(self.batches, self.samples_per_pass, size)
            image = mi.Float(arrays["image"]) if "image" in arrays else dr.zeros(mi.Float, size)
            done, total = 0, _moments(arrays)
            # of finished beams: pixels that receive light, those with an unreliable standard error;
            # of all: samples lost to rounding
            counts = np.array(arrays.get("counts", (0, 0, 0)))
            with dr.suspend_grad(), _nothing_freed():
                passes = enumerate(self._passes(sensor, samples), 1)
                for number, (first, count, start, rounds, complete) in passes:
                    done += count * rounds * self._unit(sensor)
                    # random numbers of a sample do not depend on passes before: stored ones are
                    # skipped
                    if number <= before:
                        continue
                    part, rejected = trace(scene, sensor, seed, first, count, start, rounds)
                    total = part if total is None else _merge(total, part)
                    if complete:
                        cells = self._places(first * gates, count * gates)
                        results = _results(*total)
                        for value, place in zip(results, cells, strict=False):
                            dr.scatter(image, value, place)
                        dr.eval(image)
                        bright, fraction = results[0].numpy() > 0, results[-1].numpy()
                        counts += bright.sum(), (bright & (fraction >= HALF)).sum(), 0
                        total = None
                    counts[2] += rejected[0]
                    # kernels run asynchronously: what is reported or stored must have been computed
                    if self.progress or self.batches:
                        dr.eval(image, total)
                        dr.sync_thread()
                    if self.batches and done < beams * samples:
                        made = functools.partial(
                            _arrays, image, total, counts.copy(), self.samples_per_pass
                        )
                        self.batches.store(number, made)
                    if self.progress:
                        self.progress(done, beams * samples)
            self.lit, self.untrusted, self.rejected = (int(count) for count in counts)
            self._warn(beams * samples)
            width, height = sensor.film().size()
            return mi.TensorXf(image, (height, width, gates * quantities))

        def _warn(self, samples: int) -> None:
            """Warn of an unreliable image, at an integrator's first one."""
            said = []
            if self.untrusted > 0.01 * self.lit and not self.shares:
                said.append(
                    f"in {self.untrusted} of {self.lit} pixels that receive light one sample "
                    "carries half of the variance or more; their standard errors are unreliable; "
                    "expected more samples"
                )
            if self.rejected > REJECTED * samples:
                said.append(
                    f"{self.rejected} of {samples} samples left the field of view by rounding, and "
                    "as much light of order two and higher is lost; expected the scene nearer to "
                    "the origin, or a wider field of view"
                )
            if said and not self.warned:
                self.warned = True
                warnings.warn(f"{NAME}: {'; '.join(said)}", stacklevel=3)

        def render_backward(
            self,
            scene: Scene,
            params: Parameters,
            grad_in: Tensor,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
        ) -> None:
            """Gradients of the scene from those of S0 to S3; other channels have none."""
            _, phases = differentiable(NAME, scene)
            orders = self.lowest_order, self.max_order
            for lidar, sample, cell, low, high, part in self._replayed(scene, sensor, seed, spp):
                weights = [dr.gather(mi.Float, grad_in.array, c) * part for c in cell]
                gradients(lidar, sample, low, high, orders, phases, weights)

        def render_forward(
            self,
            scene: Scene,
            params: Parameters,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
        ) -> Tensor:
            """Gradients of S0 to S3 from those of the scene; other channels have none."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            width, height = sensor.film().size()
            shape = (height, width, sensor.gate_count * len(self.quantities()))
            image = dr.zeros(mi.Float, shape[0] * shape[1] * shape[2])
            wanted, phases = differentiable(NAME, scene)
            orders = self.lowest_order, self.max_order
            # quantities that plugins derive from their parameters
            dr.enqueue(dr.ADMode.Forward, wanted)
            dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
            for lidar, sample, cell, low, high, part in self._replayed(scene, sensor, seed, spp):
                gradient = gradients(lidar, sample, low, high, orders, phases)
                for value, place in zip(gradient, cell, strict=True):
                    add(image, value * part, place)
                dr.eval(image)
            return mi.TensorXf(image, shape)

        def _replayed(
            self, scene: Scene, sensor: Sensor | int, seed: int, spp: int
        ) -> Iterator[tuple[Lidar, Sample, list[UInt], Float, Float, Float]]:
            """Samples of all passes: as `_samples`, cells as image indices of S0 to S3.

            The last one is a sample's part in the mean.
            """
            if self.estimator != "gated":
                fail(NAME, "gradients", self.estimator, "the gated estimator")
            sensor, seed, samples = self._prepare(scene, sensor, seed, spp)
            gates = sensor.gate_count
            with _nothing_freed():
                for first, count, start, rounds, _ in self._passes(sensor, samples):
                    lidar, sample, cell, low, high = self._samples(
                        scene, sensor, seed, first, count, start, rounds, differentiable=True
                    )
                    place = (cell + dr.opaque(mi.UInt32, first * gates)) * len(self.quantities())
                    places = [place + index for index in range(len(STOKES))]
                    yield lidar, sample, places, low, high, _opaque(gates / samples)

        def _prepare(
            self, scene: Scene, sensor: Sensor | int, seed: int, spp: int
        ) -> tuple[Sensor, UInt, int]:
            """The sensor, an opaque seed, and the number of samples per beam, all checked."""
            if isinstance(sensor, int):
                sensor = scene.sensors()[sensor]
            if not hasattr(sensor, "beam_frame"):
                fail(NAME, "sensor", type(sensor).__name__, "a sensor of type 'scanning_lidar'")
            check_supported(NAME, scene, sensor)
            self.physical.check(scene, sensor)
            check_air(NAME, scene, sensor)
            values = sensor.beam_count * sensor.gate_count * len(self.quantities())
            if values >= 2**32:
                most = (2**32 - 1) // (sensor.beam_count * len(self.quantities()))
                fail(
                    NAME,
                    "gate_count",
                    sensor.gate_count,
                    f"at most {most} with {sensor.beam_count} beams: images are counted in 32 bits",
                )
            samples = int(spp) or sensor.sampler().sample_count()
            if self.estimator == "gated":
                samples = sensor.gate_count * max(2, -(-samples // sensor.gate_count))
            elif samples < 2:
                fail(NAME, "sample_count", samples, "at least 2, for a standard error")
            self.bounds.update(media_of(scene, sensor), channel_of(sensor.laser.wavelength))
            seed = mi.UInt32(seed)
            dr.make_opaque(seed)  # a new seed compiles nothing
            return sensor, seed, samples

        def _unit(self, sensor: Sensor) -> int:
            """Samples per round: one per gate with the gated estimator."""
            return sensor.gate_count if self.estimator == "gated" else 1

        def _passes(
            self, sensor: Sensor, samples: int
        ) -> Iterator[tuple[int, int, int, int, bool]]:
            """All beams, a few at a time; many samples of a beam in several passes.

            Yields first beam, number of beams, first round, number of rounds, and whether these
            beams are then complete.
            """
            beams, unit = sensor.beam_count, self._unit(sensor)
            rounds = samples // unit
            # at least two, for a variance within the pass
            rounds_at_once = min(rounds, max(2, self.samples_per_pass // unit))
            beams_at_once = max(1, self.samples_per_pass // (rounds_at_once * unit))
            for first in range(0, beams, beams_at_once):
                start = 0
                while start < rounds:
                    next_rounds = min(rounds_at_once, rounds - start)
                    if rounds - start - next_rounds == 1:
                        next_rounds += 1  # a pass of one sample has no variance
                    last = start + next_rounds == rounds
                    yield first, min(beams_at_once, beams - first), start, next_rounds, last
                    start += next_rounds

        def _places(self, first: int, cells: int) -> list[UInt]:
            """Image indices of each quantity for a range of cells (beam by beam, gate by gate)."""
            quantities = len(self.quantities())
            cell = (dr.arange(mi.UInt32, cells) + dr.opaque(mi.UInt32, first)) * quantities
            return [cell + index for index in range(quantities)]

        def _samples(
            self,
            scene: Scene,
            sensor: Sensor,
            seed: UInt,
            first: int,
            count: int,
            start: int,
            rounds: int,
            differentiable: bool = False,
        ) -> tuple[Lidar, Sample, UInt, Float, Float]:
            """Samples of the gates: lidar, samples, cells, twice the nearest and farthest range.

            The sample's delay is subtracted from the ranges: light emitted later travels less far.
            """
            lane = dr.arange(mi.UInt32, count * sensor.gate_count * rounds)
            # opaque, so that numbers of gates, samples and passes are not compiled into the kernel
            gates = dr.opaque(mi.UInt32, sensor.gate_count)
            rounds_ = dr.opaque(mi.UInt32, rounds)
            cell = lane // rounds_
            beam = cell // gates
            gate = cell - beam * gates
            number = lane - cell * rounds_ + dr.opaque(mi.UInt32, start)
            beam += dr.opaque(mi.UInt32, first)
            lidar = Lidar(scene, sensor, self.bounds, differentiable)
            if self.common:
                sample = lidar.emit(generator(seed, mi.UInt32(0), number), beam)
            else:
                sample = lidar.emit(generator(seed, beam, number * gates + gate), beam)
            low, high = sensor.ranges(sample.frame.n, sample.start)
            # whole paths, twice the ranges
            width = 2 * (high - low) / mi.Float(gates)
            near = 2 * (low - sample.delay) + width * mi.Float(gate)
            return lidar, sample, cell, near, near + width

        def _gated(
            self,
            scene: Scene,
            sensor: Sensor,
            seed: UInt,
            first: int,
            count: int,
            start: int,
            rounds: int,
        ) -> tuple[Moments, UInt]:
            """Means and summed products of deviations, last collisions forced into the gates."""
            lidar, sample, cell, low, high = self._samples(
                scene, sensor, seed, first, count, start, rounds
            )
            path = low, high, sample.rng.next_float32()
            parts, cells = -(-rounds // ROW), count * sensor.gate_count
            number = dr.arange(mi.UInt32, cells * rounds) - cell * dr.opaque(mi.UInt32, rounds)
            row = cell * dr.opaque(mi.UInt32, parts) + number // ROW
            by_order = Orders(cells * parts, self.max_order) if self.orders else None
            if self.candidates == 1 or lidar.air.sheets:
                stokes = lidar.single(sample, dr.lerp(*path), high - low)
            else:
                # candidates have delays of their own
                chosen, place, weight = lidar.by_contribution(
                    sample,
                    low + 2 * sample.delay,
                    high + 2 * sample.delay,
                    dr.opaque(mi.UInt32, self.candidates),
                )
                stokes = lidar.single(chosen, place, weight * (high - low))
            if lidar.air.targets:
                stokes = [
                    a + b for a, b in zip(stokes, lidar.reflected(sample, low, high), strict=True)
                ]
            if by_order:
                by_order.add(stokes[0], mi.UInt32(1), row)
            if self.max_order > 1:
                last = dr.opaque(mi.UInt32, self.max_order)
                more = lidar.further(sample, *path, last, by_order, row)
                stokes = [a + b for a, b in zip(stokes, more, strict=True)]
            dr.eval(stokes, lidar.rejected, by_order.sums if by_order else None)
            means = [dr.block_sum(s, rounds) / _opaque(rounds) for s in stokes]
            # deviations from the pass's own mean: a sum of squares less a square would cancel in
            # single precision
            off = [
                MAGNIFIED * (s - dr.gather(mi.Float, m, cell))
                for s, m in zip(stokes, means, strict=True)
            ]
            deviations = [dr.block_sum(off[i] * off[j], rounds) for i, j in self._products()]
            largest = dr.block_reduce(dr.ReduceOp.Max, off[0] * off[0], rounds)
            if by_order:
                means += [total / _opaque(rounds) for total in by_order.totals(parts)]
            if self.common:
                # by the sample's number in its pass: passes are the same for all beams
                halves = dr.block_sum(dr.select(number & 1 == 0, off[0], -off[0]), rounds)
                means.append(halves / (MAGNIFIED * _opaque(rounds)))
            return (rounds, means, deviations, largest), lidar.rejected

        def _analog(
            self,
            scene: Scene,
            sensor: Sensor,
            seed: UInt,
            first: int,
            count: int,
            start: int,
            rounds: int,
        ) -> tuple[Moments, UInt]:
            """The same, with analog free flights."""
            lane = dr.arange(mi.UInt32, count * rounds)
            rounds_ = dr.opaque(mi.UInt32, rounds)
            beam = lane // rounds_
            within = lane - beam * rounds_
            lidar = Lidar(scene, sensor, self.bounds)
            number = within + dr.opaque(mi.UInt32, start)
            index = beam + dr.opaque(mi.UInt32, first)
            sample = lidar.emit(generator(seed, index, number), index)
            parts, gates = -(-rounds // ROW), sensor.gate_count
            parts_, gates_ = dr.opaque(mi.UInt32, parts), dr.opaque(mi.UInt32, gates)
            rows = count * gates * parts
            by_order = Orders(rows, self.max_order) if self.orders else None
            sums = [dr.zeros(mi.Float, rows) for _ in STOKES]
            products = {pair: dr.zeros(mi.Float, rows) for pair in self._products()}
            # bits of floats of 0 or more, which are in order as integers too
            largest = dr.zeros(mi.UInt32, rows)
            lidar.analog(
                sample,
                dr.opaque(mi.UInt32, self.max_order),
                beam * gates_ * parts_ + within // ROW,
                parts_,
                gates_,
                sums,
                products,
                largest,
                MAGNIFIED,
                by_order,
            )
            dr.eval(sums, products, largest, by_order.sums if by_order else None)
            sums = [dr.block_sum(total, parts) for total in sums]
            products = {pair: dr.block_sum(total, parts) for pair, total in products.items()}
            largest = dr.block_reduce(dr.ReduceOp.Max, largest, parts)
            samples = _opaque(rounds)
            means = [s / samples for s in sums]
            large = [MAGNIFIED * mean for mean in means]
            # here contributions are scattered to their gates before a mean is known; most are 0,
            # so that squares exceed the mean's by far and hardly cancel
            deviations = [p - samples * large[i] * large[j] for (i, j), p in products.items()]
            largest = dr.reinterpret_array(mi.Float, largest)
            if by_order:
                means += [total / samples for total in by_order.totals(parts)]
            return (rounds, means, deviations, largest), lidar.rejected

        def _products(self) -> tuple[tuple[int, int], ...]:
            """The pairs of Stokes components whose products are summed."""
            return PRODUCTS if self.covariance else PRODUCTS[:1]

        def to_string(self) -> str:
            return f"GatedVolpath[max_order={self.max_order}, estimator={self.estimator}]"

    return GatedVolpath


@contextlib.contextmanager
def _nothing_freed() -> Iterator[None]:
    """Suspend Python's garbage collection while kernels are recorded.

    A scene freed between two virtual calls changes the set of instances that they may call; Dr.Jit
    1.5 then emits a function twice and aborts.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _opaque(number: float) -> Float:
    """A number that changes from scan to scan without being compiled into a kernel."""
    return dr.opaque(mi.Float, number)


def _arrays(
    image: Float, total: Moments | None, counts: np.ndarray, samples_per_pass: int
) -> dict[str, np.ndarray]:
    """Finished beams, and the moments of those that are not, for NumPy."""
    arrays = {
        "image": image.numpy(),
        "samples_per_pass": np.array(samples_per_pass),
        "counts": counts,
    }
    if total is not None:
        number, means, deviations, largest = total
        arrays |= {
            "number": np.array(number),
            "means": np.stack([mean.numpy() for mean in means]),
            "spreads": np.stack([part.numpy() for part in deviations]),
            "largest": largest.numpy(),
        }
    return arrays


def _moments(arrays: Mapping[str, np.ndarray]) -> Moments | None:
    """The moments from the arrays of `_arrays`."""
    if "number" not in arrays:
        return None
    means, deviations = ([mi.Float(row) for row in arrays[name]] for name in ("means", "spreads"))
    return int(arrays["number"]), means, deviations, mi.Float(arrays["largest"])


def _results(
    number: int, means: list[Float], deviations: list[Float], largest: Float
) -> list[Float]:
    """The image's quantities from the moments of all samples.

    The last one is the fraction of the variance of S0 that comes from one sample.
    """
    errors = _errors(_opaque(number), deviations)
    total = deviations[0]
    fraction = dr.select(total > 0, dr.minimum(largest / total, 1), 0)
    return [*means[: len(STOKES)], errors[0], *means[len(STOKES) :], *errors[1:], fraction]


def _merge(first: Moments, second: Moments) -> Moments:
    """Moments of two sets of samples together (Chan, Golub & LeVeque 1983)."""
    n1, means1, deviations1, largest1 = first
    n2, means2, deviations2, largest2 = second
    fraction, weight = _opaque(n2 / (n1 + n2)), _opaque(n1 * n2 / (n1 + n2))
    off = [b - a for a, b in zip(means1, means2, strict=True)]
    means = [a + o * fraction for a, o in zip(means1, off, strict=True)]
    off = [MAGNIFIED * o for o in off[: len(STOKES)]]
    deviations = [
        a + b + off[i] * off[j] * weight
        for a, b, (i, j) in zip(deviations1, deviations2, PRODUCTS[: len(deviations1)], strict=True)
    ]
    # each from the mean of its own set, which differ little where there are enough samples
    return n1 + n2, means, deviations, dr.maximum(largest1, largest2)


def _errors(number: Float, deviations: list[Float]) -> list[Float]:
    """Standard error of S0, and with the sums of all `PRODUCTS` the quantities `COVARIANCE`."""
    errors = [dr.sqrt(dr.maximum(s, 0) / (number * (number - 1.0))) / MAGNIFIED for s in deviations]
    if len(deviations) == 1:
        return errors
    first, second, mixed, *_ = deviations
    product = dr.sqrt(dr.maximum(first, 0)) * dr.sqrt(dr.maximum(second, 0))
    errors[2] = dr.select(product > 0, dr.clip(mixed / product, -1, 1), 0)
    return errors


register(KIND, NAME, define)
