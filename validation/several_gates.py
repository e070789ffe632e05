"""Gates before and behind the imaged one: how far they explain motion through the image plane."""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter, map_coordinates

import lidar_mi as lm
from lidar_mi.experiment.truth.flows import flows_of, mean_flow

from .report import Check, Comparison
from .scenes import Effort

TITLE = "Several gates"
INTRODUCTION = (
    "The wake of `wake_changing`, advected by u, v and w for 0.1 s, in five gates of 2.5 m. The "
    "wind is retrieved in the middle one by `variational`, from images without blur and with white "
    "noise."
)
GATE, GATES, NEAR = 2.5, 5, 494.0
DT = 0.1
NOISES = (0.002, 0.01, 0.03)
"""Over the mean signal."""
WIDTH = 5.0
"""Of the Gaussian windows in which u is estimated, px."""
SPEED = 0.2
"""Expected rms of u, m/s."""
CORRELATED = 4
"""Pixels of one independent difference, about: residuals are smooth over the texture's grain."""


def derivative(gates: np.ndarray, number: int) -> np.ndarray:
    """Along x (1/m of the signal) in the middle of five gates (5, z, y), from 3 or 5 of them.

    Central differences of second and fourth order.
    """
    near = gates[3] - gates[1]
    if number == 3:
        return near / (2 * GATE)
    return (8 * near - (gates[4] - gates[0])) / (12 * GATE)


def corrected(
    first: np.ndarray, second: np.ndarray, u: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Images of the middle gate (z, y) as if u were 0, to first order in u dt."""
    moved = 0.5 * DT * u * 0.5 * (derivative(first, number) + derivative(second, number))
    return first[2] - moved, second[2] + moved


def estimated(
    first: np.ndarray,
    second: np.ndarray,
    wind: xr.Dataset,
    origin: tuple[float, float],
    step: float,
    number: int,
) -> np.ndarray:
    """u (z, y) by regression of what the wind in the plane leaves on the derivative along x."""
    rows, columns = np.indices(first[2].shape)
    z, y = (wind[axis].values for axis in "zy")
    at = np.stack(
        [
            np.clip(start + step * index, axis[0], axis[-1])
            for start, index, axis in zip(origin, (rows, columns), (z, y), strict=True)
        ],
        -1,
    )
    half = [RegularGridInterpolator((z, y), wind[n].values)(at) * DT / 2 / step for n in "wv"]

    def warped(image: np.ndarray, sign: int) -> np.ndarray:
        return map_coordinates(
            image, [rows + sign * half[0], columns + sign * half[1]], order=3, mode="nearest"
        )

    left = warped(second[2], 1) - warped(first[2], -1)
    slope = (
        0.5 * DT * (warped(derivative(first, number), -1) + warped(derivative(second, number), 1))
    )
    in_window = 4 * np.pi * WIDTH**2 / CORRELATED
    noise = gaussian_filter(left**2, 2 * WIDTH) / in_window
    return gaussian_filter(-left * slope, WIDTH) / (
        gaussian_filter(slope**2, WIDTH) + noise / SPEED**2
    )


def air() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Extinction of the gates (5, z, y) at t1 and t2, wind in them, and axes."""
    experiment = lm.load_experiment(
        "wake_changing",
        wake={"depth": "volume"},
        scan={"range": f"{NEAR} m", "thickness": f"{GATE * GATES} m", "gate_count": GATES},
    )
    flow = mean_flow(flows_of(experiment))
    x = flow["x"].values

    def in_gates(field: xr.DataArray) -> np.ndarray:
        values = field.transpose("x", "z", "y").values
        starts = NEAR + GATE * np.arange(GATES)
        return np.stack([values[(x > s) & (x < s + GATE)].mean(0) for s in starts])

    first, second = (in_gates(field) for field in lm.make_truth(experiment).extinction)
    winds = {name: in_gates(flow[name]) for name in "uvw"}
    return first, second, winds, flow["z"].values, flow["y"].values


def cases(
    first: np.ndarray,
    second: np.ndarray,
    u: np.ndarray,
    wind: xr.Dataset,
    origin: tuple[float, float],
    step: float,
) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray]]]:
    """Pairs of images of the middle gate, by what is known of u."""
    for number in (3, 5):
        yield f"{number} gates, u known", corrected(first, second, u, number)
        found = estimated(first, second, wind, origin, step, number)
        yield f"{number} gates, u estimated", corrected(first, second, found, number)


def gates(effort: Effort) -> Check:
    first, second, winds, z, y = air()
    step, origin = float(y[1] - y[0]), (float(z[0]), float(y[0]))
    axes = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    at = {name: RegularGridInterpolator((z, y), winds[name][2]) for name in "vw"}

    def retrieved(pair: tuple[np.ndarray, np.ndarray]) -> xr.Dataset:
        images = (xr.DataArray(image, axes, ("z", "y")) for image in pair)
        return lm.retrieve_wind(
            *images, dt=DT, method="variational", windows=lm.WindowSizes(8, 16, 4)
        )

    def line(noise: float, name: str, wind: xr.Dataset) -> tuple[str, ...]:
        valid = wind["flag"].values == 0
        places = np.stack([wind["z_vector"].values, wind["y_vector"].values], -1)
        off = {n: (wind[n].values - at[n](places))[valid] for n in "vw"}
        normalised = [off[n] / wind[f"{n}_stderr"].values[valid] for n in "vw"]
        return (
            f"{noise:.1%}",
            name,
            *(f"{np.sqrt(np.mean(off[n] ** 2)):.3f}" for n in "vw"),
            f"{np.mean(np.square(normalised)):.2f}",
            f"{valid.mean():.0%}",
        )

    lines = []
    for noise in NOISES:
        random = np.random.default_rng(1)
        noisy = [
            image + noise * first.mean() * random.standard_normal(image.shape)
            for image in (first, second)
        ]
        alone = retrieved((noisy[0][2], noisy[1][2]))
        lines.append(line(noise, "one gate", alone))
        for name, pair in cases(noisy[0], noisy[1], winds["u"][2], alone, origin, step):
            lines.append(line(noise, name, retrieved(pair)))
    heads = (
        "noise",
        "images",
        "rms error of v, m/s",
        "of w, m/s",
        "variance of normalised errors",
        "valid",
    )
    return Check(
        "Motion through the plane, explained by gates beside",
        "Images are corrected by -u dt dI/dx, half of it in each, with dI/dx from the gates before "
        "and behind. u is that of the truth, or is estimated from the same images: a regression of "
        "what the wind in the plane leaves on dI/dx, in windows of 5 px, with an expected rms of "
        "0.2 m/s.",
        (),
        comparison=Comparison(heads, tuple(lines)),
    )


CHECKS = (gates,)
