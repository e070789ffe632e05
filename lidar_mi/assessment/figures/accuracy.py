"""Figures of the errors of winds: against the Cramer-Rao bound, and by the air's structure."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import by_factors, one_to_one
from lidar_mi.assessment.labels import METHOD_NAMES, SOURCE_NAMES
from lidar_mi.assessment.metrics.errors import error_by_quality
from lidar_mi.assessment.metrics.names import RENDERED, Source
from lidar_mi.retrieval.method_names import ImageMethod


def truth_vectors(wind: xr.Dataset) -> xr.Dataset:
    """True wind at the positions of a retrieval's vectors, as a retrieval without flags."""
    true = wind[["v_true", "w_true", "y_vector", "z_vector"]].rename(v_true="v", w_true="w")
    return true.assign(flag=xr.zeros_like(wind["flag"]))


def error_and_bound(winds: xr.Dataset) -> tuple[Figure, str] | None:
    """Rms errors in groups of vectors by Cramer-Rao bound; None without noise."""
    curves: dict[str, list[tuple[str, list[float], list[float]]]] = {"v": [], "w": []}
    for name, drawn in curves.items():
        for source in (s for s in winds["source"].values if s in RENDERED):
            for method in winds["algorithm"].values:
                wind = winds.sel(source=source, algorithm=method)
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
                drawn.append((label, least, rms))
    nonempty = {name: drawn for name, drawn in curves.items() if drawn}
    if not nonempty:
        return None
    figure = Figure(figsize=(6.5 * len(nonempty), 6.2), layout="constrained")
    for axes, (name, drawn) in zip(
        figure.subplots(1, len(nonempty), squeeze=False)[0], nonempty.items(), strict=True
    ):
        for label, least, rms in drawn:
            axes.plot(least, rms, "o-", ms=4, label=label)
        axes.set_title(f"valid vectors, {name}")
        one_to_one(axes, "bound", logarithmic=True)
        axes.set(
            xlabel=f"Cramer-Rao bound of {name} / m s$^{{-1}}$",
            ylabel=f"rms error of {name} / m s$^{{-1}}$",
        )
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8
    )
    return figure, (
        "Errors of valid vectors, in groups by the Cramer-Rao bound of any unbiased method that "
        "uses a single template. Below the line: methods that use more than a template. Far above "
        "it on the left: errors that are not from noise, for example of flow that a window or a "
        "smooth field does not resolve."
    )


def error_by_texture(winds: xr.Dataset, sweep: xr.Dataset) -> tuple[Figure, str]:
    """Errors by sub-grid texture, and of this run's vectors by the isotropy of their windows."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, marker in (("v", "o"), ("w", "s")):
        # air without any structure gives no displacement, hence no error
        left.plot(100 * sweep["texture"], sweep[f"rmse_{name}"], marker=marker, label=name)
    left.set(
        xlabel="sub-grid texture, rms / %",
        ylabel="rms error / m s$^{-1}$",
        title="cross-correlation from extinction, all vectors",
    )
    several = winds.sizes["source"] > 1
    for source, marker in (
        (Source.EXTINCTION, "o"),
        (Source.BACKSCATTER, "s"),
        (Source.WITHOUT_TEXTURE, "^"),
        (Source.NOISY, "d"),
    ):
        # noisy images are shown where there are no others
        if source not in winds["source"].values or (source == Source.NOISY and several):
            continue
        for method in winds["algorithm"].values:
            wind = winds.sel(source=source, algorithm=method)
            groups = error_by_quality(wind, truth_vectors(wind), "isotropy")
            if not np.isfinite(groups["rmse"]).any():
                continue
            right.plot(
                groups["isotropy"],
                groups["rmse"],
                marker=marker,
                ms=5,
                ls="-" if method == ImageMethod.CC else ":",
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
    # with many lines there is only space below
    right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return figure, (
        "The accuracy of winds is limited by the structure that moves with them. Left: the "
        "extinction pair with more and less sub-grid texture. Right: this run's vectors, grouped "
        "by whether their windows have structure in both directions; along an edge the "
        "displacement is undetermined (aperture problem)."
    )
