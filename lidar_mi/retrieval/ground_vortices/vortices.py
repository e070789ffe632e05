"""Vortices of a wake from vertical slices (RHI) of a Doppler lidar on the ground."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import scipy
import xarray as xr
from threadpoolctl import threadpool_limits

from lidar_mi.arguments import checked_arguments
from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.errors import InputError
from lidar_mi.flags import VortexFlag
from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.progress import Notice
from lidar_mi.retrieval.ground_vortices.dataset import ScanVortices, vortex_dataset
from lidar_mi.retrieval.ground_vortices.detection import SEPARATIONS, detect
from lidar_mi.retrieval.ground_vortices.echo import at_the_echo
from lidar_mi.retrieval.ground_vortices.fit import Air, Assumptions, Fit, fitted, residuals
from lidar_mi.retrieval.ground_vortices.scan_plane import PlaneScan, plane_scans
from lidar_mi.retrieval.ground_vortices.track import tracked
from lidar_mi.retrieval.ground_vortices.turbulence import LENGTHS
from lidar_mi.retrieval.ground_vortices.window import CELL, Window, window_of
from lidar_mi.retrieval.ground_winds.tilt import unapplied_tilt

Kind = Literal["pair", "single"]

FALSE_ALARM = 0.01
"""Of scans without a wake, the largest fraction in which one is found."""

_ASIDE = 45.0  # m of the scan beside the vortices
_LIKELY_CORE = 3.0  # m
_OVERLAP = 0.75
"""Step of the gates over their length up to which the noise of neighbours is remarked on."""
_MISFIT = 1e-4
_LONGEST = 90.0
"""Pulses and gates (m) up to which stated errors were compared with true ones."""


@checked_arguments
def fit_vortices_to_lines(
    lines: xr.Dataset | Sequence[xr.Dataset],
    *,
    kind: Kind = "pair",
    profile: Model = "lamb_oseen",
    span: float | None = None,
    ground: float | None = None,
    core_radius: float | None = None,
    pulse_length: float | None = None,
    gate_length: float | None = None,
    noise: float | None = None,
    false_alarm: float = FALSE_ALARM,
    notice: Notice | None = None,
) -> xr.Dataset:
    r"""Vortices of a wake from vertical slices (RHI) of a Doppler lidar on the ground.

    Parameters
    ----------
    lines : xr.Dataset or sequence of xr.Dataset
        As of `read_lines_of_sight`; every sweep is a scan. Gates with a flag are not used. A
        variable ``radial_velocity_stderr`` (m s-1), if there is one, states the noise of every
        gate; ``snr`` says where in a gate the echo comes from.
    kind : {"pair", "single"}
    profile : {"lamb_oseen", "burnham_hallock"}
    span : float, optional
        Wing span of the aircraft, m; the initial separation of the vortices is pi/4 of it. Default:
        unknown, 28 to 81 m.
    ground : float, optional
        Height of the ground above the lidar, m (-2: the lidar stands 2 m high). Default: no ground;
        with it, vortices have their images.
    core_radius : float, optional
        Prior core radius, m; its standard deviation is a factor of 1.65. Default: 5 % of the span,
        or 3 m.
    pulse_length, gate_length : float, optional
        Full width at half maximum of the pulse in range (c tau / 2), and length of the time window
        of a gate, m. Default: attributes of the data set of these names; of the pulse, the gate's.
    noise : float, optional
        Least standard error of the velocities, m/s, where the data set does not state it for every
        gate; residuals of neighbouring lines show where it is larger. Default: from these alone.
    false_alarm : float
        Accepted fraction of false detections among scans without a wake.
    notice : callable, optional
        Called with a description of the running step and its progress, 0 to 1.

    Returns
    -------
    xr.Dataset, dims (scan, vortex)
        `y` (horizontal distance from the lidar in the plane of the scan, m), `z` (height above the
        lidar, m), `circulation` (m2 s-1; positive turns from y to z), `core_radius` (m) and
        `circulation_5_15` (m2 s-1, mean over radii from 5 to 15 m), each with `_stderr`; the
        `covariance` (scan, number, other_number) of the first four; `wind` (m s-1) along y at the
        mean height of the vortices; `other_profile`, the fraction of the profile that was not
        chosen; `time`, at which the vortices are there; `probability` of a wake, `false_alarm`,
        `score`; `flag` (0: valid). Vortex 0 is that of smaller y. Of two scans or more, `y_tracked`
        and so on with `_stderr`, smoothed over all scans, and `track_used`.

    Raises
    ------
    InputError
        A data set without lines of sight, scans that are no RHI, numbers out of range.

    Examples
    --------
    A pair 600 m from a lidar, of 400 m2/s and 40 m apart:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> angle, distance = np.meshgrid(np.radians(np.arange(2, 16, 0.15)), np.arange(450, 750, 15))
    >>> y, z = distance * np.cos(angle), distance * np.sin(angle)
    >>> speed = 2 + 0 * y
    >>> for place, circulation in ((580, -400), (620, 400)):
    ...     square = (y - place) ** 2 + (z - 90) ** 2 + 3**2
    ...     across = (y - place) * np.sin(angle) - (z - 90) * np.cos(angle)
    ...     speed += circulation / (2 * np.pi) * across / square
    >>> rows = zip(angle.ravel(), np.degrees(angle.ravel()), distance.ravel(), speed.ravel())
    >>> with open("rhi.csv", "w") as file:
    ...     _ = file.write("time,azimuth,elevation,range,radial_velocity\n")
    ...     for row in rows:
    ...         _ = file.write("{:.3f},90,{:.3f},{:.1f},{:.3f}\n".format(*row))
    >>> lines = lm.read_lines_of_sight("rhi.csv")
    >>> found = lm.fit_vortices_to_lines(
    ...     lines, profile="burnham_hallock", pulse_length=5, gate_length=5, noise=0.1
    ... )
    >>> found["y"].values.round()
    array([[580., 620.]])
    """
    sets = [lines] if isinstance(lines, xr.Dataset) else list(lines)
    if not sets:
        raise InputError("lines: none; expected one data set or more")
    _check(
        span=span,
        core_radius=core_radius,
        pulse_length=pulse_length,
        gate_length=gate_length,
        noise=noise,
    )
    for name, value, choice in (("kind", kind, Kind), ("profile", profile, Model)):
        if value not in get_args(choice):
            raise InputError(
                f"{name}: {value!r} is not allowed; expected {' or '.join(get_args(choice))}"
            )
    if not 0 < false_alarm < 1:
        raise InputError(f"false_alarm: {false_alarm} is not allowed; expected between 0 and 1")
    core = core_radius or (0.05 * span if span else _LIKELY_CORE)
    assumed = Assumptions(profile, ground, core)
    separations: tuple[float, ...] = SEPARATIONS
    if span is not None:
        separations = tuple(math.pi / 4 * span * factor for factor in (0.85, 1.0, 1.2))
    fitted_scans: list[ScanVortices] = []
    remarks: list[str] = []
    for number, data in enumerate(sets):
        lidar = lidar_of(data, pulse_length, gate_length)
        scans, more = plane_scans(at_the_echo(data, lidar), noise)
        remarks += more
        if max(lidar.pulse_length, lidar.gate_length) > _LONGEST:
            remarks.append(
                f"pulses of {lidar.pulse_length:.4g} m and gates of {lidar.gate_length:.4g} m: "
                f"stated errors were compared with true ones for {_LONGEST:g} m at most"
            )
        tilt = unapplied_tilt(data)
        if tilt > 0:
            remarks.append(
                f"pitch and roll of up to {np.rad2deg(tilt):.2f} degrees are not applied: "
                f"{1000 * tilt:.1f} m of position per km of range, not in the errors"
            )
        first = len(fitted_scans)
        for k, scan in enumerate(scans):
            if notice is not None:
                notice("fitting vortices", (number + k / len(scans)) / len(sets))
            # matrices are small: threads would wait for each other longer than they compute
            with threadpool_limits(1, "blas"):
                fitted_scans.append(_scan(scan, lidar, assumed, kind, separations, false_alarm))
        remarks += _of_overlapping_gates(fitted_scans[first:], data, lidar)
    about: dict[str, str | float] = {
        "profile": profile,
        "kind": kind,
        "false_alarm_limit": false_alarm,
    }
    about["remarks"] = "\n".join(remarks)
    vortices = vortex_dataset(fitted_scans, about)
    return tracked(vortices, ground) if len(fitted_scans) > 1 else vortices


def _check(**numbers: float | None) -> None:
    for name, value in numbers.items():
        if value is not None and not 0 < value < np.inf:
            raise InputError(f"{name}: {value} is not allowed; expected a number above 0")


def lidar_of(lines: xr.Dataset, pulse: float | None, gate: float | None) -> CoherentLidar:
    """What the lidar averages over; gates of unknown length touch each other."""
    ranges = lines["range"].values if "range" in lines.variables else np.zeros(0)
    if len(ranges) < 2:
        raise InputError(f"lines: {len(ranges)} gates; expected two or more")
    gate = gate or float(lines.attrs.get("gate_length", 0.0)) or float(np.median(np.diff(ranges)))
    pulse = pulse or float(lines.attrs.get("pulse_length", 0.0)) or gate
    return CoherentLidar(
        pulse_duration=2 * pulse / scipy.constants.c, gate_length=gate, first_gate=gate
    )


def _of_overlapping_gates(
    scans: list[ScanVortices], lines: xr.Dataset, lidar: CoherentLidar
) -> list[str]:
    """A remark on misfits that may be due to noise common to neighbouring gates."""
    misfit = sum(bool(scan.flag & VortexFlag.MISFIT.value) for scan in scans)
    step = float(np.median(np.diff(lines["range"].values)))
    if not misfit or step > _OVERLAP * lidar.gate_length:
        return []
    return [
        f"{misfit} of {len(scans)} scans have a misfit: gates of {lidar.gate_length:g} m every "
        f"{step:g} m overlap, and noise that neighbours have in common, which the fit takes for "
        "independent, may be its cause"
    ]


def _scan(
    scan: PlaneScan,
    lidar: CoherentLidar,
    assumed: Assumptions,
    kind: Kind,
    separations: tuple[float, ...],
    false_alarm: float,
) -> ScanVortices:
    single = kind == "single"
    detection = detect(scan, lidar, assumed, separations=separations, single=single)
    if not detection.candidates or detection.false_alarm > false_alarm:
        return ScanVortices(scan, detection, None, VortexFlag.NO_WAKE.value, 1 if single else 2)
    starts = [candidate.vortices for candidate in detection.candidates]
    window = _window(scan, lidar, np.concatenate(starts))
    if window is None:
        return ScanVortices(scan, detection, None, VortexFlag.NO_FIT.value, 1 if single else 2)
    length = min(LENGTHS, key=lambda length: abs(math.log(length / detection.air.length)))
    fit, others = fitted(window, starts, Air(detection.air.sigma, length), assumed)
    if scan.sweeps and scan.step * window.lines.ranges.mean() > CELL:
        # with lines so far apart it matters whether the beam moves while it measures
        standing = replace(scan, sweeps=False)
        standing_window = _window(standing, lidar, np.concatenate(starts))
        if standing_window is not None:
            standing_fit, more = fitted(
                standing_window, [fit.state.vortices, *starts], fit.air, assumed
            )
            if standing_fit.log_likelihood > fit.log_likelihood:
                scan, window, fit, others = standing, standing_window, standing_fit, more
    if scan.stated != "gates":
        residual = residuals(window, fit, assumed)
        window = window.with_noise_of(residual, limited=scan.stated == "least")
        fit, _ = fitted(window, [fit.state.vortices], fit.air, assumed)
    return ScanVortices(scan, detection, fit, _flag(scan, fit, others, lidar), 1 if single else 2)


def _window(scan: PlaneScan, lidar: CoherentLidar, vortices: np.ndarray) -> Window | None:
    ranges = np.hypot(vortices[:, 0], vortices[:, 1])
    angles = np.arctan2(vortices[:, 1], vortices[:, 0])
    aside = _ASIDE / ranges.mean()
    return window_of(
        scan,
        lidar,
        (ranges.min() - _ASIDE, ranges.max() + _ASIDE),
        (angles.min() - aside, angles.max() + aside),
    )


def _flag(scan: PlaneScan, fit: Fit, others: list[np.ndarray], lidar: CoherentLidar) -> int:
    flag = VortexFlag(0)
    vortices = fit.state.vortices
    if not fit.converged:
        flag |= VortexFlag.NO_FIT
    ranges, angles = (
        np.hypot(vortices[:, 0], vortices[:, 1]),
        np.arctan2(vortices[:, 1], vortices[:, 0]),
    )
    if (
        (ranges < scan.ranges[0]).any()
        or (ranges > scan.ranges[-1]).any()
        or (angles < scan.angle[0]).any()
        or (angles > scan.angle[-1]).any()
    ):
        flag |= VortexFlag.OUTSIDE
    stderr = np.sqrt(np.diag(fit.covariance))
    if any((stderr[4 * k + 2] > abs(vortices[k, 2]) / 2) for k in range(len(vortices))) or (
        max(stderr[[4 * k + j for k in range(len(vortices)) for j in (0, 1)]])
        > lidar.gate_length / 2
    ):
        flag |= VortexFlag.NOT_IDENTIFIED
    if len(vortices) == 2 and vortices[0, 2] * vortices[1, 2] > 0:
        flag |= VortexFlag.SAME_SENSE
    if scipy.stats.chi2.sf(fit.misfit, fit.dof) < _MISFIT:
        flag |= VortexFlag.MISFIT
    if any(np.abs((other - vortices)[:, :2]).max() > lidar.gate_length / 2 for other in others):
        flag |= VortexFlag.AMBIGUOUS
    return flag.value
