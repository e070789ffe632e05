"""Winds from the same light on fewer, larger pixels: does a lower resolution degrade them?"""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.retrieval.rings import peaks
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.likelihood_fit import fit_rings
from lidar_mi.retrieval.rings.model import PixelNoise

from . import figures
from .fringe_reference import Defects, Instrument, air_frame, laser_frame
from .instrument import INSTRUMENT, PHOTONS, nominal
from .report import Check, Row

TITLE = "Resolution of the ring images"
INTRODUCTION = (
    "The same photons in the same field of view, on pixels that are 1 to 30 times as wide. Frames "
    "and bound are from quadrature of Airy's formula; the bound has speed, centre, level, "
    "background, temperature and fall-off of the light unknown."
)

SPEED = 20.0
FREE = ("v_los", "x", "y", "level", "background", "temperature", "falloff")
FACTORS = (1, 2, 4, 6, 10, 15, 20, 30)
RESOLVED = 10
"""Pixels of at most a third of the distance of the outermost rings (34 pixels of the fine camera).

The retrieval's model averages over a pixel to second order in its width."""
FRAMES, PAPER_FRAMES = 200, 10
FINE_FRAMES = 40  # of the two largest images
_LARGE = {"full_well": 1e9, "bits": None, "dark_current": 0.0}
CAMERAS = {
    "CCD, 5 electrons": CCD(read_noise=5.0, **_LARGE),
    "EMCCD, gain 300": CCD(
        read_noise=50.0, multiplication="emccd", multiplication_gain=300.0, **_LARGE
    ),
}
METHODS = {"ca_r2": ("ca", "r2"), "ml": ("ml", "r"), "sg": ("sg", "r")}
"""The paper's methods."""


@dataclass(frozen=True)
class Errors:
    """Bias, standard deviation (m/s) of so many valid speeds, and mean of the standard error."""

    bias: float
    std: float
    number: int
    stated: float = math.nan

    @classmethod
    def of(cls, v, stated=np.nan) -> "Errors":
        valid = np.asarray(v)[np.isfinite(v)] - SPEED
        if len(valid) < 2:
            return cls(math.nan, math.nan, len(valid))
        std = float(np.mean(stated))
        return cls(float(valid.mean()), float(valid.std(ddof=1)), len(valid), std)


def points(factor: int) -> int:
    """Of the quadrature over a pixel, each way: one for two pixels of the fine camera."""
    return max(2, factor // 2)


@cache
def mean_frame(factor: int) -> np.ndarray:
    """The echo's mean electrons."""
    return air_frame(
        INSTRUMENT.binned(factor), Defects(), SPEED, PHOTONS, points=points(factor)
    ).mean


@cache
def jacobian(factor: int) -> np.ndarray:
    """Derivatives of the mean by speed, centre, temperature, level, background and fall-off.

    By differences of frames made without the program, (pixels, 7).
    """
    instrument = INSTRUMENT.binned(factor)
    height, width = instrument.shape
    middle = (width - 1) / 2, (height - 1) / 2

    def frame(v=SPEED, dx=0.0, dy=0.0, kelvin=0.0):
        moved = replace(
            instrument,
            centre=(middle[0] + dx, middle[1] + dy),
            temperature=instrument.temperature + kelvin,
        )
        return air_frame(moved, Defects(), v, PHOTONS, points=points(factor)).signal

    mean = mean_frame(factor)
    y, x = np.indices(instrument.shape)
    step = 0.5 / factor
    columns = [
        (frame(v=SPEED + 2) - frame(v=SPEED - 2)) / 4,
        frame(dx=step) - frame(dx=-step),
        frame(dy=step) - frame(dy=-step),
        frame(kelvin=2) - frame(kelvin=-2),
        mean,
        np.ones_like(mean),
        mean * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2),
    ]
    return np.stack([one.ravel() for one in columns], 1)


def bound(factor: int, noise: PixelNoise) -> float:
    """Cramer-Rao bound of the speed, m/s."""
    mean = torch.from_numpy(mean_frame(factor).ravel())
    columns = jacobian(factor) / noise.variance(mean, mean).sqrt().numpy()[:, None]
    # the part of the first column that the others do not explain
    rest = columns[:, 1:] / np.linalg.norm(columns[:, 1:], axis=0)
    explained = rest @ np.linalg.lstsq(rest, columns[:, 0])[0]
    return float(1 / np.linalg.norm(columns[:, 0] - explained))


def fitted(factor: int, ccd: CCD, frames: int, seed: int) -> Errors:
    """Errors of the ring fit over noisy frames."""
    model, noise = nominal(INSTRUMENT.binned(factor))[0], pixel_noise(ccd)
    drawn = expose(torch.from_numpy(mean_frame(factor)), ccd, seed, frames)
    try:
        fit = fit_rings(drawn, model, noise, free=FREE, max_chi_square=math.inf)
    except InputError:
        return Errors.of([])
    return Errors.of(fit.v_los.numpy(), fit.v_los_std.numpy())


def of_the_paper(factor: int, ccd: CCD, frames: int, seed: int) -> dict[str, Errors]:
    """Errors of the innermost ring's radius, against that of a laser frame without noise."""
    instrument = INSTRUMENT.binned(factor)
    laser = laser_frame(instrument, Defects(), PHOTONS, points=points(factor)).mean
    drawn = expose(torch.from_numpy(mean_frame(factor)), ccd, seed, frames).numpy()
    return {
        name: Errors.of([_speed(image, laser, instrument, *METHODS[name]) for image in drawn])
        for name in METHODS
    }


def _speed(air, laser, instrument: Instrument, method: str, coordinate: str) -> float:
    try:
        radii = []
        for image in (air, laser):
            centre = peaks.find_centre(image, "ml" if method == "ml" else "ca")
            near = peaks.ring_radius(image, centre, "ca", "r2")
            radii.append(peaks.ring_radius(image, centre, method, coordinate, near))
    except InputError:
        return math.nan
    return float(peaks.velocity_from_radii(*radii, instrument.focal_length, instrument.pixel))


def resolution(effort) -> Check:
    """Fit, bound and the paper's methods over the size of the pixels."""
    bounds, fits, paper, rows = {}, {}, {}, []
    for number, (camera, ccd) in enumerate(CAMERAS.items()):
        noise = pixel_noise(ccd)
        for factor in FACTORS:
            key = camera, factor
            bounds[key] = bound(factor, noise)
            frames = effort.scale * (FRAMES if factor > 2 else FINE_FRAMES)
            fits[key] = fitted(factor, ccd, frames, 600 + number)
        rows += _rows(camera, bounds, fits, noise)
    first = next(iter(CAMERAS))
    for factor in FACTORS:
        paper[factor] = of_the_paper(factor, CAMERAS[first], PAPER_FRAMES * effort.scale, 610)
    place = effort.folder.parent / "pictures" / "resolution.png"
    draw(place, bounds, fits, paper)
    return Check(
        "Fewer, larger pixels",
        "\n".join(
            [
                f"{PHOTONS:.1e} photons at {SPEED:g} m/s; {FRAMES * effort.scale} frames a row, "
                f"{FINE_FRAMES * effort.scale} of the two largest sizes, "
                f"{PAPER_FRAMES * effort.scale} for the paper's methods, whose reference is a "
                "laser frame without noise. Wells and digitisers are taken as large enough.",
                "",
                *table(bounds, fits, paper),
            ]
        ),
        tuple(rows),
    )


def _rows(camera, bounds, fits, noise) -> list[Row]:
    rows = []
    for factor in (f for f in FACTORS if f <= RESOLVED):
        one, least = fits[camera, factor], bounds[camera, factor]
        name = f"{camera}, {_size(factor)} px"
        sigma = least / math.sqrt(one.number)
        model = nominal(INSTRUMENT.binned(factor))[0]
        own = cramer_rao(model, PHOTONS, noise, v_los=SPEED, free=FREE)
        rows += [
            Row(
                f"{name}: bound", "without the program", least, own["v_los"], 0, 0.02 * least, "m/s"
            ),
            Row(f"{name}: std of the fit", "bound", least, one.std, sigma / 2**0.5, 0, "m/s"),
            Row(f"{name}: bias of the fit", "true speed", 0, one.bias, sigma, 0.03, "m/s"),
        ]
    return rows


def _size(factor: int) -> str:
    height, width = INSTRUMENT.binned(factor).shape
    return f"{width} x {height}"


def table(bounds, fits, paper) -> list[str]:
    """Markdown: one line a size."""
    heads = [f"{camera}: bound | fit: std, bias" for camera in CAMERAS]
    heads += [f"{name}: std, bias" for name in METHODS]
    lines = [
        f"| pixels | {' | '.join(heads)} |",
        "| ---: |" + " ---: |" * (2 * len(CAMERAS) + len(METHODS)),
    ]
    for factor in FACTORS:
        cells = [_size(factor)]
        for camera in CAMERAS:
            cells += [f"{bounds[camera, factor]:.3f}", _cell(fits[camera, factor], 3)]
        cells += [_cell(one, 1) for one in paper[factor].values()]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _cell(one: Errors, digits: int) -> str:
    return f"{one.std:.{digits}f}, {one.bias:+.{digits}f}" if one.number > 1 else "-"


def draw(place, bounds, fits, paper) -> None:
    """Bound, fit and the paper's methods over the width of the image in pixels."""
    widths = [INSTRUMENT.binned(factor).shape[1] for factor in FACTORS]
    with figures.figure(place, (7.0, 3.6), columns=2, sharex=True) as (left, right):
        for camera, colour in zip(CAMERAS, (figures.OURS, figures.OTHER), strict=True):
            least = [bounds[camera, factor] for factor in FACTORS]
            some = [fits[camera, factor] for factor in FACTORS]
            left.plot(widths, least, color=colour, label=f"{camera}: bound")
            error = [one.std / math.sqrt(2 * max(one.number, 1)) for one in some]
            std = [one.std for one in some]
            left.errorbar(widths, std, error, fmt="o", ms=3, color=colour, label=f"{camera}: fit")
            right.plot(
                widths,
                [rms(one) for one in some],
                "o-",
                ms=4,
                color=colour,
                label=f"fit, {camera.split(',')[0]}",
            )
        for number, name in enumerate(METHODS):
            values = [rms(paper[factor][name]) for factor in FACTORS]
            right.plot(widths, values, ".--", color=f"C{number + 2}", label=f"{name}, CCD")
        left.set(xscale="log", ylim=(0, None), xlabel="pixels of a row", ylabel="std of v_LOS, m/s")
        right.set(yscale="log", xlabel="pixels of a row", ylabel="rms error of v_LOS, m/s")
        ticks = [30, 60, 120, 240, 480, 960]
        left.set_xticks(ticks, [str(n) for n in ticks])
        left.minorticks_off()
        for axis in (left, right):
            axis.legend(frameon=False, fontsize=7)


def rms(one: Errors) -> float:
    """Rms error, m/s."""
    return math.hypot(one.bias, one.std)


CHECKS = (resolution,)
