"""The figures of a Doppler run: the paper's figures 3 and 4, errors by images averaged, bias."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import Captioned, Drawn, Progress, one_to_one, save_all
from lidar_mi.assessment.metrics.names import bound_key, ring_key
from lidar_mi.assessment.metrics.velocities import CENTRES, PEAK_READERS, READERS
from lidar_mi.instrument.fringe_camera import ring_radii
from lidar_mi.retrieval.rings.centre import circular_average
from lidar_mi.retrieval.rings.peak_fit import peak
from lidar_mi.retrieval.rings.peaks import PIECE, radial_cuts, savitzky_golay
from lidar_mi.schema.doppler import Doppler


class RingImages(Protocol):
    """Images (height, width) of rings, photoelectrons per pixel of one pulse."""

    @property
    def emitted(self) -> np.ndarray:
        """Of the laser."""

    @property
    def received(self) -> np.ndarray:
        """Of air at the first speed, without noise."""

    @property
    def noisy(self) -> np.ndarray:
        """The same by the CCD."""


PUBLISHED = {
    "free": {"averaged": 20, "std": 2.5, "bias": 7.0},
    "known": {"averaged": 20, "std": 2.0, "bias": 2.0},
}
"""The paper's values, m/s: with the centre fitted, and upper limits with the centre known."""

REQUIRED = 0.5
"""Largest standard deviation of v_LOS allowed by the paper's table 1, m/s."""

_COLOURS = dict(zip(READERS, ("C0", "C9", "C3", "C2", "C1", "C4"), strict=True))
_BY_COORDINATE = {"r": _COLOURS["ca"], "r2": _COLOURS["ca_r2"]}
_MARKERS = dict(zip(READERS, "oXs^Dv", strict=True))


def draw_all(
    folder: Path,
    doppler: Doppler,
    exposure: RingImages,
    samples: xr.Dataset | None,
    velocities: xr.Dataset,
    metrics: dict[str, float],
    log: Progress,
) -> list[Drawn]:
    """Draw every figure of a Doppler run as PNG into ``folder``.

    exposure: images of the laser and of the air at the first speed, without and with noise.
    samples: image of the laser's light, traced path by path.
    velocities, metrics: from `lidar_mi.experiment.stages.ring_velocities.velocities`,
        `lidar_mi.assessment.metrics.velocities`.
    """
    figures = [
        ("fig03_fringes", "Rings on the CCD", _rings(doppler, exposure, samples)),
        (
            "fig04_ring_cuts",
            "Noise in a cut through the rings, and without it",
            _cuts(doppler, exposure),
        ),
        (
            "fig16_doppler_errors",
            "Spread and bias of the line-of-sight wind",
            _errors(doppler, metrics),
        ),
        ("fig18_doppler_speeds", "Line-of-sight wind against the truth", _speeds(velocities)),
    ]
    if set(doppler.retrieval.methods) & set(PEAK_READERS):
        bias = _bias(doppler, exposure, velocities)
        figures.insert(-1, ("fig17_doppler_bias", "Bias of the peaks of rings", bias))
    return save_all(folder, figures, log)


def _rings(doppler: Doppler, exposure: RingImages, samples: xr.Dataset | None) -> Captioned:
    """The paper's figure 3, and the profiles of both."""
    panels = 3 if samples is not None else 2
    figure = Figure(figsize=(5.6 * panels, 4.6), layout="constrained")
    axes = figure.subplots(1, panels)
    images = [(exposure.noisy, f"one pulse, air at {doppler.v_los[0]:g} m/s", "photoelectrons")]
    if samples is not None:
        # every path has the same energy
        counts = samples["S0"].values * samples["S0"].size * samples.attrs["samples_per_pixel"]
        images.append((counts, "the laser's light, traced path by path through a lens", "samples"))
    # the last panel holds profiles
    for axis, (image, title, label) in zip(axes, images, strict=False):
        # single noisy pixels must not determine the scale
        mesh = axis.imshow(image, cmap="inferno", vmin=0, vmax=np.quantile(image, 0.998))
        axis.set(title=title, xlabel="x / px", ylabel="y / px")
        figure.colorbar(mesh, ax=axis, label=label, extend="max", shrink=0.85)
    centre = doppler.camera.centre_pixel
    for image, label, style in (
        (exposure.emitted, "emitted", {"color": "C0"}),
        (exposure.received, f"received, {doppler.v_los[0]:g} m/s", {"color": "C3"}),
    ):
        radius, mean, weight = circular_average(image, centre)
        near = weight > 30  # beyond, circles have only a few pixels in the corners
        axes[-1].plot(radius[near], mean[near], label=label, **style)
    axes[-1].set(
        title="means over circles, without noise", xlabel="radius / px", ylabel="photons per pixel"
    )
    axes[-1].set_ylim(0, 1.25 * exposure.emitted.max())
    axes[-1].legend(loc="upper right")
    axes[-1].grid(alpha=0.3)
    right = (
        ""
        if samples is None
        else (
            " Middle: the laser's own light, plane waves of random direction, frequency and place, "
            "traced path by path through etalon and a real lens."
        )
    )
    return figure, (
        "As the paper's figure 3. Left: the CCD's image of one pulse, broadened by the air's "
        f"molecules.{right} Right: profiles; emitted and received light have equally many photons."
    )


def _cuts(doppler: Doppler, exposure: RingImages) -> Captioned:
    """The paper's figure 4."""
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    centre = doppler.camera.centre_pixel
    cuts = radial_cuts(exposure.noisy, centre)
    single = cuts[0]
    reached = np.isfinite(cuts).all(0)
    smooth = np.nanmean(savitzky_golay(cuts[:, reached]), 0)
    radius, mean, weight = circular_average(exposure.noisy, centre)
    for axis, (x, y), title in (
        (left, (np.flatnonzero(reached), smooth), "360 cuts, Savitzky-Golay filter, mean"),
        (right, (radius[weight > 30], mean[weight > 30]), "circular averaging (CA)"),
    ):
        axis.plot(
            np.flatnonzero(np.isfinite(single)),
            single[np.isfinite(single)],
            "C3",
            lw=0.7,
            label="one cut",
        )
        axis.plot(x, y, "C0", lw=1.8, label=title)
        axis.set(xlabel="radius / px", title=title)
        axis.legend(loc="upper right")
        axis.grid(alpha=0.3)
    left.set_ylabel("photoelectrons per pixel")
    # space above the cut for the legend
    left.set_ylim(top=1.3 * np.nanmax(single))
    return figure, (
        "As the paper's figure 4: a cut through the image of one pulse from the centre to the "
        "rim (red), and the same ring profile with less noise (blue). Left: 360 such cuts after a "
        "Savitzky-Golay filter of 31 pixels, which flattens rings that are not wider. Right: mean "
        "over circles."
    )


def _errors(doppler: Doppler, metrics: Mapping[str, float]) -> Captioned:
    settings = doppler.retrieval
    figure = Figure(figsize=(6.2 * len(settings.centre), 8.2), layout="constrained")
    axes = figure.subplots(2, len(settings.centre), sharex=True, sharey="row", squeeze=False)
    for column, centre in zip(axes.T, settings.centre, strict=True):
        for name in settings.methods:
            for axis, quantity in zip(column, ("std", "bias"), strict=True):
                keys = [ring_key(name, centre, n, quantity) for n in settings.averaged]
                values, bars = (
                    np.array([metrics.get(key + end, np.nan) for key in keys])
                    for end in ("", "_stderr")
                )
                axis.errorbar(
                    settings.averaged,
                    abs(values),
                    bars,
                    color=_COLOURS[name],
                    marker=_MARKERS[name],
                    ms=5,
                    capsize=3,
                    lw=1.2,
                    label=READERS[name],
                )
        bound = [metrics[bound_key(centre, n)] for n in settings.averaged]
        column[0].plot(settings.averaged, bound, "k--", label="Cramer-Rao bound")
        column[0].axhline(REQUIRED, color="0.5", ls=":", label="required (table 1)")
        for axis, quantity in zip(column, ("std", "bias"), strict=True):
            published = PUBLISHED[centre]
            axis.plot(
                published["averaged"],
                published[quantity],
                "*",
                color="k",
                ms=13,
                zorder=5,
                label=f"paper: {'below ' * (centre == 'known')}{published[quantity]:g} m/s",
            )
            axis.set(xscale="log", yscale="log")
            axis.set_xticks(settings.averaged, [str(n) for n in settings.averaged])
            axis.minorticks_off()
            axis.grid(alpha=0.3, which="both")
        column[0].set_title(CENTRES[centre])
        column[1].set_xlabel("images averaged")
        for axis in column:
            axis.legend(fontsize=8)
    axes[0, 0].set_ylabel("standard deviation / m s$^{-1}$")
    axes[1, 0].set_ylabel("size of the bias / m s$^{-1}$")
    return figure, (
        "Standard deviation (above) and bias (below) of the line-of-sight wind against the number "
        "of images that are averaged, over all speeds, with standard errors; stars: values "
        "of the paper. Peaks are those of the innermost ring, the bound is that at the first speed."
    )


def _bias(doppler: Doppler, exposure: RingImages, velocities: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(16, 4.8), layout="constrained")
    *rings, last = figure.subplots(1, 3)
    camera = doppler.camera
    radius, mean, _ = circular_average(exposure.received, camera.centre_pixel)
    true = ring_radii(camera, doppler.etalon, doppler.lidar.wavelength, doppler.v_los[0])[0]
    names = {"r": ("r", "px"), "r2": ("r$^2$", "px$^2$")}
    for axis, power, (coordinate, (name, unit)) in zip(rings, (1, 2), names.items(), strict=True):
        x, crest = radius**power, true**power
        near = np.abs(x - crest) < 0.6 * power * crest
        axis.plot(x[near], mean[near], "k", label="innermost ring, no noise")
        axis.plot(2 * crest - x[near], mean[near], color="0.6", ls="--", label="the same, mirrored")
        fitted = peak(x, mean, crest, PIECE * power * crest)
        axis.axvline(crest, color="k", lw=0.8, label="true crest")
        axis.axvline(fitted, color=_BY_COORDINATE[coordinate], ls=":", label="Gaussian's crest")
        axis.set(xlabel=f"{name} / {unit}", ylabel="photons per pixel", title=f"fit in {name}")
        last.plot(
            velocities["piece"],
            velocities["peak_bias"].sel(coordinate=coordinate),
            "o-",
            color=_BY_COORDINATE[coordinate],
            label=f"fit in {name}",
        )
    last.axvline(PIECE, color="0.5", ls=":", label="used here")
    last.axhline(0, color="k", lw=0.8)
    last.set(
        xlabel="half width of the fitted piece / radius of the ring",
        ylabel="error of the wind / m s$^{-1}$",
        title="peak of the innermost ring, no noise",
    )
    for axis in (*rings, last):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure, (
        "A line that is broadened symmetrically in frequency gives a ring that is symmetric in r² "
        "(middle), not in r (left): a Gaussian fitted in r has a bias by the skewness. Right: the "
        "error of the wind by the piece of the profile that is fitted. The laser's own ring is "
        "narrow, with little skewness: the difference of both does not cancel the error."
    )


def _speeds(velocities: xr.Dataset) -> Captioned:
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    case = velocities.isel(averaged=0, centre=0)
    true = case["v_los"].values
    order = np.argsort(true)
    for name in velocities["algorithm"].values:
        v = case["v"].sel(algorithm=name).transpose("v_los", "image").values[order]
        count = np.isfinite(v).sum(1)
        mean = np.where(count > 0, np.nansum(v, 1) / np.maximum(count, 1), np.nan)
        spread = np.full(len(mean), np.nan)
        spread[count > 1] = np.nanstd(v[count > 1], 1, ddof=1)
        style = {
            "color": _COLOURS[str(name)],
            "marker": _MARKERS[str(name)],
            "ms": 5,
            "capsize": 3,
            "lw": 1.0,
            "label": READERS[str(name)],
        }
        left.errorbar(true[order], mean, spread, **style)
        right.errorbar(true[order], mean - true[order], spread, **style)
    one_to_one(left, "the true wind")
    right.axhline(0, color="k", lw=0.8)
    left.set(xlabel="true wind / m s$^{-1}$", ylabel="retrieved wind / m s$^{-1}$")
    right.set(xlabel="true wind / m s$^{-1}$", ylabel="retrieved less true wind / m s$^{-1}$")
    right.set_yscale("symlog", linthresh=1.0)
    ticks = [sign * value for sign in (-1, 1) for value in (0.5, 1, 10, 100)]
    low, high = right.get_ylim()
    right.set_yticks(
        *zip(*((t, f"{t:g}") for t in sorted([0, *ticks]) if low <= t <= high), strict=True)
    )
    n, centre = int(case["averaged"]), CENTRES[str(case["centre"].values)]
    for axis in (left, right):
        axis.set_title(f"{'single images' if n == 1 else f'averages of {n} images'}, {centre}")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure, (
        "Left: wind retrieved from the rings against the true one, mean and standard deviation of "
        "a single retrieval. Right: the difference, on a scale that is logarithmic beyond 1 m/s."
    )
