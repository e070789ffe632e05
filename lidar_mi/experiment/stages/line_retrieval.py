"""What the lines of a coherent lidar tell: vortices of vertical slices, winds of other scans."""

import math

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.coherent_lines import coherent_lidar, ring_fraction, true_vortices
from lidar_mi.experiment.truth.passing_wake import PassingWake
from lidar_mi.instrument.coherent.measurement import START
from lidar_mi.instrument.coherent.scans import directions
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.wake import Wake

_UNEVEN_ECHO = 1 << 8
_UNEVEN, _PART = 1.5, 0.99
"""Factor by which the signals of a slice may differ from those of all at the same range, but for a
hundredth of them."""


def has_profiles(experiment: Experiment) -> bool:
    """Whether a coherent lidar scans winds."""
    return experiment.coherent is not None and experiment.coherent.scan.kind in ("ppi", "dbs")


def has_slices(experiment: Experiment) -> bool:
    """Whether a coherent lidar scans vertical slices."""
    return experiment.coherent is not None and experiment.coherent.scan.kind == "rhi"


def line_winds(
    coherent_lines: xr.Dataset, passing_air: PassingWake, doppler_interval: float | None, log: Log
) -> xr.Dataset:
    """Profiles of the wind as of `fit_winds_to_lines`, beside the truth.

    Raises InputError: scans without any wind.

    Returns
    -------
    xr.Dataset
        With `u_true`, `v_true`, `w_true` (m/s): means over the slanted lines of the scan or the
        interval, each at its own time where it crosses the height.
    """
    from lidar_mi.retrieval.ground_winds.winds import fit_winds_to_lines

    log.bar("fitting winds to lines of sight", None)
    winds = fit_winds_to_lines(coherent_lines, interval=doppler_interval)
    true = np.full((3, winds.sizes["time"], winds.sizes["height"]), np.nan)
    groups = coherent_lines["sweep"].values
    if doppler_interval is not None:
        seconds = _seconds(coherent_lines["time"])
        groups = (seconds - seconds[0]) // doppler_interval
    numbers = np.unique(groups)
    if len(numbers) != winds.sizes["time"]:
        raise InputError(
            f"doppler.scan: {winds.sizes['time']} of {len(numbers)} scans have winds; expected all "
            "(a stronger doppler.signal)"
        )
    for k, number in enumerate(numbers):
        one = coherent_lines.isel(time=np.flatnonzero(groups == number))
        true[:, k] = _mean_wind(one, winds["height"].values, passing_air)
    for k, name in enumerate("uvw"):
        attributes = {"units": "m s-1", "long_name": f"true {winds[name].attrs['long_name']}"}
        winds[f"{name}_true"] = ("time", "height"), true[k], attributes
    return winds


def line_vortices(
    coherent_lines: xr.Dataset,
    doppler: CoherentDoppler,
    wake: Wake,
    passing_air: PassingWake,
    log: Log,
) -> xr.Dataset:
    """Vortices of every slice as of `fit_vortices_to_lines`, beside the truth.

    Returns
    -------
    xr.Dataset
        With `y_true`, `z_true` (m) and `circulation_5_15_true` (m^2/s, mean over rings of 5 to
        15 m) at the time of the fit, the smaller y first; the wake's `age` (s) and the attribute
        ``separation`` (m) of the wake. Of the method of radial velocities, its peer, `y_rv`, ...
        and the truth at its own times, `y_rv_true`, ...
    """
    from lidar_mi.retrieval.ground_vortices.vortices import fit_vortices_to_lines

    log.bar("fitting vortices to lines of sight", None)
    ground = -doppler.position[2] if doppler.passage.ground and wake.vortex_pair else None
    vortices = fit_vortices_to_lines(coherent_lines, ground=ground, notice=log.bar)
    vortices = _flagged(vortices, coherent_lines)
    seconds = _seconds(vortices["time"])
    peer = _by_peer(coherent_lines, doppler, passing_air, vortices.attrs["profile"])
    true = _nearer_first(doppler, passing_air, np.stack([seconds, seconds], -1))
    at_peer = _nearer_first(doppler, passing_air, peer[..., 3])
    both = "scan", "vortex"
    for k, name in enumerate(("y", "z", "circulation_5_15")):
        about = vortices[name].attrs
        text = about["long_name"]
        vortices[f"{name}_true"] = both, true[..., k], about | {"long_name": f"true {text}"}
        by = f"{text}, by the method of radial velocities"
        vortices[f"{name}_rv"] = both, peer[..., k], about | {"long_name": by}
        then = f"true {text} at its time"
        vortices[f"{name}_rv_true"] = both, at_peer[..., k], about | {"long_name": then}
    age = {"units": "s", "long_name": "age of the wake"}
    vortices["age"] = "scan", doppler.passage.age + seconds, age
    # of a wake near the ground it grows
    first = true_vortices(doppler, passing_air, np.zeros(1))[0]
    separation = (
        wake.vortex_pair.separation if wake.vortex_pair else np.hypot(*np.ptp(first, 0)[:2])
    )
    return vortices.assign_attrs(separation=float(separation))


def _nearer_first(doppler: CoherentDoppler, air: PassingWake, seconds: np.ndarray) -> np.ndarray:
    """True vortices (scans, 2, 3), the smaller y first, each at its time (scans, 2); NaN: none."""
    true = np.full((*seconds.shape, 3), np.nan)
    for k in range(2):
        known = np.isfinite(seconds[:, k])
        both = true_vortices(doppler, air, seconds[known, k])
        order = np.argsort(both[..., 0], axis=1)
        true[known, k] = np.take_along_axis(both, order[..., None], axis=1)[:, k]
    return true


def _flagged(vortices: xr.Dataset, lines: xr.Dataset) -> xr.Dataset:
    """Slices whose echo is uneven have the flag uneven_echo.

    A fit takes the echo for even within a gate. Of exhaust in the cores, which scatters more than
    the air around, a gate sees the cores alone, and neither residuals nor standard errors show it.
    """
    ratio, sweep = lines["snr"].values, lines["sweep"].values
    away = np.abs(np.log(ratio / np.median(ratio, axis=0)))
    spread = np.array([np.quantile(away[sweep == number], _PART) for number in np.unique(sweep)])
    flag = vortices["flag"]
    masks = np.append(flag.attrs["flag_masks"], _UNEVEN_ECHO).astype(np.uint16)
    about = {"flag_masks": masks, "flag_meanings": f"{flag.attrs['flag_meanings']} uneven_echo"}
    uneven = np.where(spread > math.log(_UNEVEN), _UNEVEN_ECHO, 0).astype(flag.dtype)
    return vortices.assign(flag=("scan", flag.values | uneven, flag.attrs | about))


def _by_peer(
    lines: xr.Dataset, doppler: CoherentDoppler, air: PassingWake, profile: Model
) -> np.ndarray:
    """By the method of radial velocities: y, z, circulation of 5 to 15 m, time (scans, 2, 4).

    It searches around the true places, at which it has no way to be wrong by a whole vortex. NaN:
    it finds nothing.
    """
    from lidar_mi.retrieval.ground_vortices.echo import at_the_echo
    from lidar_mi.retrieval.ground_vortices.fit import Assumptions
    from lidar_mi.retrieval.ground_vortices.radial_velocities import by_radial_velocities
    from lidar_mi.retrieval.ground_vortices.scan_plane import plane_scans

    given, lidar = Assumptions(profile), coherent_lidar(doppler)
    part = float(ring_fraction(np.array(given.core_radius), profile))
    scans, _ = plane_scans(at_the_echo(lines, lidar), None)
    rows = np.full((len(scans), 2, 4), np.nan)
    for row, scan in zip(rows, scans, strict=True):
        start = (scan.start - START) / np.timedelta64(1, "s")
        middle = np.full((1, 2), start + float(scan.time.mean()))
        guess = _nearer_first(doppler, air, middle)[0]
        cores = np.full((2, 1), np.log(given.core_radius))
        with threadpool_limits(1, "blas"):
            vortices = by_radial_velocities(scan, lidar, given, np.hstack([guess, cores]))
        if vortices is not None:
            row[:, :3] = vortices * [1, 1, part]
            # when the lines pass there
            angle = np.arctan2(vortices[:, 1], vortices[:, 0])
            row[:, 3] = start + np.interp(angle, scan.angle, scan.time)
    return rows


def _seconds(time: xr.DataArray) -> np.ndarray:
    """Times from the start of the first line on, s."""
    return (time.values - START) / np.timedelta64(1, "s")


def _mean_wind(lines: xr.Dataset, heights: np.ndarray, air: PassingWake) -> np.ndarray:
    """True wind (3, heights) to the east, to the north and up."""
    azimuth, elevation = (np.deg2rad(lines[name].values) for name in ("azimuth", "elevation"))
    slanted = np.cos(elevation) > 1e-3
    along = directions(azimuth[slanted], elevation[slanted])
    places = along / along[:, 2:]
    east, north, up = (places[:, k, None] * heights for k in range(3))
    time = np.broadcast_to(_seconds(lines["time"])[slanted, None], east.shape)
    return np.stack([one.mean(0) for one in air.wind(east, north, up, time)])
