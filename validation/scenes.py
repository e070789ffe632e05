"""Scenes rendered by the checks, and their images as numpy arrays."""

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np

VARIANT = "llvm_ad_mono_polarized"

DOCS = Path(__file__).resolve().parents[1] / "docs" / "validation"


@dataclass(frozen=True)
class Effort:
    """Effort of a run: ``scale`` times the default number of samples, figures into ``folder``."""

    scale: int = 1
    folder: Path = DOCS
    eradiate: str | None = None
    """Interpreter with eradiate-mitsuba; None: its stored numbers."""
    purpose: Literal["build", "judge"] | None = None
    """Of the families of flows and defects that are measured; None: all."""


def medium(extinction: float, phase="rayleigh_polarized", albedo: float = 1.0) -> dict:
    phase = {"type": phase} if isinstance(phase, str) else phase
    return {"type": "homogeneous", "sigma_t": extinction, "albedo": albedo, "phase": phase}


def grid(values, low, high, phase="rayleigh_polarized", albedo: float = 1.0) -> dict:
    """A medium with ``values`` (z, y, x) at the centres of the cells between two corners."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    volume = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(np.asarray(values, np.float32)[..., None]),
        "to_world": mi.ScalarTransform4f().translate(low).scale(high - low),
        "accel": False,
    }
    phase = {"type": phase} if isinstance(phase, str) else phase
    return {"type": "heterogeneous", "sigma_t": volume, "albedo": albedo, "phase": phase}


def box(low, high, interior: dict, exterior: dict | None = None) -> dict:
    """A cuboid between two corners whose surface lets light pass."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    place = mi.ScalarTransform4f().translate((low + high) / 2).scale((high - low) / 2)
    shape = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": interior}
    return shape | ({"exterior": exterior} if exterior else {})


def layer(start: float, stop: float, interior: dict, exterior=None, half_width=2000.0) -> dict:
    """A box between two planes across the x axis, wide enough to contain all relevant light."""
    low, high = (start, -half_width, -half_width), (stop, half_width, half_width)
    return box(low, high, interior, exterior)


ENVIRONMENT = {"type": "ref", "id": "environment"}


def lidar(size, gate, laser=None, environment=None, **parameters) -> dict:
    """A scanning lidar of (width, height) beams with gates from ``gate[0]`` to ``gate[1]``."""
    sensor = {
        "type": "scanning_lidar",
        "gate_start": gate[0],
        "gate_stop": gate[1],
        "laser": {"type": "laser", "beam_cut": 0.1, "divergence_full_mrad": 2.0, **(laser or {})},
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": "box"},
        },
        **parameters,
    }
    return sensor | ({"medium": environment} if environment else {})


def scene(gate, shapes: dict, size=(1, 1), laser=None, integrator=None, environment=None, **more):
    """A `lidar` and the shapes that it observes; ``more`` are parameters of the lidar.

    ``environment`` is the medium around all, which shapes refer to as `ENVIRONMENT`.
    """
    gc.collect()  # live scenes hold reference cycles and enter the kernels of later ones
    sensor = lidar(size, gate, laser, ENVIRONMENT if environment else None, **more)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "gated_volpath", **(integrator or {})},
            **({"environment": environment} if environment else {}),
            "sensor": sensor,
            **shapes,
        }
    )


def render(loaded, seed: int, samples: int) -> dict[str, np.ndarray]:
    """The rendered scan: quantity to float64 array (gates, rows, columns)."""
    image = np.array(mi.render(loaded, seed=seed, spp=samples)).astype(float)
    names = loaded.integrator().channel_names(loaded.sensors()[0])
    quantities = list(dict.fromkeys(name.partition(".")[2] for name in names))
    image = image.reshape(*image.shape[:2], -1, len(quantities))
    return {name: image[..., k].transpose(2, 0, 1) for k, name in enumerate(quantities)}


def batches(loaded, seed: int, samples: int, number: int) -> dict[str, np.ndarray]:
    """`render` with several seeds: arrays (number, gates, rows, columns)."""
    found = [render(loaded, 1000 * seed + k, samples // number) for k in range(number)]
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


def secants(loaded, size) -> np.ndarray:
    """1 / cos of the angle between each beam and the x axis, (rows, columns)."""
    directions = np.array(mi.traverse(loaded)["sensor.directions"]).reshape(size[1], size[0], 3)
    return 1 / directions[..., 0].astype(float)
