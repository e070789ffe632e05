"""
.. _integrator-fringes:

Fringes of an interferometer (``fringes``)
------------------------------------------

Plane waves of a :ref:`source <emitter-plane_waves>` through surfaces that transmit light without
deflection, such as an :ref:`etalon <bsdf-etalon>`, into a :ref:`camera <sensor-ccd>`. The result
for every pixel is the Stokes vector of the received light as *received energy over the energy that
the source sends through the stop*, and the standard error of its first component.

============================ ======= ======================================================= =======
Parameter                    Type    Meaning                                                 Default
============================ ======= ======================================================= =======
``estimator``                string  ``camera``: from every pixel out to the source;         camera
                                     ``forward``: plane waves of random direction,
                                     frequency, polarisation and position, traced through
                                     the lens to the CCD, each weighted with its
                                     transmission; ``analog``: the same, but every photon is
                                     either transmitted or rejected: an image of counts
``samples_per_pass``         int     light paths that are traced at once; limits the memory, 4194304
                                     does not change the expectation
============================ ======= ======================================================= =======

All estimators have the same expectation. A path is a straight line from the source to the stop.
Surfaces multiply its weight (component ``Null`` of their BSDF) and do not displace it. Surfaces
without that component block the light; reflected light is lost. A scene is refused if two surfaces
are so close to each other that a ray would miss the second one. The frequency of each path is drawn
from the line of the source. The ray stores it as an offset in Hz in place of its ``time``.

``mi.render(scene)`` returns a tensor (height, width, channels) with the channels ``S0`` ...
``S3``, ``S0_stderr``; row 0 is the top. The Stokes vector refers to the horizontal axis.
Unpolarised variants compute intensity only: S1 to S3 are 0. ``sample_count`` of the sensor's
sampler (or ``spp``) is the number of paths per pixel, for ``forward`` the mean over all pixels.
Films and samplers are those of :ref:`gated_volpath <integrator-gated_volpath>`.
With ``forward`` the S0_stderr of a pixel without any path is 0. Gradients are refused: the orders
of an etalon are split in two parts, exact in single precision, when it is loaded.

.. code-block:: xml

    <integrator type="fringes"> <string name="estimator" value="forward"/> </integrator>
"""

import itertools
from collections.abc import Sequence
from typing import NoReturn

import drjit as dr
import mitsuba as mi
import numpy as np

from .bodies import first_hit, name_of, scene_extent, scene_of
from .parameters import choice, fail, whole
from .passes import Batches, Progress, stored_passes
from .physical import Physical
from .polarization import horizontal_axis, rotate_stokes
from .random_numbers import generator, pair
from .registration import register
from .supported import check_sensor
from .variant_types import (
    Context,
    Emitter,
    Float,
    Generator,
    Mask,
    Parameters,
    Properties,
    Ray,
    Scene,
    Sensor,
    Spectrum,
    Stokes,
    Tensor,
    UInt,
    Vector,
)

NAME, KIND = "fringes", "integrator"

STOKES = ("S0", "S1", "S2", "S3")
# 1500 times the rounding of single precision, doubled
OFFSET = 2e-4


def define() -> type:
    """The plugin's class in the variant in force."""

    class Fringes(mi.CppADIntegrator):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            self.estimator = choice(
                props, NAME, "estimator", "camera", ("camera", "forward", "analog")
            )
            self.samples_per_pass = whole(props, NAME, "samples_per_pass", 1 << 22, 2)
            self.physical = Physical(NAME)
            # set by the caller
            self.progress: Progress | None = None
            self.batches: Batches | None = None

        def aov_names(self) -> list[str]:
            return []

        def quantities(self) -> list[str]:
            """Names of the last axis of the rendered tensor."""
            return [*STOKES, "S0_stderr"]

        def render(
            self,
            scene: Scene,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Tensor:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            if not hasattr(sensor, "sample_towards_scene"):
                fail(NAME, "sensor", type(sensor).__name__, "a sensor of type 'ccd'")
            source = scene.environment()
            if not hasattr(source, "sample_direction_of_light"):
                fail(NAME, "source", type(source).__name__, "an emitter of type 'plane_waves'")
            check_sensor(NAME, sensor)
            self.physical.check(scene, sensor)
            _check_straight(scene)
            _check_separation(scene, source, sensor)
            paths = int(spp) or sensor.sampler().sample_count()
            if self.estimator == "camera" and not 2 <= paths <= self.samples_per_pass:
                fail(NAME, "sample_count", paths, f"2 to samples_per_pass, {self.samples_per_pass}")
            seed = dr.opaque(mi.UInt32, seed)  # a new seed compiles nothing
            width, height = sensor.film().size()
            with dr.suspend_grad():
                trace = self._camera if self.estimator == "camera" else self._forward
                channels = trace(scene, source, sensor, seed, paths, width * height)
            image = dr.zeros(mi.Float, width * height * len(channels))
            pixel = dr.arange(mi.UInt32, width * height) * len(channels)
            for index, channel in enumerate(channels):
                dr.scatter(image, channel, pixel + index)
            return mi.TensorXf(image, (height, width, len(channels)))

        def render_backward(
            self,
            scene: Scene,
            params: Parameters,
            grad_in: Tensor,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
        ) -> NoReturn:
            """Refused: see `render_forward`."""
            _no_gradients()

        def render_forward(
            self,
            scene: Scene,
            params: Parameters,
            sensor: Sensor | int = 0,
            seed: int = 0,
            spp: int = 0,
        ) -> NoReturn:
            """Refused: the order, 77 000, needs more than single precision has.

            A plugin splits it into two parts when it is loaded, where gradients are lost.
            """
            _no_gradients()

        # --- both directions

        def _camera(
            self, scene: Scene, source: Emitter, sensor: Sensor, seed: UInt, paths: int, pixels: int
        ) -> list[Float]:
            """Mean and standard error over the paths of each pixel, all of them in one pass."""
            before, channels = self._stored(pixels)
            at_once = max(1, self.samples_per_pass // paths)
            for index, first in enumerate(range(0, pixels, at_once)):
                if index < before:
                    continue
                count = min(at_once, pixels - first)
                lane = dr.arange(mi.UInt32, count * paths)
                number = dr.opaque(mi.UInt32, paths)
                local = lane // number
                pixel = local + dr.opaque(mi.UInt32, first)
                rng = generator(seed, pixel, lane - local * number)
                width = dr.opaque(mi.UInt32, sensor.film().size().x)
                row = pixel // width
                corner = mi.Point2f(mi.Float(pixel - row * width), mi.Float(row))
                point, direction, weight = sensor.sample_towards_scene(
                    corner + pair(rng) - 0.5, pair(rng)
                )
                weight *= source.radiance(-direction)
                ray = mi.Ray3f(point, direction)
                ray.time = source.line.sample(rng.next_float32(), pair(rng))
                matrix = _surfaces(scene, ray, rng, mi.BSDFContext(), weight > 0)
                stokes = _applied(matrix, source.mean_stokes(-direction))
                scale = weight / (source.flux() * sensor.stop_area())
                stokes = [s * scale for s in _about_horizontal(stokes, -direction)]
                dr.eval(stokes)
                number = dr.opaque(mi.Float, paths)
                means = [dr.block_sum(s, paths) / number for s in stokes]
                deviation = stokes[0] - dr.gather(mi.Float, means[0], local)
                square = dr.block_sum(deviation * deviation, paths)
                means.append(dr.sqrt(square / (number * (number - 1))))
                place = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
                for channel, mean in zip(channels, means, strict=True):
                    dr.scatter(channel, mean, place)
                self._report(index + 1, first + count, pixels, channels)
            return channels

        def _forward(
            self, scene: Scene, source: Emitter, sensor: Sensor, seed: UInt, paths: int, pixels: int
        ) -> list[Float]:
            """Light accumulated in the pixels where it arrives."""
            total = paths * pixels
            before, sums = self._stored(pixels)
            context = mi.BSDFContext(mi.TransportMode.Importance)
            width = dr.opaque(mi.UInt32, sensor.film().size().x)
            for index, first in enumerate(range(0, total, self.samples_per_pass)):
                if index < before:
                    continue
                count = min(self.samples_per_pass, total - first)
                lane = dr.arange(mi.UInt32, count)
                rng = generator(seed, dr.opaque(mi.UInt32, index), lane)
                direction, counts, drawn = source.sample_direction_of_light(pair(rng))
                point = sensor.sample_stop(pair(rng))
                place, arrives = sensor.receive(point, direction)
                # from before the first surface to the stop, and no further
                length = dr.opaque(mi.Float, _reach(scene, sensor))
                ray = mi.Ray3f(point - direction * length, direction)
                ray.maxt = length
                ray.time = source.line.sample(rng.next_float32(), pair(rng))
                stokes = source.sample_stokes(direction, rng.next_float32(), pair(rng))
                matrix = _surfaces(scene, ray, rng, context, arrives)
                stokes = [s * counts for s in _applied(matrix, stokes)]
                if self.estimator == "analog":
                    passes = rng.next_float32() < stokes[0]
                    stokes = [dr.select(passes, s / stokes[0], 0) for s in stokes]
                stokes = _about_horizontal(stokes, direction)
                column, row = (mi.UInt32(dr.clip(v + 0.5, 0, 2**31)) for v in (place.x, place.y))
                pixel = row * width + column
                for channel, value in zip(sums, (*stokes, stokes[0] * stokes[0]), strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, channel, value, pixel, arrives)
                self._report(index + 1, first + count, total, sums)
            *stokes, squares = sums
            # energy per photon; the sampled flux is a little larger than the emitted one
            energy = drawn / source.flux() * dr.opaque(mi.Float, 1 / total)
            mean = dr.square(stokes[0]) * dr.opaque(mi.Float, 1 / total)
            variance = dr.maximum(squares - mean, 0)
            return [*(s * energy for s in stokes), dr.sqrt(variance) * energy]

        def _stored(self, pixels: int) -> tuple[int, list[Float]]:
            """Number of passes stored by an earlier run, and their results."""
            passes, arrays = stored_passes(self.batches, self.samples_per_pass)
            if not passes:
                return 0, [dr.zeros(mi.Float, pixels) for _ in self.quantities()]
            return passes, [mi.Float(row) for row in arrays["values"]]

        def _report(self, passes: int, done: int, total: int, values: Sequence[Float]) -> None:
            dr.eval(values)
            if self.progress or self.batches:
                dr.sync_thread()
            if self.batches and done < total:
                size = np.array(self.samples_per_pass)
                self.batches.store(
                    passes,
                    lambda: {
                        "values": np.stack([value.numpy() for value in values]),
                        "samples_per_pass": size,
                    },
                )
            if self.progress:
                self.progress(done, total)

        def to_string(self) -> str:
            return f"Fringes[estimator={self.estimator}]"

    return Fringes


@dr.syntax
def _surfaces(scene: Scene, ray: Ray, rng: Generator, context: Context, active: Mask) -> Spectrum:
    """Mueller matrix of all surfaces along a line, for light of the source.

    From the source's axes to those of the light that arrives, both Mitsuba's own; a single factor
    in unpolarised variants. ``context`` says whether the line is followed with the light.
    """
    context.type_mask = +mi.BSDFFlags.Null
    forward = context.mode == mi.TransportMode.Importance
    matrix, ray, active = mi.Spectrum(1), mi.Ray3f(ray), mi.Bool(active)
    while dr.hint(active, label="surfaces"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        sample, place = rng.next_float32(active), pair(rng)
        _, weight = si.bsdf(ray).sample(context, si, sample, place, active)
        onward = -si.wi
        if dr.hint(forward, mode="scalar"):
            weight = si.to_world_mueller(weight, onward, onward) * matrix
        else:
            weight = matrix * si.to_world_mueller(weight, si.wi, si.wi)
        matrix = dr.select(active, weight, matrix)
        remaining = ray.maxt - si.t
        ray = si.spawn_ray(ray.d)
        ray.maxt = remaining
    return matrix


def _applied(matrix: Spectrum, stokes: Stokes) -> Stokes:
    """The Stokes vector behind a matrix; intensity alone in unpolarised variants."""
    if not mi.is_polarized:
        return [matrix[0] * stokes[0], mi.Float(0), mi.Float(0), mi.Float(0)]
    return [
        sum(matrix[row, column][0] * value for column, value in enumerate(stokes))
        for row in range(4)
    ]


def _about_horizontal(stokes: Stokes, direction: Vector) -> Stokes:
    """The Stokes vector about the horizontal axis instead of Mitsuba's."""
    axis = mi.mueller.stokes_basis(direction)
    return rotate_stokes(stokes, direction, axis, horizontal_axis(direction))


def _reach(scene: Scene, sensor: Sensor) -> float:
    """A distance from the stop beyond which there are no surfaces, m."""
    box = scene.bbox()
    if not box.valid():
        return 1.0
    stop = sensor.world_transform() @ mi.Point3f(0)
    sphere = box.bounding_sphere()
    offset = [a[0] - b for a, b in zip((stop.x, stop.y, stop.z), sphere.center, strict=True)]
    return 1.1 * (sum(v * v for v in offset) ** 0.5 + float(sphere.radius)) + 1e-3


def _no_gradients() -> NoReturn:
    fail(
        NAME,
        "gradients",
        "with respect to the scene",
        "images alone; lidar_mi.retrieval.rings.mean_image differentiates rings",
    )


def _check_straight(scene: Scene) -> None:
    """Refuse surfaces that refract light, which would be ignored."""
    kinds = mi.BSDFFlags
    bending = kinds.DiffuseTransmission | kinds.GlossyTransmission | kinds.DeltaTransmission
    for shape in scene.shapes():
        flags = shape.bsdf().flags()
        if flags & bending and not flags & kinds.Null:
            fail(NAME, "scene", shape.id(), "surfaces that light passes straight or not at all")


def _check_separation(scene: Scene, source: Emitter, sensor: Sensor) -> None:
    """Refuse surfaces so close behind another one that a ray which leaves that one misses them."""
    shapes = scene.shapes()
    if len(shapes) < 2:
        return
    rng = generator(mi.UInt32(0), mi.UInt32(0), dr.arange(mi.UInt32, 256))
    direction, _, _ = source.sample_direction_of_light(pair(rng))
    length = dr.opaque(mi.Float, _reach(scene, sensor))
    origin = sensor.sample_stop(pair(rng)) - direction * length
    places = [
        np.array(first_hit(scene_of([shape]), origin, direction, mi.Bool(True))[0])
        for shape in shapes
    ]
    # Mitsuba moves the start of a ray by this fraction of its coordinates and 1 m
    least = OFFSET * (1 + np.abs(scene_extent(shapes)).max())
    for first, second in itertools.combinations(range(len(shapes)), 2):
        with np.errstate(invalid="ignore"):
            gap = np.abs(places[first] - places[second])
        if (gap[np.isfinite(gap)] < least).any():
            names = f"{name_of(shapes[first])} and {name_of(shapes[second])}"
            fail(NAME, "scene", names, f"surfaces at least {least:.2g} m apart")


register(KIND, NAME, define)
