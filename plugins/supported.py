"""What a scene asks for and the integrators cannot do: refused, each in a line.

Mitsuba accepts any film, sampler, emitter and surface with a sensor. What is refused here would
otherwise be ignored without a word. The table in the reference of `gated_volpath` lists all.
"""

import re

import mitsuba as mi
import numpy as np

from .bodies import extent, name_of, reflects
from .parameters import fail
from .polarization import first_unpolarized_in_blend
from .surfaces import media_of
from .variant_types import Scene, Sensor, Shape

# shapes other than meshes whose sides are distinguished along a line
SIDED = ("Cube", "Sphere", "Rectangle", "Disk", "Cylinder")


def check_supported(plugin: str, scene: Scene, sensor: Sensor) -> None:
    """Raise an error for the first thing in a scene that would be ignored.

    Parameters
    ----------
    plugin : str
        Name of the integrator, with which messages begin.

    Raises
    ------
    ValueError
        A film that is cropped or filtered, a sampler that is not independent, a shutter, another
        source of light, a surface that refracts, polarises or covers partly, an instance.
    """
    check_sensor(plugin, sensor)
    for emitter in scene.emitters():
        kind = emitter.class_name()
        if kind == "Emitter":
            kind = str(emitter).partition("[")[0]
        fail(plugin, "emitter", kind, "the sensor's laser alone; other light is not followed")
    for shape in scene.shapes():
        _check_shape(plugin, shape)


def check_sensor(plugin: str, sensor: Sensor) -> None:
    """Raise an error for settings of film, sampler or shutter that would be ignored."""
    film, sampler = sensor.film(), sensor.sampler()
    if film.class_name() != "HDRFilm":
        fail(plugin, "film", film.class_name(), "hdrfilm")
    if list(film.crop_offset()) != [0, 0] or list(film.crop_size()) != list(film.size()):
        crop = [list(film.crop_offset()), list(film.crop_size())]
        fail(plugin, "film.crop", crop, "the whole film")
    if film.sample_border():
        fail(plugin, "film.sample_border", True, "false")
    # gaussian is what a film has if none is stated
    usual = {str(mi.load_dict({"type": kind})) for kind in ("box", "gaussian")}
    if str(film.rfilter()) not in usual:
        fail(plugin, "film.rfilter", str(film.rfilter()), "box: pixels are independent")
    if sampler.class_name() != "IndependentSampler":
        fail(
            plugin, "sampler", sampler.class_name(), "independent: errors are those of such samples"
        )
    seed = re.search(r"base_seed = (\d+)", str(sampler))
    if seed and int(seed[1]):
        fail(plugin, "sampler.seed", int(seed[1]), "0; a seed is given to mi.render")
    if sensor.shutter_open() != 0 or sensor.shutter_open_time() != 0:
        shutter = sensor.shutter_open(), sensor.shutter_open_time()
        fail(plugin, "shutter", shutter, "0 s")


def _check_shape(plugin: str, shape: Shape) -> None:
    name, kind, bsdf = name_of(shape), shape.class_name(), shape.bsdf()
    if kind == "Instance":
        fail(plugin, name, "instance", "the shape itself")
    if bsdf is None:
        return
    flags, kinds = bsdf.flags(), mi.BSDFFlags
    bending = kinds.DiffuseTransmission | kinds.GlossyTransmission | kinds.DeltaTransmission
    if bsdf.class_name() != "Null" and flags & (kinds.Null | bending):
        expected = "null, or a BSDF that transmits nothing: such a surface blocks all light"
        fail(plugin, f"{name}.bsdf", bsdf.class_name(), expected)
    if shape.is_medium_transition() and not (shape.is_mesh() or kind in SIDED):
        fail(
            plugin, name, kind, "a cube, sphere, rectangle, disk, cylinder or mesh around a medium"
        )
    if shape.is_medium_transition() and bsdf.class_name() != "Null":
        fail(plugin, f"{name}.bsdf", bsdf.class_name(), "null, for light to enter its medium")


def check_air(plugin: str, scene: Scene, sensor: Sensor) -> None:
    """Raise an error if no gate meets air, or for a blend whose parts cannot be recognised.

    Raises
    ------
    ValueError
        A gate without any medium in it; polarised phase functions blended with unpolarised ones.
    """
    _check_gate_meets_medium(plugin, scene, sensor)
    _check_blends(plugin, scene, sensor)


def _check_blends(plugin: str, scene: Scene, sensor: Sensor) -> None:
    """Refuse blends of polarised with unpolarised phase functions."""
    for medium in media_of(scene, sensor):
        part = first_unpolarized_in_blend(medium)
        if part is not None:
            fail(
                plugin,
                "blendphase",
                part.class_name(),
                "phase functions that are all polarised, such as mueller, or all unpolarised",
            )


def _check_gate_meets_medium(plugin: str, scene: Scene, sensor: Sensor) -> None:
    """A gate without a medium or a target in it is an error of the scene, not a black image."""
    if sensor.get_medium() is not None:
        return
    origins, (near, far) = sensor.origins_and_ranges()
    spans = []
    for shape in scene.shapes():
        around = shape.interior_medium() or shape.exterior_medium()
        if around is None and not reflects(shape):
            continue
        low, high = extent(shape)
        first = np.linalg.norm(np.maximum(0, np.maximum(low - origins, origins - high)), axis=1)
        last = np.linalg.norm(np.maximum(origins - low, high - origins), axis=1)
        if ((first <= far) & (last >= near)).any():
            return
        spans.append((first.min(), last.max()))
    where = ", ".join(f"{a:g} to {b:g} m" for a, b in spans) or "nowhere"
    gates = f"{near.min():g} to {far.max():g} m"
    fail(plugin, "gates", gates, f"ranges with a medium (there is one: {where})")
