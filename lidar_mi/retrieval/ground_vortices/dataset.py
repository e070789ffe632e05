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
    """Detection and fit of one scan; no fit where there is no wake."""

    scan: PlaneScan
    detection: Detection
    fit: Fit | None
    flag: int
    vortices: int


def ordered(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (vortices, 4), cores in m, the smaller y first, and their covariance.

    The last row and column of the covariance are of the fraction of the other profile.
    """
    vortices = fit.state.vortices
    order = np.argsort(vortices[:, 0], kind="stable")
    index = (OF_VORTEX * order[:, None] + np.arange(OF_VORTEX)).ravel()
    values = vortices[order].copy()
    scale = np.ones_like(values)
    values[:, 3] = np.exp(values[:, 3])
    # derivative by the logarithm, which the fit has
    scale[:, 3] = values[:, 3]
    index = np.append(index, vortices.size + fit.state.departures.size)
    size = np.append(scale.ravel(), 1.0)
    return values, fit.covariance[np.ix_(index, index)] * np.outer(size, size)


def _inner(
    values: np.ndarray, covariance: np.ndarray, fraction: np.ndarray, profile: Model
) -> tuple[np.ndarray, np.ndarray]:
    """Circulation (scans, vortices) from 5 to 15 m of each vortex alone, and its standard error."""
    circulation, core = values[..., 2], values[..., 3]
    mixture, step = np.broadcast_to(fraction[:, None], core.shape), 1e-4
    part = circulation_5_15(core, mixture, profile)
    by_core = (circulation_5_15(core + step, mixture, profile) - part) / step
    by_fraction = (circulation_5_15(core, mixture + step, profile) - part) / step
    variance = np.empty(circulation.shape)
    for k in range(values.shape[1]):
        used = [OF_VORTEX * k + 2, OF_VORTEX * k + 3, -1]
        slope = np.stack([by_core[:, k], by_fraction[:, k]], -1) * circulation[:, k, None]
        by = np.column_stack([part[:, k], slope])
        used_covariance = covariance[:, used][:, :, used]
        variance[:, k] = np.einsum("sa,sab,sb->s", by, used_covariance, by)
    return circulation * part, np.sqrt(variance)


def vortex_dataset(scans: Sequence[ScanVortices], about: Mapping[str, Any]) -> xr.Dataset:
    """All scans in the order of time."""
    scans = sorted(scans, key=lambda s: s.scan.start)
    count, number = len(scans), max(s.vortices for s in scans)
    values = np.full((count, number, OF_VORTEX), np.nan)
    covariance = np.full((count, number * OF_VORTEX + 1, number * OF_VORTEX + 1), np.nan)
    fraction = np.full(count, np.nan)
    wind, wind_stderr = np.full(count, np.nan), np.full(count, np.nan)
    sigma, length, misfit = (np.full(count, np.nan) for _ in range(3))
    time = np.empty(count, "datetime64[ns]")
    for k, (scan, fit) in enumerate((s.scan, s.fit) for s in scans):
        time[k] = scan.at(float(np.mean(scan.time)))
        if fit is not None:
            values[k], covariance[k] = ordered(fit)
            fraction[k] = fit.state.other_profile[0]
            time[k] = scan.at(fit.time)
            at = len(fit.state.vector) - len(fit.state.wind)
            wind[k] = fit.state.wind[0]
            wind_stderr[k] = np.sqrt(fit.covariance[at, at])
            sigma[k], length[k] = fit.air.sigma, fit.air.length
            misfit[k] = fit.misfit / fit.dof
    stderr = np.sqrt(np.einsum("saa->sa", covariance))
    fraction_stderr, stderr = stderr[:, -1], stderr[:, :-1].reshape(values.shape)
    inner, inner_stderr = _inner(values, covariance, fraction, about["profile"])
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
    dims = "scan", "number", "other_number"
    data["covariance"] = (
        dims,
        covariance[:, :-1, :-1],
        {"long_name": "covariance of the vortices' numbers"},
    )
    for name, series, units, text in (
        ("wind", wind, "m s-1", "mean wind along y at the height of the vortices"),
        ("wind_stderr", wind_stderr, "m s-1", "its standard error"),
        ("other_profile", fraction, "1", "fraction of the other profile in the swirl"),
        ("other_profile_stderr", fraction_stderr, "1", "its standard error"),
        ("turbulence", sigma, "m s-1", "likeliest standard deviation of a component of the wind"),
        ("turbulence_length", length, "m", "likeliest length scale of the turbulence"),
        ("misfit", misfit, "1", "mean normalised square of the residuals"),
        ("probability", [s.detection.probability for s in scans], "1", "probability of a wake"),
        (
            "false_alarm",
            [s.detection.false_alarm for s in scans],
            "1",
            "probability of the score in a scan without a wake",
        ),
        ("score", [s.detection.score for s in scans], "1", "largest of the matched filters"),
    ):
        data[name] = _variable(("scan",), np.asarray(series, float), units, text)
    data["flag"] = (
        ("scan",),
        np.array([s.flag for s in scans], np.uint16),
        flag_attributes(VortexFlag, "reasons not to use the vortices"),
    )
    names = [f"{name}_{k}" for k in range(number) for name in NUMBERS]
    coords = {
        "time": ("scan", time, {"long_name": "time at which the vortices are there (UTC)"}),
        "azimuth": _variable(
            ("scan",), np.array([s.scan.azimuth for s in scans]), "degree", "azimuth of y"
        ),
        "sweep": (
            "scan",
            np.array([s.scan.sweep for s in scans]),
            {"long_name": "number of the scan in its data set"},
        ),
        "start": ("scan", np.array([s.scan.start for s in scans]), {"long_name": "first line"}),
        "end": (
            "scan",
            np.array([s.scan.at(float(s.scan.time.max())) for s in scans]),
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
