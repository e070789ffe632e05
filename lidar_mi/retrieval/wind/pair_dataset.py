"""Vectors from images as a CF data set."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.retrieval.defects.copies import Copy
from lidar_mi.retrieval.defects.faint_pattern import Standing
from lidar_mi.retrieval.defects.removal import CleanImages
from lidar_mi.retrieval.images.beam_times import VectorTimes
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import Texture
from lidar_mi.retrieval.wind.dataset import centres, dataset, field, flags, spacing, winds
from lidar_mi.retrieval.wind.methods import Method
from lidar_mi.retrieval.wind.options import VectorValidation
from lidar_mi.retrieval.wind.pair_input import PairInput

_AXES = ("z", "y")


class Vectors(NamedTuple):
    """What was retrieved from images.

    displacement: with all flags.
    texture: of the templates of image 1.
    pattern: the faint pattern at rest whose bias was removed.
    copy: of one image in the other, at rest, that was removed.
    """

    displacement: Displacement
    texture: Texture
    pattern: Standing
    copy: Copy
    times: VectorTimes


def pair_dataset(
    method: Method,
    inputs: PairInput,
    clean: CleanImages,
    vectors: Vectors,
    validation: VectorValidation,
) -> xr.Dataset:
    """The data set that `retrieve_wind` returns."""
    displacement, texture, _, _, times = vectors
    image, steps = inputs.images[0], spacing(inputs.images[0])
    moved = displacement.d.cpu().numpy() * np.reshape(steps, (2, 1, 1))
    variables = winds(displacement, _AXES, steps, times.difference)
    variables["time"] = field(_AXES, times.middle, "mid-time of the vector", "s")
    for axis, along in zip("yz", moved[::-1], strict=True):
        about = f"displacement along {axis}", "m"
        variables[f"displacement_{axis}"] = field(_AXES, along, *about)
    score, meaning = method.score
    slope = "weakest rms slope relative to the mean, per pixel"
    isotropy = "weakest over strongest rms slope"
    variables |= {
        score: field(_AXES, displacement.score, meaning, "1"),
        "texture": field(_AXES, texture.slope, slope, "1"),
        "isotropy": field(_AXES, texture.isotropy, isotropy, "1"),
        "flag": flags(displacement, _AXES),
    }
    coords = centres(image, inputs.windows, "template")
    places = np.meshgrid(*(coords[axis][1] for axis in _AXES), indexing="ij")
    for axis, place, along in zip(_AXES, places, moved, strict=True):
        vector = place + (0.0 if method.centred else 0.5) * along
        about = f"{axis} of the vector at mid-time", "m"
        coords[f"{axis}_vector"] = field(_AXES, vector, *about)
    attributes = _options(method, inputs, validation) | _remarks(inputs, clean, vectors)
    title = "Wind in the image plane from an image pair"
    return dataset(variables, coords, title, attributes, displacement)


def _options(method: Method, inputs: PairInput, validation: VectorValidation) -> dict[str, Any]:
    """What the winds were retrieved with."""
    named = {
        "method": method.name,
        "template": inputs.windows.template,
        "search": inputs.windows.search,
        "stride": inputs.windows.stride,
        "dt": inputs.dt,
        "images": len(inputs.images),
        "min_texture": validation.min_texture,
        "min_isotropy": validation.min_isotropy,
        "median_size": validation.median_size,
        "median_threshold": validation.median_threshold,
        "median_epsilon": validation.median_epsilon,
    }
    if inputs.blur and "blur" in method.options:
        named["blur"] = inputs.blur
    if inputs.times is not None:
        named["timed"] = 1
    if "min_correlation" in method.options:
        named["min_correlation"] = validation.min_correlation
    return named


def _remarks(inputs: PairInput, clean: CleanImages, vectors: Vectors) -> dict[str, Any]:
    """Remarks on the images, without empty ones."""
    pattern = vectors.pattern
    patterns = [str(part) for part in (clean.defects.pattern, pattern) if str(part)]
    remarks = {
        "defects": str(clean.defects),
        "fixed_pattern": ", ".join(patterns),
        "standing_fraction": pattern.fraction,
        "copy_at_rest": str(vectors.copy),
        "identical_images": inputs.same,
        "illumination": clean.change_of_illumination,
    }
    return {name: value for name, value in remarks.items() if value}
