"""The vortices' chapter of a report: the fitted pair over what it was fitted to, beside the truth."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lidar_mi.assessment.figures.backscatter import Drawn, save_all
from lidar_mi.assessment.metrics.cores import Core, ring_averages
from lidar_mi.assessment.report.digits import fixed, with_error
from lidar_mi.assessment.report.page import Chapter, Tables
from lidar_mi.retrieval.vortices.pair import VortexPairFit

SOURCES = {"images": "images", "vectors": "wind vectors"}

_STYLE = {"images": ("tab:orange", "-"), "vectors": ("tab:purple", "--")}
_SPEED = "m s$^{-1}$"
# rows of the table: quantity, name, unit
_ROWS = (
    *(
        (f"{side}_{key}", f"{side}: {label}", unit)
        for side in ("port", "starboard")
        for key, label, unit in (
            ("circulation_5_15", "circulation, mean over 5 to 15 m", "m²/s"),
            ("circulation", "circulation, far from the core", "m²/s"),
            ("core_radius", "core radius", "m"),
            ("y", "y", "m"),
            ("z", "z", "m"),
        )
    ),
    ("separation", "separation b0", "m"),
    ("descent_speed", "descent speed w0 = circulation / (2 pi b0)", "m/s"),
    ("drift_v", "velocity of the pair along y", "m/s"),
    ("drift_w", "velocity of the pair along z", "m/s"),
)
_ERRORS = (
    ("rmse_v", "rms error of v", "m/s"),
    ("rmse_w", "rms error of w", "m/s"),
    ("outside_cores.rmse_v", "rms error of v beyond two core radii", "m/s"),
    ("outside_cores.rmse_w", "rms error of w beyond two core radii", "m/s"),
    ("reduced_variance_v", "variance of reduced errors of v", ""),
    ("reduced_variance_w", "variance of reduced errors of w", ""),
)


def true_pair(wind: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """What a true wind says of its vortices, by the names of `VortexPairFit.quantities`.

    Circulations and the velocity of the pair are averages over rings of 5 to 15 m about the cores
    (`cores.ring_averages`); what cannot be told (one vortex only, rings beyond the field) is left
    out. Circulation far from the core is that of a model, not of a flow.
    """
    true, carried = {}, []
    for core in cores:
        side = "port" if core.circulation > 0 else "starboard"
        true |= {f"{side}_core_radius": core.radius, f"{side}_y": core.y, f"{side}_z": core.z}
        rings = ring_averages(wind, core, [other for other in cores if other is not core])
        if rings is not None:
            true[f"{side}_circulation_5_15"] = rings.circulation
            carried.append((rings.v, rings.w))
    if len(cores) == 2:
        port, starboard = cores
        true |= {
            "separation": float(np.hypot(port.y - starboard.y, port.z - starboard.z)),
            "centre_y": (port.y + starboard.y) / 2,
            "centre_z": (port.z + starboard.z) / 2,
        }
    if len(carried) == 2:
        true["drift_v"], true["drift_w"] = (float(mean) for mean in np.mean(carried, axis=0))
    return true


def draw_all(
    folder: Path,
    image: xr.DataArray,
    vectors: xr.Dataset | None,
    truth: xr.Dataset,
    fits: Mapping[str, VortexPairFit],
    cores: Sequence[Core],
    log: Callable,
) -> list[Drawn]:
    """Draw the fits over the first image, the vectors (None: there are none) and the truth."""
    if not fits:
        return []
    plates = [("fig22_vortices", "The vortex pair", _pair(image, vectors, truth, fits, cores))]
    return save_all(folder, plates, log)


def _pair(image, vectors, truth, fits, cores):
    figure = Figure(figsize=(13.6, 12.4), layout="compressed")
    grid = figure.add_gridspec(3, 2)
    seen, found, wrong, stated = (figure.add_subplot(grid[k // 2, k % 2]) for k in range(4))
    cut = figure.add_subplot(grid[2, :])
    y, z = truth["y"].values, truth["z"].values
    best = next(iter(fits))
    model = fits[best].wind(y[None, :], z[:, None])
    true = {name: truth[name].transpose("z", "y").values for name in ("v", "w")}

    field = image.transpose("z", "y")
    top = float(np.nanquantile(field, 0.999))
    seen.pcolormesh(
        field["y"],
        field["z"],
        field.values,
        cmap="gray",
        vmin=0,
        vmax=top or 1.0,
        shading="nearest",
        rasterized=True,
    )
    seen.set_title("first picture, fitted pairs")
    limit = float(np.quantile(np.hypot(true["v"], true["w"]), 0.999)) or 1.0
    _arrows(found, y, z, model, limit)
    found.set_title(f"wind of the pair from the {SOURCES[best]}")
    error = np.hypot(model["v"] - true["v"], model["w"] - true["w"]).values
    stderr = np.hypot(model["v_stderr"], model["w_stderr"]).values
    most = float(np.quantile(error, 0.995)) or 1.0
    for axes, values, title in (
        (wrong, error, "its error (speed of the difference to the truth)"),
        (stated, stderr, "its standard error"),
    ):
        mesh = axes.pcolormesh(
            y, z, values, cmap="magma", vmin=0, vmax=most, shading="nearest", rasterized=True
        )
        figure.colorbar(mesh, ax=axes, label=_SPEED, pad=0.02, extend="max")
        axes.set_title(title)
    for axes in (seen, found, wrong, stated):
        _mark(axes, fits if axes is seen else {best: fits[best]}, cores)
        axes.set(aspect="equal", xlabel="y / m (port is left)", ylabel="z / m")
        axes.set_xlim(y.max(), y.min())
        axes.set_ylim(z.min(), z.max())
    seen.legend(loc="lower center", ncols=3, fontsize=8)
    _along(cut, vectors, truth, fits, best)
    return figure, (
        "Circles: fitted cores with their radius of the largest swirl; crosses: true cores. Below: "
        "vertical wind on the level of the pair, with the standard errors of the fit and of good "
        "vectors."
    )


def _arrows(axes, y, z, model, limit):
    every = max(1, round(len(y) / 40))
    at = np.ix_(np.arange(every // 2, len(z), every), np.arange(every // 2, len(y), every))
    v, w = model["v"].values[at], model["w"].values[at]
    step = every * (y[1] - y[0])
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
        scale=limit / (1.8 * step),
        width=0.0022,
    )
    axes.figure.colorbar(arrows, ax=axes, label=f"speed / {_SPEED}", pad=0.02, extend="max")


def _mark(axes, fits, cores):
    for name, fit in fits.items():
        colour, style = _STYLE[name]
        for k, vortex in enumerate((fit.port, fit.starboard)):
            label = f"from the {SOURCES[name]}" if k == 0 else None
            axes.add_patch(
                Circle(
                    (vortex.y, vortex.z),
                    vortex.core_radius,
                    fill=False,
                    ls=style,
                    ec=colour,
                    lw=1.8,
                    label=label,
                )
            )
    for k, core in enumerate(cores):
        axes.plot(
            core.y,
            core.z,
            "+",
            color="crimson",
            ms=10,
            label=None if k else "true cores",
            ls="none",
        )


def _along(axes, vectors, truth, fits, best):
    y = truth["y"].values
    level = float(fits[best].quantities["centre_z"].value)
    if vectors is not None:
        row = vectors.sel(z=level, method="nearest")
        good = (row["flag"] == 0).values
        stderr = row["w_stderr"].values[good]
        axes.errorbar(
            row["y"].values[good],
            row["w"].values[good],
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
        axes.plot(y, w, color=colour, ls=style, lw=1.5, label=f"pair from the {SOURCES[name]}")
    axes.set(xlabel="y / m (port is left)", ylabel=f"w / {_SPEED}", title=f"w at z = {level:.1f} m")
    axes.set_xlim(y.max(), y.min())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)


def vortex_chapter(
    metrics: Mapping[str, float],
    fits: Mapping[str, VortexPairFit],
    refused: Mapping[str, str],
    drawn: Sequence[Drawn],
) -> Chapter:
    """What wake vortices are described by, beside the truth.

    Parameters
    ----------
    metrics : mapping
        From `lidar_mi.experiment.stages.vortices`.
    fits : mapping of str to VortexPairFit
        The good ones, by name of `SOURCES`.
    refused : mapping of str to str
        Why there is no other.
    """
    purpose = (
        "Two vortices in a mean wind are fitted to the two pictures as a whole, and to the wind "
        "vectors. The fitted pair gives the wind anywhere, with its error (vortex.json)."
    )
    lead = [purpose]
    lead += [sentence for name in fits if (sentence := _verdict(metrics, name))]
    lead += [f"No pair from the {SOURCES[name]}: {reason}." for name, reason in refused.items()]
    heads = ["truth", *(f"from the {SOURCES[name]}" for name in fits)]
    pair = [
        (label, unit, [_shown(metrics, f"vortex.{name}.{key}") for name in ("truth", *fits)])
        for key, label, unit in _ROWS
    ]
    errors = [
        (label, unit, [_shown(metrics, f"vortex.{name}.{key}") for name in fits])
        for key, label, unit in _ERRORS
    ]
    tables = [("The vortex pair", heads, pair)]
    if fits:
        tables.append(("The pair's wind against the truth, all over the slab", heads[1:], errors))
    numbers = Tables(
        heading="How well the vortices are known",
        legend="Values with standard errors, at mid-time of the pictures; core radius and "
        "circulation far from the core belong to the profile that was fitted (Lamb-Oseen), a true "
        "core radius is that of the largest swirl. True circulations and velocities are averages "
        "over rings of 5 to 15 m; a dash: cannot be told.",
        tables=tables,
    )
    return Chapter("The vortices", lead, drawn, numbers)


def _verdict(metrics, name) -> str | None:
    """How far circulation and places of a fit are off, in one sentence."""
    true, found = (
        {key: metrics.get(f"vortex.{which}.{key}") for key, _, _ in _ROWS}
        for which in ("truth", name)
    )
    sides = [side for side in ("port", "starboard") if true[f"{side}_circulation_5_15"] is not None]
    if len(sides) < 2:
        return None
    shares = [
        abs(found[f"{side}_circulation_5_15"] / true[f"{side}_circulation_5_15"] - 1)
        for side in sides
    ]
    places = [
        np.hypot(*(found[f"{side}_{axis}"] - true[f"{side}_{axis}"] for axis in "yz"))
        for side in sides
    ]
    return (
        f"From the {SOURCES[name]}, circulation is off by {100 * shares[0]:.1f} % (port) and "
        f"{100 * shares[1]:.1f} % (starboard), places by {places[0]:.2f} and {places[1]:.2f} m."
    )


def _shown(metrics, key: str) -> str:
    value, stderr = metrics.get(key), metrics.get(f"{key}_stderr")
    if value is None:
        return "-"
    return fixed(value) if stderr is None else with_error(value, stderr)
