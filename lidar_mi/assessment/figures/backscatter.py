"""The figures of a run: an overview, the paper's figures 5 to 11, and what else a run tells.

All of them show the slab as the pilot sees it: port (+y) on the left, up (+z) at the top.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from lidar_mi.assessment.metrics.cores import Core
from lidar_mi.assessment.metrics.errors import deviations, error_by_quality
from lidar_mi.io.png import write_png

METHOD_NAMES = {
    "cc": "cross-correlation",
    "ws": "weight shift",
    "multipass": "multi-pass correlation",
    "variational": "variational retrieval",
    "vortex_fit": "vortex fit",
}

SOURCE_NAMES = {
    "backscatter": "backscatter",
    "backscatter_noisy": "backscatter with detector noise",
    "extinction": "extinction",
    "extinction_blurred": "extinction blurred by the beam",
    "extinction_without_texture": "extinction without texture",
}
"""What winds are retrieved from, as figures and tables call it."""

BACKSCATTER = "apparent backscatter / 10$^{-6}$ m$^{-1}$ sr$^{-1}$"


@dataclass(frozen=True)
class Scale:
    """What all wind maps of a run share: ``limit``, the speed (m/s) at the end of the colours and
    drawn as an arrow one step long, and the plane's axes ``y``, ``z`` (m)."""

    limit: float
    y: np.ndarray
    z: np.ndarray


def _scale(truth) -> Scale:
    speed = np.hypot(truth.wind["v"], truth.wind["w"])
    # the few nodes of a core must not make all others dark and short
    limit = float(speed.quantile(0.999)) or 1.0
    return Scale(limit, truth.wind["y"].values, truth.wind["z"].values)


@dataclass(frozen=True)
class Drawn:
    """A figure file and what it shows."""

    path: Path
    title: str
    caption: str


def draw_all(
    folder: Path,
    truth,
    scans,
    found: xr.Dataset,
    cores: list[Core],
    sweep: dict[str, float],
    log: Callable,
) -> list[Drawn]:
    """Draw every figure of a backscatter run as PNG into ``folder``.

    Parameters
    ----------
    truth : lidar_mi.experiment.truth.Truth
    scans : the two rendered scans
    found : winds with dims (source, algorithm, z, y), from `lidar_mi.experiment.stages.backscatter.winds`
    sweep : metrics from `lidar_mi.experiment.stages.backscatter.texture_sweep`
    """
    scale = _scale(truth)
    plates = (
        (
            "fig00_overview",
            "What the lidar sees, and the wind found in it",
            _overview(scans, found, cores, scale),
        ),
        ("fig05_extinction", "Extinction", _extinction(truth)),
        (
            "fig06_wind_from_extinction",
            "Wind: truth and from the extinction pair",
            _wind_and_truth(truth, found, cores, scale),
        ),
        (
            "fig07_deviation_from_truth",
            "Winds from extinction against the truth",
            _deviation_maps(found, "extinction", None),
        ),
        ("fig08_backscatter", "Backscatter images", _backscatter(scans)),
        (
            "fig09_backscatter_against_extinction",
            "Backscatter against extinction",
            _picture_differences(truth, scans),
        ),
        (
            "fig10_wind_from_backscatter",
            "Wind from the backscatter pair",
            _retrieved(found, "backscatter", cores, scale),
        ),
        (
            "fig11_deviation_from_extinction_winds",
            "What the instrument changes in the winds",
            _deviation_maps(found, "backscatter", "extinction"),
        ),
        ("fig12_error_by_texture", "Error and texture", _error_by_texture(found, sweep)),
    )
    if (drawn := _error_and_bound(found)) is not None:
        plates += (("fig12b_error_and_bound", "Errors and what the noise allows", drawn),)
    if "depolarization" in scans[0]:
        plates += (
            (
                "fig14_depolarization",
                "Linear depolarisation ratio",
                _product(
                    scans[0],
                    "depolarization",
                    "linear depolarisation ratio",
                    "Linear depolarisation ratio of the first picture, cross- over co-polarised light.",
                ),
            ),
        )
    if "multiple_scattering_fraction" in scans[0]:
        plates += (
            (
                "fig15_multiple_scattering",
                "Multiple scattering",
                _product(
                    scans[0],
                    "multiple_scattering_fraction",
                    "share of multiple scattering",
                    "Share of the light of the first picture that was scattered more than once.",
                ),
            ),
        )
    return save_all(folder, plates, log)


def save_all(folder: Path, plates, log: Callable) -> list[Drawn]:
    """Save plates, each (file name, title, (figure, caption)), as PNG."""
    folder.mkdir(exist_ok=True)
    drawn = []
    for index, (name, title, (figure, caption)) in enumerate(plates):
        log.bar(f"drawing {title.lower()}", index / len(plates))
        path = folder / f"{name}.png"
        write_png(figure, path, cropped=True)
        drawn.append(Drawn(path, title, caption))
    return drawn


def _sheet(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(6.8 * columns, 4.3 * rows), layout="compressed")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _frame(axes, y, z, title: str) -> None:
    """The pilot's view: port on the left, up at the top, metres true to scale."""
    axes.set(title=title, xlabel="y / m (port is left)", ylabel="z / m", aspect="equal")
    axes.set_xlim(float(y.max()), float(y.min()))
    axes.set_ylim(float(z.min()), float(z.max()))


def _image(axes, field: xr.DataArray, title: str, label: str, extend="neither", **style) -> None:
    y, z = field["y"], field["z"]
    mesh = axes.pcolormesh(
        y, z, field.transpose("z", "y").values, shading="nearest", rasterized=True, **style
    )
    _frame(axes, y, z, title)
    bar = axes.figure.colorbar(mesh, ax=axes, label=label, pad=0.02, extend=extend)
    # whole numbers, not what they have beyond one that stands elsewhere
    bar.formatter.set_useOffset(False)


def _arrows(axes, wind: xr.Dataset, cores: list[Core], title: str, scale: Scale) -> None:
    """Vectors where they belong, about 45 across; flagged ones grey, valid ones by speed."""
    every = max(1, round(wind.sizes["y"] / 45))
    step = every * float(wind["y"][1] - wind["y"][0]) if wind.sizes["y"] > 1 else 1.0
    thin = wind.isel(z=slice(every // 2, None, every), y=slice(every // 2, None, every))
    y, z = (np.broadcast_to(thin[f"{a}_vector"], thin["v"].shape).ravel() for a in "yz")
    v, w, flag = (thin[name].values.ravel() for name in ("v", "w", "flag"))
    known = np.isfinite(v) & np.isfinite(w)
    style = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": scale.limit / (1.8 * step),
        "width": 0.0022,
    }
    bad, good = known & (flag != 0), known & (flag == 0)
    if bad.any():
        axes.quiver(y[bad], z[bad], v[bad], w[bad], color="0.75", **style)
    arrows = axes.quiver(
        y[good],
        z[good],
        v[good],
        w[good],
        np.hypot(v, w)[good],
        cmap="viridis",
        norm=Normalize(0, scale.limit),
        **style,
    )
    for core in cores:
        axes.plot(core.y, core.z, "+", color="crimson", ms=9)
    _frame(axes, scale.y, scale.z, title)
    axes.figure.colorbar(arrows, ax=axes, label="speed / m s$^{-1}$", pad=0.02, extend="max")


def _truth_vectors(wind: xr.Dataset) -> xr.Dataset:
    """True wind at the places of a retrieval's vectors, as a retrieval without flags."""
    true = wind[["v_true", "w_true", "y_vector", "z_vector"]].rename(v_true="v", w_true="w")
    return true.assign(flag=xr.zeros_like(wind["flag"]))


def _overview(scans, found, cores, scale):
    figure, axes = _sheet(1, 2)
    detected = "Y_noisy" in scans[0]
    first = scans[0]["Y_noisy" if detected else "Y"] * 1e6
    norm = _span(first) if detected else _bright([first])
    _image(
        axes[0, 0],
        first,
        "backscatter, $t_1$",
        BACKSCATTER,
        "both" if detected else "max",
        norm=norm,
        cmap="cividis",
    )
    source = "backscatter_noisy" if detected else "backscatter"
    wind = found.sel(source=source).isel(algorithm=0)
    _arrows(axes[0, 1], wind, cores, "wind from two such pictures", scale)
    noise = " with photon, sky, dark and speckle noise of one pulse a beam" if detected else ""
    return figure, (
        f"Left: the first backscatter picture{noise}. Right: the cross-flow wind found from it and "
        f"the second one by {METHOD_NAMES[str(wind['algorithm'].values)]}; grey vectors are "
        "flagged, red crosses mark the true cores."
    )


def _extinction(truth):
    figure, axes = _sheet(1, 2)
    fields = [truth.image(k) * 1e3 for k in (0, 1)]
    norm = _bright(fields)
    for k, field in enumerate(fields):
        _image(
            axes[0, k],
            field,
            f"$t_{k + 1}$",
            "extinction / km$^{-1}$",
            "max",
            norm=norm,
            cmap="cividis",
        )
    return figure, (
        "Extinction coefficient of the slab at t1 and t2, averaged over the gate's depth. "
        "The difference in dt is hardly visible; the retrieval finds it."
    )


def _wind_and_truth(truth, found, cores, scale):
    figure, axes = _sheet(2, max(2, found.sizes["algorithm"]))
    first = found.sel(source="extinction").isel(algorithm=0)
    _arrows(axes[0, 0], _truth_vectors(first), cores, "true wind", scale)
    speed = np.hypot(truth.wind["v"], truth.wind["w"])
    _image(
        axes[0, 1],
        speed,
        "speed of the true wind",
        "speed / m s$^{-1}$",
        extend="max",
        norm=Normalize(0, scale.limit),
        cmap="viridis",
    )
    for axis in axes[0, 2:]:
        axis.set_axis_off()
    _retrieved_into(axes[1], found, "extinction", cores, scale)
    return figure, (
        "Above: the true cross-flow wind and its speed. Below: winds retrieved from the "
        "extinction pair. Grey vectors are flagged; red crosses mark the true cores."
    )


def _retrieved_into(axes, found, source, cores, scale):
    methods = [str(method) for method in found["algorithm"].values]
    for axis in axes[len(methods) :]:
        axis.set_axis_off()
    for axis, method in zip(axes, methods):
        wind = found.sel(source=source, algorithm=method)
        _arrows(axis, wind, cores, f"{METHOD_NAMES[method]}, {source}", scale)


def _retrieved(found, source, cores, scale):
    figure, axes = _sheet(1, max(2, found.sizes["algorithm"]))
    _retrieved_into(axes[0], found, source, cores, scale)
    return figure, (
        f"Winds retrieved from the rendered {source} pair, unfiltered: grey vectors are flagged, red "
        "crosses mark the true cores."
    )


def _deviation_maps(found, source, reference):
    methods = [str(m) for m in found["algorithm"].values]
    figure, axes = _sheet(len(methods), 2)
    for row, method in zip(axes, methods):
        wind = found.sel(source=source, algorithm=method)
        other = (
            _truth_vectors(wind)
            if reference is None
            else found.sel(source=reference, algorithm=method)
        )
        # a vector that its own flags call wrong says nothing of the method
        error = deviations(wind, other).where((wind["flag"] == 0) & (other["flag"] == 0))
        limit = _upper(abs(error["speed"]), 0.99) or 1.0
        for axis in row:
            axis.set_facecolor("0.7")
        _image(
            row[0],
            error["speed"],
            f"{METHOD_NAMES[method]}: speed",
            "speed / m s$^{-1}$",
            extend="both",
            norm=TwoSlopeNorm(0, -limit, limit),
            cmap="RdBu_r",
        )
        turn = min(_upper(abs(error["direction"]), 0.99) or 1.0, np.pi)
        _image(
            row[1],
            error["direction"],
            f"{METHOD_NAMES[method]}: direction",
            "direction / rad",
            extend="both",
            norm=TwoSlopeNorm(0, -turn, turn),
            cmap="PuOr_r",
        )
    against = "the true wind" if reference is None else f"winds from {reference}"
    return figure, (
        f"Deviations of winds from {source} against {against}: speed (left) and direction "
        "(right). Grey: flagged, or no displacement."
    )


def _bright(fields) -> Normalize:
    """From 0, or from the darkest pixels where nothing is dark, to the brightest.

    Single bright pixels must not darken all others.
    """
    low = min(float(field.quantile(0.001)) for field in fields)
    high = max(_upper(field, 0.999) for field in fields)
    return Normalize(low if low > 0.3 * high else 0, high)


def _upper(field: xr.DataArray, share: float) -> float:
    """The value that this share of a field's finite values does not exceed; 0 if there is none."""
    values = field.values[np.isfinite(field.values)]
    return float(np.quantile(values, share)) if values.size else 0.0


def _backscatter(scans):
    figure, axes = _sheet(1, 2)
    norm = _bright([scan["Y"] * 1e6 for scan in scans])
    for k, scan in enumerate(scans):
        _image(
            axes[0, k],
            scan["Y"] * 1e6,
            f"$t_{k + 1}$",
            extend="max",
            label=BACKSCATTER,
            norm=norm,
            cmap="cividis",
        )
    return figure, (
        "Rendered backscatter, normalised for range, gate length and the environment's "
        "transmittance; without the noise of a detector."
    )


def _product(scan, name, label, caption):
    """What a scan tells of its first gate, and how well it knows it."""
    figure, axes = _sheet(1, 2)
    first = scan.isel(gate=0)
    _image(axes[0, 0], first[name], "$t_1$", label, "both", norm=_span(first[name]), cmap="cividis")
    stderr = first[f"{name}_stderr"]
    bound = scan.attrs[f"{name}_stderr_is_bound"]
    kind = "upper bound of the standard error" if bound else "standard error"
    _image(axes[0, 1], stderr, kind, label, "both", norm=_span(stderr), cmap="cividis")
    return figure, (
        f"{caption} Right: {kind} of each pixel, from the simulation's photons. Colours span the "
        "middle 99 % of the pixels."
    )


def _span(field: xr.DataArray) -> Normalize:
    """The middle 99 % of the values: single bright pixels must not decide the colours."""
    low, high = (float(field.quantile(q)) for q in (0.005, 0.995))
    # equal values get one colour, not that of their rounding
    half = max((high - low) / 2, 1e-5 * abs(high + low), 1e-9)
    return Normalize((low + high) / 2 - half, (low + high) / 2 + half)


def _picture_differences(truth, scans):
    figure, axes = _sheet(1, 2)
    differences = []
    for k, scan in enumerate(scans):
        field = truth.image(k).interp(y=scan["y"], z=scan["z"])
        differences.append(scan["Y"] / scan["Y"].mean() - field / field.mean())
    limit = max(float(np.abs(d).quantile(0.999)) for d in differences)
    for k, difference in enumerate(differences):
        _image(
            axes[0, k],
            difference,
            f"$t_{k + 1}$",
            "difference of relative values",
            "both",
            norm=TwoSlopeNorm(0, -limit, limit),
            cmap="RdBu_r",
        )
    return figure, (
        "Backscatter over its mean minus extinction over its mean: the beam's width rounds off "
        "sharp structure, Monte Carlo noise adds grain, and a pulse that is long beside the slab "
        "mixes in the air before and behind it."
    )


def _error_and_bound(found):
    """Rms errors in groups of vectors of like Cramer-Rao bound; None where no noise bounds any."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    span = []
    for axes, name in zip(figure.subplots(1, 2), ("v", "w")):
        for source in (s for s in found["source"].values if s.startswith("backscatter")):
            for method in found["algorithm"].values:
                wind = found.sel(source=source, algorithm=method)
                bound = wind[f"{name}_bound"].values
                error = (wind[name] - wind[f"{name}_true"]).values
                used = (wind["flag"].values == 0) & np.isfinite(error) & np.isfinite(bound)
                used &= bound > 0
                if used.sum() < 100:
                    continue
                groups = np.array_split(np.argsort(bound[used]), 12)
                least, rms = (
                    [float(np.sqrt(np.mean(values[used][g].astype(float) ** 2))) for g in groups]
                    for values in (bound, error)
                )
                label = f"{METHOD_NAMES[method]} from {SOURCE_NAMES[source]}"
                axes.plot(least, rms, "o-", ms=4, label=label)
                span += [min(least), max(least)]
        if not span:
            return None
        axes.plot([0, max(span)], [0, max(span)], "k--", lw=1, label="bound")
        axes.set(
            xlabel=f"Cramer-Rao bound of {name} / m s$^{{-1}}$",
            xlim=(0, None),
            ylim=(0, None),
            ylabel=f"rms error of {name} / m s$^{{-1}}$",
            title=f"valid vectors, {name}",
        )
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure, (
        "Errors of valid vectors, in groups by what the pictures' noise allows any unbiased method "
        "that uses one template alone. Below the line: methods that use more than a template. "
        "Far above it on the left: errors that are not the noise's, as of flow that a window or a "
        "smooth field cannot follow."
    )


def by_factors(axes) -> None:
    """A logarithmic upward axis where values differ by more than a factor of 3, plain numbers on it."""
    values = np.concatenate(
        [np.ravel(line.get_ydata()).astype(float) for line in axes.lines] or [[]]
    )
    values = values[np.isfinite(values) & (values > 0)]
    if values.size and values.max() > 3 * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())


def _error_by_texture(found, sweep):
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    levels = sorted({int(key.split(".")[1].removesuffix("_percent")) for key in sweep})
    for name, marker in (("v", "o"), ("w", "s")):
        # air without any structure gives no displacement, hence no error either
        errors = [sweep.get(f"texture_sweep.{level}_percent.rmse_{name}") for level in levels]
        errors = [np.nan if error is None else error for error in errors]
        left.plot(levels, errors, marker=marker, label=name)
    left.set(
        xlabel="sub-grid texture, rms / %",
        ylabel="rms error / m s$^{-1}$",
        title="cross-correlation from extinction, all vectors",
    )
    for source, marker in (
        ("extinction", "o"),
        ("backscatter", "s"),
        ("extinction_without_texture", "^"),
    ):
        for method in found["algorithm"].values:
            wind = found.sel(source=source, algorithm=method)
            groups = error_by_quality(wind, _truth_vectors(wind), "isotropy")
            if not np.isfinite(groups["rmse"]).any():
                continue
            right.plot(
                groups["isotropy"],
                groups["rmse"],
                marker=marker,
                ms=5,
                ls="-" if method == "cc" else ":",
                label=f"{METHOD_NAMES[method]} from {SOURCE_NAMES[source]}",
            )
    right.set(
        xlabel="isotropy: weakest over strongest rms slope in a window",
        ylabel="rms error of v and w / m s$^{-1}$",
        title="all vectors, in groups by their local isotropy",
    )
    for axes in (left, right):
        by_factors(axes)
        axes.grid(alpha=0.3, which="both")
    left.legend(fontsize=8)
    # many lines: there is room below alone
    right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return figure, (
        "Winds can only be as good as the structure that moves with them. Left: the extinction "
        "pair with more and less sub-grid texture. Right: this run's vectors, grouped by whether "
        "their windows have structure in both directions; along a mere edge nothing can be told "
        "(aperture problem)."
    )
