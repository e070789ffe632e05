"""Sensitivity of winds to the settings of the methods: each field halved and doubled in turn."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import partial

import numpy as np

from lidar_mi.atmosphere.vortex import velocity
from lidar_mi.retrieval.correlation.settings import VOLUME_MULTIPASS, MultipassSettings
from lidar_mi.retrieval.flow.settings import VOLUME_VARIATIONAL, VariationalSettings
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.volume import retrieve_wind_volume
from tests.support import volumes

from .cases import DT, vortex_pair_images
from .report import Comparison, row

NOISE = 0.03
VOLUME = (16, 40, 56)
VOLUME_NOISE = 0.01
# images of this size are solved directly; a seed has no magnitude
UNUSED = {
    "images": ("solver", "strips"),
    "volumes": ("strips", "solver.seed", "largest_ratio", "largest_change_divergence"),
}

Errors = tuple[float, float]
"""Rms error, m/s, and rms of the normalised errors."""


def compare(
    repeats: int = 5, columns: int = 110, rows: int = 90, volume: tuple[int, ...] = VOLUME
) -> Comparison:
    """Change of the rms error, mean over as many textures as ``repeats``."""
    lines = []
    for case, method, settings, errors in cases(columns, rows, volume):
        seeds = range(1, repeats + 1)
        base = mean_errors(errors, settings, seeds)
        name = f"{case}, {method}"
        note = f"normalised errors {base[1]:.2f}"
        lines.append(row(name, "defaults: rms error, m/s", "", [base[0]], [base[0]], note=note))
        for path, value, less, more in varied(settings):
            if path.startswith(UNUSED[case]):
                continue
            found = [
                None
                if other == value
                else mean_errors(errors, changed(settings, path, other), seeds)
                for other in (less, more)
            ]
            change = [[] if f is None else [100 * (f[0] / base[0] - 1)] for f in found]
            normalised = " / ".join("" if f is None else f"{f[1]:.2f}" for f in found)
            quantity = f"{path} = {shown(value)}: {shown(less)} / {shown(more)}"
            lines.append(row(name, quantity, "%", *change, note=f"normalised errors {normalised}"))
    return Comparison(
        "Settings of the methods, halved and doubled",
        "halved",
        "doubled",
        tuple(lines),
        (
            (
                f"Change of the rms error of all vectors, mean over {repeats} textures. Images: "
                f"vortex pair of {columns} x {rows} px with {NOISE:.0%} noise. Volumes: vortices "
                f"with a wavy wind along them, {' x '.join(map(str, volume))} voxels, "
                f"{VOLUME_NOISE:.0%} noise, 10 % of the texture. Switches are inverted."
            ),
        ),
    )


def cases(
    columns: int, rows: int, volume: tuple[int, ...]
) -> Iterator[tuple[str, str, object, Callable]]:
    """Kind, method, default settings and errors(settings, seed)."""
    for method, settings in (
        ("multipass", MultipassSettings()),
        ("variational", VariationalSettings()),
    ):
        yield "images", method, settings, partial(image_errors, method, columns, rows)
    for method, settings in (
        ("correlation", VOLUME_MULTIPASS),
        ("variational", VOLUME_VARIATIONAL),
    ):
        yield "volumes", method, settings, partial(volume_errors, method, volume)


def image_errors(method: str, columns: int, rows: int, settings, seed: int) -> np.ndarray:
    """Errors and normalised errors of every component, (2, values)."""
    pair = vortex_pair_images(NOISE, seed, columns, rows)
    wind = retrieve_wind(
        pair.first,
        pair.second,
        DT,
        method,
        windows=WindowSizes(stride=2),
        noise=NOISE,
        settings=settings,
    )
    z, y = np.meshgrid(wind["z"], wind["y"], indexing="ij")
    truth = dict(zip("vw", velocity(pair.vortices, y, z), strict=True))
    return _errors(wind, truth)


def volume_errors(method: str, shape: tuple[int, ...], settings, seed: int) -> np.ndarray:
    """Errors and normalised errors of every component, (2, values)."""
    flow, back = volumes.vortex_pair(shape)
    pair = volumes.advected(shape, back, VOLUME_NOISE, seed)
    wind = retrieve_wind_volume(*pair, volumes.DT, method, noise=VOLUME_NOISE, settings=settings)
    places = np.meshgrid(*(wind[a] / volumes.SPACING for a in "xzy"), indexing="ij")
    scale = volumes.SPACING / volumes.DT
    truth = dict(zip("uwv", flow(np.stack(places)) * scale, strict=True))
    return _errors(wind, truth)


def _errors(wind, truth: dict[str, np.ndarray]) -> np.ndarray:
    found = []
    for name, true in truth.items():
        error = wind[name].values - true
        found.append(np.stack([error, error / wind[f"{name}_stderr"].values]).reshape(2, -1))
    found = np.concatenate(found, 1)
    return found[:, np.isfinite(found).all(0)]


def mean_errors(errors: Callable, settings, seeds) -> Errors:
    """Over all textures."""
    squares = np.mean([(errors(settings, seed) ** 2).mean(1) for seed in seeds], axis=0)
    return tuple(np.sqrt(squares))


def varied(settings, path: str = "") -> Iterator[tuple[str, object, object, object]]:
    """Every field with its path, value, and both values beside it."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        name = path + field.name
        if is_dataclass(value):
            yield from varied(value, f"{name}.")
        elif name.endswith("smoothing"):
            # odd numbers of shells
            yield name, value, max(1, value // 2 | 1), 2 * value + 1
        else:
            yield name, value, _times(value, 0.5), _times(value, 2)


def _times(value, factor: float):
    if isinstance(value, tuple):
        return tuple(_times(part, factor) for part in value)
    if isinstance(value, bool):
        return not value if factor > 1 else value
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def changed(settings, path: str, value):
    """The settings with another value at a path."""
    name, _, rest = path.partition(".")
    value = changed(getattr(settings, name), rest, value) if rest else value
    return replace(settings, **{name: value})


def shown(value) -> str:
    """A value as short text."""
    if isinstance(value, tuple):
        return ", ".join(map(shown, value))
    return str(value) if isinstance(value, bool) else f"{value:.3g}"
