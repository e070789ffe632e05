"""Vortices of scans as a CF data set."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.flags import VortexFlag, flag_attributes
from lidar_mi.retrieval.ground_vortices.detection import Detection
from lidar_mi.retrieval.ground_vortices.fit import Fit
from lidar_mi.retrieval.ground_vortices.scan_plane import PlaneScan
from lidar_mi.retrieval.ground_vortices.swirl import OF_VORTEX, circulation_5_15

NUMBERS = ("y", "z", "circulation", "core_radius")
"""Of a vortex, in the order of the covariance."""

_ABOUT = {
    "y": ("m", "horizontal distance of the vortex from the lidar in the plane of the scan"),
    "z": ("m", "height of the vortex above the lidar"),
    "circulation": ("m2 s-1", "circulation, positive from y to z"),
    "core_radius": ("m", "radius of the largest tangential speed"),
}


@dataclass(frozen=True, eq=False)
class ScanVortices:
    """What one scan shows; no fit where there is no wake."""

    scan: PlaneScan
    seen: Detection
    fit: Fit | None
    flag: int
    vortices: int


def ordered(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (vortices, 4), cores in m, the smaller y first, and their covariance.

    That has the fraction of the other profile as its last row and column.
    """
    vortices = fit.state.vortices
    order = np.argsort(vortices[:, 0], kind="stable")
    index = (OF_VORTEX * order[:, None] + np.arange(OF_VORTEX)).ravel()
    values = vortices[order].copy()
    scale = np.ones_like(values)
    values[:, 3] = np.exp(values[:, 3])
    # the fit has the logarithm
    scale[:, 3] = values[:, 3]
    index = np.append(index, vortices.size + fit.state.departures.size)
    size = np.append(scale.ravel(), 1.0)
    return values, fit.covariance[np.ix_(index, index)] * np.outer(size, size)


def _inner(
    values: np.ndarray, covariance: np.ndarray, other: np.ndarray, profile: Model
) -> tuple[np.ndarray, np.ndarray]:
    """Circulation (scans, vortices) from 5 to 15 m of each vortex alone, and its standard error."""
    circulation, core = values[..., 2], values[..., 3]
    mixture, step = np.broadcast_to(other[:, None], core.shape), 1e-4
    part = circulation_5_15(core, mixture, profile)
    by_core = (circulation_5_15(core + step, mixture, profile) - part) / step
    by_other = (circulation_5_15(core, mixture + step, profile) - part) / step
    variance = np.empty(circulation.shape)
    for k in range(values.shape[1]):
        used = [OF_VORTEX * k + 2, OF_VORTEX * k + 3, -1]
        slope = np.stack([by_core[:, k], by_other[:, k]], -1) * circulation[:, k, None]
        by = np.column_stack([part[:, k], slope])
        both = covariance[:, used][:, :, used]
        variance[:, k] = np.einsum("sa,sab,sb->s", by, both, by)
    return circulation * part, np.sqrt(variance)


def vortex_dataset(found: Sequence[ScanVortices], about: Mapping[str, Any]) -> xr.Dataset:
    """All scans in the order of time."""
    found = sorted(found, key=lambda one: one.scan.start)
    count, number = len(found), max(one.vortices for one in found)
    values = np.full((count, number, OF_VORTEX), np.nan)
    covariance = np.full((count, number * OF_VORTEX + 1, number * OF_VORTEX + 1), np.nan)
    other = np.full(count, np.nan)
    wind, wind_stderr = np.full(count, np.nan), np.full(count, np.nan)
    sigma, length, misfit = (np.full(count, np.nan) for _ in range(3))
    time = np.empty(count, "datetime64[ns]")
    for k, one in enumerate(found):
        time[k] = one.scan.at(float(np.mean(one.scan.time)))
        if one.fit is not None:
            values[k], covariance[k] = ordered(one.fit)
            other[k] = one.fit.state.other_profile[0]
            time[k] = one.scan.at(one.fit.time)
            at = len(one.fit.state.vector) - len(one.fit.state.wind)
            wind[k] = one.fit.state.wind[0]
            wind_stderr[k] = np.sqrt(one.fit.covariance[at, at])
            sigma[k], length[k] = one.fit.air.sigma, one.fit.air.length
            misfit[k] = one.fit.misfit / one.fit.dof
    stderr = np.sqrt(np.einsum("saa->sa", covariance))
    other_stderr, stderr = stderr[:, -1], stderr[:, :-1].reshape(values.shape)
    inner, inner_stderr = _inner(values, covariance, other, about["profile"])
    data: dict[str, Any] = {}
    for k, name in enumerate(NUMBERS):
        units, text = _ABOUT[name]
        data[name] = _variable(("scan", "vortex"), values[..., k], units, text)
        data[f"{name}_stderr"] = _variable(
            ("scan", "vortex"), stderr[..., k], units, f"standard error: {text}"
        )
    text = "circulation, mean over radii from 5 to 15 m"
    data["circulation_5_15"] = _variable(("scan", "vortex"), inner, "m2 s-1", text)
    data["circulation_5_15_stderr"] = _variable(
        ("scan", "vortex"), inner_stderr, "m2 s-1", f"standard error: {text}"
    )
    both = "scan", "number", "other_number"
    data["covariance"] = (
        both,
        covariance[:, :-1, :-1],
        {"long_name": "covariance of the vortices' numbers"},
    )
    for name, series, units, text in (
        ("wind", wind, "m s-1", "mean wind along y at the height of the vortices"),
        ("wind_stderr", wind_stderr, "m s-1", "its standard error"),
        ("other_profile", other, "1", "fraction of the other profile in the swirl"),
        ("other_profile_stderr", other_stderr, "1", "its standard error"),
        ("turbulence", sigma, "m s-1", "likeliest standard deviation of a component of the wind"),
        ("turbulence_length", length, "m", "likeliest length scale of the turbulence"),
        ("misfit", misfit, "1", "mean normalised square of the residuals"),
        ("probability", [one.seen.probability for one in found], "1", "probability of a wake"),
        (
            "false_alarm",
            [one.seen.false_alarm for one in found],
            "1",
            "probability of the score in a scan without a wake",
        ),
        ("score", [one.seen.score for one in found], "1", "largest of the matched filters"),
    ):
        data[name] = _variable(("scan",), np.asarray(series, float), units, text)
    data["flag"] = (
        ("scan",),
        np.array([one.flag for one in found], np.uint16),
        flag_attributes(VortexFlag, "reasons not to use the vortices"),
    )
    names = [f"{name}_{k}" for k in range(number) for name in NUMBERS]
    coords = {
        "time": ("scan", time, {"long_name": "time at which the vortices are there (UTC)"}),
        "azimuth": _variable(
            ("scan",), np.array([one.scan.azimuth for one in found]), "degree", "azimuth of y"
        ),
        "sweep": (
            "scan",
            np.array([one.scan.sweep for one in found]),
            {"long_name": "number of the scan in its data set"},
        ),
        "start": ("scan", np.array([one.scan.start for one in found]), {"long_name": "first line"}),
        "end": (
            "scan",
            np.array([one.scan.at(float(one.scan.time.max())) for one in found]),
            {"long_name": "last line"},
        ),
        "scan": np.arange(count),
        "vortex": np.arange(number),
        "number": names,
        "other_number": names,
    }
    return xr.Dataset(
        data,
        coords,
        {"Conventions": "CF-1.11", "title": "Wake vortices from lines of sight", **about},
    )


def _variable(dims: tuple[str, ...], values: np.ndarray, units: str, text: str) -> tuple[Any, ...]:
    return dims, values, {"units": units, "long_name": text}
