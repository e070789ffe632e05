"""The figures of a run: the paper's figures 5 to 11, and what texture does to the error.

All of them show the slab as the pilot sees it: port (+y) on the left, up (+z) at the top.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize, TwoSlopeNorm
from matplotlib.figure import Figure

from .cores import Core
from .errors import deviations, error_by_texture

METHOD_NAMES = {"cc": "cross-correlation", "ws": "weight shift"}
ARROW = 0.35  # metres drawn for 1 m/s
SPEED_LIMIT = 18.0  # m/s, the end of the colour scale


@dataclass(frozen=True)
class Drawn:
    """A figure file and what it shows."""

    path: Path
    title: str
    caption: str


def draw_all(
    folder: Path, truth, scans, found: xr.Dataset, cores: list[Core], sweep: dict[str, float],
    log: Callable,
) -> list[Drawn]:
    """Draw every figure of a backscatter run as PNG into ``folder``.

    Parameters
    ----------
    truth : lidar_mi.experiment.Truth
    scans : the two rendered scans
    found : winds with dims (source, algorithm, z, y), from `lidar_mi.experiment.winds`
    sweep : metrics from `lidar_mi.experiment.texture_sweep`
    """
    folder.mkdir(exist_ok=True)
    plates = (
        ("fig05_extinction", "Extinction", _extinction(truth)),
        ("fig06_wind_from_extinction", "Wind: truth and from the extinction pair",
         _wind_and_truth(truth, found, cores)),
        ("fig07_deviation_from_truth", "Winds from extinction against the truth",
         _deviation_maps(found, "extinction", None)),
        ("fig08_backscatter", "Backscatter images", _backscatter(scans)),
        ("fig09_backscatter_against_extinction", "Backscatter against extinction",
         _picture_differences(truth, scans)),
        ("fig10_wind_from_backscatter", "Wind from the backscatter pair",
         _retrieved(found, "backscatter", cores)),
        ("fig11_deviation_from_extinction_winds", "What the instrument changes in the winds",
         _deviation_maps(found, "backscatter", "extinction")),
        ("fig12_error_by_texture", "Error and texture", _error_by_texture(found, sweep)),
    )  # fmt: skip
    if "Y_noisy" in scans[0]:
        plates += (("fig13_detector", "What the detector reads", _detected(scans, found, cores)),)
    if "depolarization" in scans[0]:
        plates += (("fig14_depolarization", "Linear depolarisation ratio", _product(
            scans[0], "depolarization", "linear depolarisation ratio",
            "Linear depolarisation ratio of the first picture, cross- over co-polarised light.",
        )),)  # fmt: skip
    if "multiple_scattering_fraction" in scans[0]:
        plates += (("fig15_multiple_scattering", "Multiple scattering", _product(
            scans[0], "multiple_scattering_fraction", "share of multiple scattering",
            "Share of the light of the first picture that was scattered more than once.",
        )),)  # fmt: skip
    drawn = []
    for index, (name, title, (figure, caption)) in enumerate(plates):
        log.bar(f"drawing {title.lower()}", index / len(plates))
        path = folder / f"{name}.png"
        temporary = path.with_name(f".{path.name}")
        try:
            figure.savefig(temporary, dpi=110, format="png")
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
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


def _image(axes, field: xr.DataArray, title: str, label: str, **style) -> None:
    y, z = field["y"], field["z"]
    mesh = axes.pcolormesh(
        y, z, field.transpose("z", "y").values, shading="nearest", rasterized=True, **style
    )
    _frame(axes, y, z, title)
    axes.figure.colorbar(mesh, ax=axes, label=label, pad=0.02)


def _arrows(axes, wind: xr.Dataset, cores: list[Core], title: str, every: int) -> None:
    """Vectors where they belong; flagged ones grey, valid ones coloured by speed."""
    thin = wind.isel(z=slice(every // 2, None, every), y=slice(every // 2, None, every))
    y, z = (np.broadcast_to(thin[f"{a}_vector"], thin["v"].shape).ravel() for a in "yz")
    v, w, flag = (thin[name].values.ravel() for name in ("v", "w", "flag"))
    known = np.isfinite(v) & np.isfinite(w)
    style = {"angles": "xy", "scale_units": "xy", "scale": 1 / ARROW, "width": 0.0022}
    bad, good = known & (flag != 0), known & (flag == 0)
    if bad.any():
        axes.quiver(y[bad], z[bad], v[bad], w[bad], color="0.75", **style)
    arrows = axes.quiver(
        y[good], z[good], v[good], w[good], np.hypot(v, w)[good],
        cmap="viridis", norm=Normalize(0, SPEED_LIMIT), **style,
    )  # fmt: skip
    for core in cores:
        axes.plot(core.y, core.z, "+", color="crimson", ms=9)
    _frame(axes, wind["y"], wind["z"], title)
    axes.figure.colorbar(arrows, ax=axes, label="speed / m s$^{-1}$", pad=0.02)


def _truth_vectors(wind: xr.Dataset) -> xr.Dataset:
    """True wind at the places of a retrieval's vectors, as a retrieval without flags."""
    true = wind[["v_true", "w_true", "y_vector", "z_vector"]].rename(v_true="v", w_true="w")
    return true.assign(flag=xr.zeros_like(wind["flag"]))


def _step(wind: xr.Dataset) -> int:
    """Thinning that leaves about 45 arrows across."""
    return max(1, round(wind.sizes["y"] / 45))


def _extinction(truth):
    figure, axes = _sheet(1, 2)
    fields = [truth.image(k) * 1e3 for k in (0, 1)]
    norm = Normalize(0, max(float(f.max()) for f in fields))
    for k, field in enumerate(fields):
        _image(axes[0, k], field, f"$t_{k + 1}$", "extinction / km$^{-1}$", norm=norm, cmap="cividis")
    return figure, (
        "Extinction coefficient of the slab at t1 and t2, averaged over the gate's depth. "
        "The difference in dt is hardly visible; the retrieval finds it."
    )


def _wind_and_truth(truth, found, cores):
    figure, axes = _sheet(2, 2)
    first = found.sel(source="extinction").isel(algorithm=0)
    _arrows(axes[0, 0], _truth_vectors(first), cores, "true wind", _step(first))
    speed = np.hypot(truth.wind["v"], truth.wind["w"])
    _image(axes[0, 1], speed, "speed of the true wind", "m s$^{-1}$",
           norm=Normalize(0, SPEED_LIMIT), cmap="viridis")  # fmt: skip
    _retrieved_into(axes[1], found, "extinction", cores)
    return figure, (
        "Above: the true cross-flow wind and its speed. Below: winds retrieved from the "
        "extinction pair. Grey vectors are flagged; red crosses mark the true cores."
    )


def _retrieved_into(axes, found, source, cores):
    for axis, method in zip(axes, ("cc", "ws")):
        if method not in found["algorithm"]:
            axis.set_axis_off()
            continue
        wind = found.sel(source=source, algorithm=method)
        _arrows(axis, wind, cores, f"{METHOD_NAMES[method]}, {source}", _step(wind))


def _retrieved(found, source, cores):
    figure, axes = _sheet(1, 2)
    _retrieved_into(axes[0], found, source, cores)
    return figure, (
        f"Winds retrieved from the {source} pair, unfiltered: grey vectors are flagged, red "
        "crosses mark the true cores."
    )


def _deviation_maps(found, source, reference):
    methods = [str(m) for m in found["algorithm"].values]
    figure, axes = _sheet(len(methods), 2)
    for row, method in zip(axes, methods):
        wind = found.sel(source=source, algorithm=method)
        other = (
            _truth_vectors(wind) if reference is None
            else found.sel(source=reference, algorithm=method)
        )  # fmt: skip
        error = deviations(wind, other)
        _image(row[0], error["speed"], f"{METHOD_NAMES[method]}: speed", "m s$^{-1}$",
               norm=TwoSlopeNorm(0, -5, 5), cmap="RdBu_r")  # fmt: skip
        _image(row[1], error["direction"], f"{METHOD_NAMES[method]}: direction", "rad",
               norm=TwoSlopeNorm(0, -np.pi, np.pi), cmap="twilight_shifted")  # fmt: skip
    against = "the true wind" if reference is None else f"winds from {reference}"
    return figure, (
        f"Deviations of winds from {source} against {against}: speed (left) and direction "
        "(right). All vectors with a displacement, flagged or not; colours saturate at 5 m/s."
    )


def _backscatter(scans):
    figure, axes = _sheet(1, 2)
    norm = Normalize(0, max(float(s["Y"].max()) for s in scans) * 1e6)
    for k, scan in enumerate(scans):
        _image(axes[0, k], scan["Y"] * 1e6, f"$t_{k + 1}$",
               "apparent backscatter / 10$^{-6}$ m$^{-1}$ sr$^{-1}$", norm=norm, cmap="cividis")  # fmt: skip
    return figure, (
        "Rendered backscatter, normalised for range, gate length and the environment's "
        "transmittance."
    )


def _detected(scans, found, cores):
    figure, axes = _sheet(1, 2)
    _image(axes[0, 0], scans[0]["Y_noisy"] * 1e6, "$t_1$ with the detector's noise",
           "apparent backscatter / 10$^{-6}$ m$^{-1}$ sr$^{-1}$", cmap="cividis")  # fmt: skip
    wind = found.sel(source="backscatter_noisy").isel(algorithm=0)
    name = METHOD_NAMES[str(wind["algorithm"].values)]
    _arrows(axes[0, 1], wind, cores, f"{name}, with noise", _step(wind))
    return figure, (
        "The backscatter picture with photon, sky, dark and speckle noise of one pulse a beam, and "
        "the wind found in two of them."
    )


def _product(scan, name, label, caption):
    """What a scan tells of its first gate, and how well it knows it."""
    figure, axes = _sheet(1, 2)
    first = scan.isel(gate=0)
    _image(axes[0, 0], first[name], "$t_1$", label, norm=_span(first[name]), cmap="cividis")
    stderr = first[f"{name}_stderr"]
    bound = scan.attrs[f"{name}_stderr_is_bound"]
    kind = "upper bound of the standard error" if bound else "standard error"
    _image(axes[0, 1], stderr, kind, label, norm=_span(stderr), cmap="cividis")
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
        _image(axes[0, k], difference, f"$t_{k + 1}$", "difference of relative values",
               norm=TwoSlopeNorm(0, -limit, limit), cmap="RdBu_r")  # fmt: skip
    return figure, (
        "Backscatter over its mean minus extinction over its mean: the beam's width rounds off "
        "sharp structure, Monte Carlo noise adds grain."
    )


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
        xlabel="sub-grid texture, rms / %", ylabel="rms error / m s$^{-1}$", yscale="log",
        title="cross-correlation from extinction, all vectors",
    )  # fmt: skip
    for source, marker in (("extinction", "o"), ("backscatter", "s"),
                           ("extinction_without_texture", "^")):  # fmt: skip
        for method in found["algorithm"].values:
            wind = found.sel(source=source, algorithm=method)
            groups = error_by_texture(wind, _truth_vectors(wind))
            right.plot(
                groups["texture"], groups["rmse"], marker=marker, ms=5,
                ls="-" if method == "cc" else ":",
                label=f"{method} from {source.replace('_', ' ')}",
            )  # fmt: skip
    right.set(
        xlabel="local texture: weakest rms slope in a window, relative, per pixel",
        ylabel="rms error of v and w / m s$^{-1}$", xscale="log", yscale="log",
        title="all vectors, in groups by their local texture",
    )  # fmt: skip
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3, which="both")
    return figure, (
        "Winds can only be as good as the structure that moves with them. Left: the extinction "
        "pair with more and less sub-grid texture. Right: this run's vectors, grouped by what "
        "their windows have to hold on to. A smooth image cannot tell (aperture problem)."
    )
