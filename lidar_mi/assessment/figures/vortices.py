"""The figure of fitted vortex pairs over their data, with the truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lidar_mi.assessment.figures.alt_text import TRUE_CORE
from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    arrow_scale,
    coloured,
    pilots_view,
    save_all,
    speed_of,
)
from lidar_mi.assessment.metrics.vortices import ORIGIN_NAMES, Origin
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.plots import ARROWS, arrow_length
from lidar_mi.retrieval.vortices.pair import VortexPairFit

_STYLE: Mapping[str, tuple[str, str]] = {
    Origin.IMAGES: ("tab:orange", "-"),
    Origin.VECTORS: ("tab:purple", "--"),
}
_SPEED = "m s$^{-1}$"


def draw_all(
    folder: Path,
    image: xr.DataArray,
    vectors: xr.Dataset | None,
    truth: xr.Dataset,
    fits: Mapping[str, VortexPairFit],
    cores: Sequence[Core],
    log: Progress,
) -> list[Drawn]:
    """Draw the fits over the first image, the vectors (None: there are none) and the truth."""
    if not fits:
        return []
    figures = [("fig22_vortices", "The vortex pair", _pair(image, vectors, truth, fits, cores))]
    return save_all(folder, figures, log)


def _pair(
    image: xr.DataArray,
    vectors: xr.Dataset | None,
    truth: xr.Dataset,
    fits: Mapping[str, VortexPairFit],
    cores: Sequence[Core],
) -> Captioned:
    figure = Figure(figsize=(13.6, 12.4), layout="compressed")
    grid = figure.add_gridspec(3, 2)
    first, fitted, wrong, uncertain = (figure.add_subplot(grid[k // 2, k % 2]) for k in range(4))
    cut = figure.add_subplot(grid[2, :])
    y, z = truth["y"].values, truth["z"].values
    best = next(iter(fits))
    model = fits[best].wind(y[None, :], z[:, None])
    true = {name: truth[name].transpose("z", "y").values for name in ("v", "w")}

    field = image.transpose("z", "y")
    top = float(np.nanquantile(field, 0.999))
    coloured(first, field, cmap="gray", vmin=0, vmax=top or 1.0)
    first.set_title("first image, fitted pairs")
    limit = float(np.quantile(np.hypot(true["v"], true["w"]), 0.999)) or 1.0
    _arrows(fitted, y, z, model, limit)
    # on the right is the scale of the arrows
    fitted.set_title(f"wind of the pair from the {ORIGIN_NAMES[best]}", loc="left")
    error = speed_of(model["v"] - true["v"], model["w"] - true["w"]).values
    stderr = speed_of(model["v_stderr"], model["w_stderr"]).values
    most = float(np.quantile(error, 0.995)) or 1.0
    for axes, values, title in (
        (wrong, error, "its error (speed of the difference to the truth)"),
        (uncertain, stderr, "its standard error"),
    ):
        mesh = axes.pcolormesh(
            y, z, values, cmap="magma", vmin=0, vmax=most, shading="nearest", rasterized=True
        )
        figure.colorbar(mesh, ax=axes, label=_SPEED, pad=0.02, extend="max")
        axes.set_title(title)
    for axes in (first, fitted, wrong, uncertain):
        _mark(axes, fits if axes is first else {best: fits[best]}, cores)
        pilots_view(axes, y, z)
    first.legend(loc="lower center", ncols=3, fontsize=8)
    _along(cut, vectors, truth, fits, best)
    return figure, (
        "Circles: fitted cores with their radius of the largest swirl; crosses: true cores. Below: "
        "vertical wind on the level of the pair, with the standard errors of the fit and of valid "
        "vectors."
    )


def _arrows(axes: Axes, y: np.ndarray, z: np.ndarray, model: xr.Dataset, limit: float) -> None:
    every = max(1, round(len(y) / ARROWS))
    at = np.ix_(np.arange(every // 2, len(z), every), np.arange(every // 2, len(y), every))
    v, w = model["v"].values[at], model["w"].values[at]
    step = every * (y[1] - y[0])
    length = arrow_length(np.hypot(v, w), limit)
    arrows = axes.quiver(
        y[at[1]].ravel(),
        z[at[0]].ravel(),
        v,
        w,
        np.hypot(v, w),
        cmap="viridis",
        norm=Normalize(0, limit),
        angles="xy",
        scale_units="xy",
        scale=limit / (length * step),
        width=0.0022,
    )
    arrow_scale(axes, arrows, limit)
    axes.figure.colorbar(arrows, ax=axes, label=f"speed / {_SPEED}", pad=0.02, extend="max")


def _mark(axes: Axes, fits: Mapping[str, VortexPairFit], cores: Sequence[Core]) -> None:
    for name, fit in fits.items():
        colour, style = _STYLE[name]
        for k, vortex in enumerate((fit.port, fit.starboard)):
            label = f"from the {ORIGIN_NAMES[name]}" if k == 0 else None
            shown = {"ls": style, "ec": colour, "lw": 1.8, "label": label}
            place = vortex.y, vortex.z
            axes.add_patch(Circle(place, vortex.core_radius, fill=False, **shown))
    for k, core in enumerate(cores):
        label = f"_{TRUE_CORE}" if k else "true cores"
        axes.plot(core.y, core.z, "+", color="crimson", ms=10, label=label, ls="none")


def _along(
    axes: Axes,
    vectors: xr.Dataset | None,
    truth: xr.Dataset,
    fits: Mapping[str, VortexPairFit],
    best: str,
) -> None:
    y = truth["y"].values
    level = float(fits[best].quantities["centre_z"].value)
    if vectors is not None:
        row = vectors.sel(z=level, method="nearest")
        valid = (row["flag"] == 0).values
        stderr = row["w_stderr"].values[valid]
        axes.errorbar(
            row["y"].values[valid],
            row["w"].values[valid],
            np.nan_to_num(stderr),
            fmt=".",
            ms=5,
            color="0.45",
            ecolor="0.75",
            label="vectors",
            zorder=1,
        )
    axes.plot(y, truth["w"].interp(z=level).values, "k", lw=1.5, label="truth")
    for name, fit in fits.items():
        colour, style = _STYLE[name]
        model = fit.wind(y, np.full_like(y, level))
        w, stderr = model["w"].values, model["w_stderr"].values
        axes.fill_between(y, w - stderr, w + stderr, color=colour, alpha=0.25, lw=0)
        axes.plot(y, w, color=colour, ls=style, lw=1.5, label=f"pair from the {ORIGIN_NAMES[name]}")
    axes.set(xlabel="y / m (port is left)", ylabel=f"w / {_SPEED}", title=f"w at z = {level:.1f} m")
    axes.set_xlim(y.max(), y.min())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
