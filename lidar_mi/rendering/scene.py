"""Mitsuba scene files with our plugins."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.errors import InputError
from lidar_mi.io.exr import write_fringes, write_scan
from lidar_mi.io.library_name import is_text
from lidar_mi.io.text import read_text
from lidar_mi.io.xml import check_scene_file
from lidar_mi.rendering.fringes import render_image
from lidar_mi.rendering.labelled import scan_dataset
from lidar_mi.rendering.memory import (
    MOST_AT_ONCE,
    PROGRAM,
    check_memory,
    image_bytes,
    samples_at_once,
)
from lidar_mi.rendering.passes import within_memory
from lidar_mi.rendering.variant import use_variant


def render_file(
    scene_path: str | Path,
    out: str | Path,
    variant: str = "llvm_ad_mono_polarized",
    samples: int = 0,
    seed: int = 0,
    definitions: dict[str, str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """Render an XML scene with a `scanning_lidar` or a `ccd` and write its image as EXR.

    ``Y`` in a scan's file is the attenuated backscatter of the first gate, S0 r^2 / (A dr), with
    the transmittance not corrected: a scene does not state which of its media are "the
    environment".

    samples: Monte Carlo samples per beam or pixel; 0: as in the scene.
    definitions: values for ``$name`` in the scene.

    Raises InputError: missing or broken scene, or one without a `scanning_lidar` and a
    `gated_volpath`, or a `ccd` and `fringes`.
    """
    scene_path, out = Path(scene_path), Path(out)
    if not scene_path.is_file():
        raise InputError(f"{scene_path}: no such file; expected a Mitsuba scene (XML)")
    if not out.parent.is_dir():
        raise InputError(f"{out}: {out.parent} is no folder; expected one that exists")
    _check_names(scene_path, definitions or {})
    check_scene_file(scene_path)
    use_variant(variant)
    try:
        scene = mi.load_file(str(scene_path), **(definitions or {}))
    except RuntimeError as error:
        if " is not allowed; expected " in str(error):
            raise
        raise InputError(f"{scene_path}: {_reason(error)}") from None
    sensor: Any = next(iter(scene.sensors()), None)
    integrator = scene.integrator()
    scans, fringes = hasattr(sensor, "beam_frame"), hasattr(sensor, "sample_towards_scene")
    if not (scans or fringes):
        raise InputError(
            f"{scene_path}: its first sensor is no 'scanning_lidar' and no 'ccd'; expected one, "
            "or mi.render in Python, after lidar_mi.register_plugins(), for other cameras"
        )
    kind, name = ("GatedVolpath", "gated_volpath") if scans else ("Fringes", "fringes")
    if type(integrator).__name__ != kind:
        raise InputError(f"{scene_path}: its integrator is no '{name}'; expected one")
    if progress:
        integrator.progress = lambda done, total: progress(done / total)
    if fringes:
        image = render_image(scene, samples, seed)
        image.attrs["scene"] = scene_path.name
        write_fringes(out, image)
        return image
    integrator.shares, integrator.covariance = True, bool(mi.is_polarized)
    # defaults of the plugin for what the scene does not state
    given = integrator.samples_per_pass
    integrator.samples_per_pass = samples_at_once(
        None if given == MOST_AT_ONCE["llvm"] else given, None, variant
    )
    needed = image_bytes(sensor.beam_count, sensor.gate_count, len(integrator.quantities()))
    what = f"{scene_path}: {sensor.beam_count} beams x {sensor.gate_count} gates"
    check_memory(PROGRAM + needed, None, what, "fewer beams, gates or orders")
    tensor = within_memory(integrator, lambda: np.array(mi.render(scene, spp=samples, seed=seed)))
    scan = scan_dataset(tensor, integrator.quantities(), sensor)
    scan.attrs |= {
        "software": f"lidar-mi {__version__}",
        "scene": scene_path.name,
        "variant": variant,
        "polarized": int(mi.is_polarized),
        "seed": seed,
        "samples_per_beam": samples or sensor.sampler().sample_count(),
        "max_order": integrator.max_order,
        "estimator": integrator.estimator,
        "lit_pixels": integrator.lit,
        "untrusted_pixels": integrator.untrusted,
        "units": "Stokes: received over emitted energy; Y: m-1 sr-1; lengths: m; angles: rad",
    }
    write_scan(out, scan)
    return scan


def _check_names(scene_path: Path, definitions: dict[str, str]) -> None:
    """Refuse names that Mitsuba rejects or misreads."""
    if not is_text(os.path.abspath(scene_path)):
        raise InputError(
            f"{scene_path}: a name that is not UTF-8 is not allowed for a scene; expected another "
            "file or folder"
        )
    for key, value in definitions.items():
        if "$" in value or not is_text(value):
            raise InputError(
                f"-D {key}={value}: not allowed; expected UTF-8 without $, which stands for a "
                "parameter in a scene"
            )


def files_of(scene_path: str | Path, definitions: dict[str, str]) -> list[Path]:
    """A scene file and the existing files that it names.

    definitions: values for ``$name`` in the scene, which may be names of files.
    """
    scene_path = Path(scene_path)
    if not scene_path.is_file():
        return []
    text = read_text(scene_path, "a Mitsuba scene (XML)")
    values = {*re.findall(r"""value\s*=\s*["']([^"']+)""", text), *definitions.values()}
    named = [folder / value for value in values for folder in (Path(), scene_path.parent)]
    return [scene_path, *(path for path in named if _is_file(path))]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # no value of a scene need be a possible name
        return False


def _reason(error: Exception) -> str:
    """Mitsuba's message in one line; of a plugin's traceback only the last line."""
    text = re.sub(r"Traceback \(most recent call last\):\n(  .*\n)+", "", str(error))
    text = re.sub(r"^\[[\w.]+:\d+\] ", "", text)
    return " ".join(text.split())[:300]
