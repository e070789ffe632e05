"""Gates before and behind the imaged one: how far they explain motion through the image plane."""

from typing import TypeAlias

import numpy as np
import xarray as xr
from scipy.interpolate import RegularGridInterpolator

import lidar_mi as lm
from lidar_mi.atmosphere.advection import advect
from lidar_mi.atmosphere.turbine import isotropic_turbulence
from lidar_mi.experiment.truth.flows import flows_of, mean_flow

from .gates_beside import along_x, retrieve_wind_of_gates
from .report import Check, Comparison
from .scenes import Effort

TITLE = "Several gates"
INTRODUCTION = (
    "Two kinds of air, advected by u, v and w for 0.1 s, in five gates of 2.5 m: the wake of "
    "`wake_changing`, and isotropic turbulence. The wind is retrieved in the middle gate by "
    "`variational`, from images without blur and with white noise."
)
GATE, GATES, NEAR = 2.5, 5, 494.0
DT = 0.1
NOISES = (0.002, 0.01, 0.03)
"""Over the mean signal."""
_MIDDLE = {3: slice(1, 4), 5: slice(0, 5)}
"""So many gates about the middle one."""


Air: TypeAlias = tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], np.ndarray, np.ndarray]
"""Signals of five gates (5, z, y) at t1 and t2, wind in them, axes z and y (m)."""


def corrected(
    first: np.ndarray, second: np.ndarray, u: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Images of the middle gate (z, y) as if u were 0, to first order in u dt."""
    some = _MIDDLE[number]
    moved = 0.5 * DT * u * np.mean([along_x(gates[some], GATE) for gates in (first, second)], 0)
    return first[2] - moved, second[2] + moved


def wake() -> Air:
    """That of `wake_changing`."""
    experiment = lm.load_experiment(
        "wake_changing",
        wake={"depth": "volume"},
        scan={"range": f"{NEAR} m", "thickness": f"{GATE * GATES} m", "gate_count": GATES},
    )
    flow = mean_flow(flows_of(experiment))
    first, second = lm.make_truth(experiment).extinction
    return _in_gates(flow.assign(first=first, second=second))


def turbulence() -> Air:
    """Air of the density k^-11/3 of a passive scalar in isotropic turbulence.

    Outer scales of 10 and 15 m; 0.3 m/s a component, in a box of 20 x 48 x 40 m.
    """
    random, step, shape = np.random.default_rng(2), 0.5, (40, 80, 96)
    k = [np.fft.fftfreq(2 * n, step) for n in shape]
    square = sum(one**2 for one in np.meshgrid(*k, indexing="ij")) + 0.1**2
    white = random.standard_normal([2 * n for n in shape])
    air = np.fft.ifftn(square ** (-11 / 12) * np.fft.fftn(white)).real
    axes = {axis: step * np.arange(n) for axis, n in zip("xzy", shape, strict=True)}
    axes["x"] = axes["x"] + NEAR - 3.75
    air = 5 + (air / air.std())[tuple(slice(n) for n in shape)]
    gusts = 0.3 * isotropic_turbulence(axes["x"], axes["y"], axes["z"], 15.0, 2)
    flow = xr.Dataset(
        {name: (("x", "y", "z"), one) for name, one in zip("uvw", gusts, strict=True)}, axes
    ).transpose("x", "z", "y")
    first = xr.DataArray(air, axes, ("x", "z", "y"))
    second = advect(first, flow["v"], flow["w"], DT, u=flow["u"])
    return _in_gates(flow.assign(first=first, second=second))


def _in_gates(fields: xr.Dataset) -> Air:
    x = fields["x"].values
    starts = NEAR + GATE * np.arange(GATES)

    def means(name: str) -> np.ndarray:
        values = fields[name].transpose("x", "z", "y").values
        return np.stack([values[(x >= s) & (x < s + GATE)].mean(0) for s in starts])

    images = means("first"), means("second")
    winds = {name: means(name) for name in "uvw"}
    return *images, winds, fields["z"].values, fields["y"].values


AIRS = {"wake": wake, "turbulence": turbulence}


def gates(effort: Effort) -> Check:
    heads = (
        "air",
        "noise",
        "images",
        "rms error of v, m/s",
        "of w, m/s",
        "variance of normalised errors",
        "valid",
    )
    lines = [(name, *line) for name, air in AIRS.items() for line in _lines(*air())]
    return Check(
        "Motion through the plane, explained by gates beside",
        "Images are corrected by -u dt dI/dx, half of it in each, with dI/dx from the gates before "
        "and behind. u is that of the truth, or is estimated from the same images. In the wake it "
        "pays at a noise of 1 %, in isotropic turbulence at none.",
        (),
        comparison=Comparison(heads, tuple(lines)),
    )


def _lines(
    first: np.ndarray,
    second: np.ndarray,
    winds: dict[str, np.ndarray],
    z: np.ndarray,
    y: np.ndarray,
) -> list[tuple[str, ...]]:
    """Errors in one air, by noise and gates."""
    axes = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    x = {"x": ("x", NEAR + GATE * (np.arange(GATES) + 0.5), {"units": "m"})}
    at = {name: RegularGridInterpolator((z, y), winds[name][2]) for name in "vw"}
    windows = lm.WindowSizes(8, 16, 4)

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

        def of_pair(one: np.ndarray, other: np.ndarray) -> xr.Dataset:
            images = (xr.DataArray(image, axes, ("z", "y")) for image in (one, other))
            return lm.retrieve_wind(*images, dt=DT, windows=windows)

        lines.append(line(noise, "one gate", of_pair(noisy[0][2], noisy[1][2])))
        for number in _MIDDLE:
            known = corrected(*noisy, winds["u"][2], number)
            lines.append(line(noise, f"{number} gates, u known", of_pair(*known)))
            scans = (
                xr.DataArray(i, x | axes, ("x", "z", "y")).isel(x=_MIDDLE[number]) for i in noisy
            )
            found = retrieve_wind_of_gates(*scans, dt=DT, windows=windows)
            lines.append(line(noise, f"{number} gates, u estimated", found))
    return lines


CHECKS = (gates,)
