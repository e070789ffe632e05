"""Why a value of a line of sight is not to be used: blind range, weak signal, hard targets."""

import math

import numpy as np

from lidar_mi.flags import LineFlag
from lidar_mi.io.lines_of_sight.scan import Scan

MIN_CNR = {"WindCube": -27.0, "": -21.0}
"""Least signal-to-noise ratio, dB, by kind of file.

Below it, estimates of the velocity become uniform noise. -21 dB: SNR 0.008, of the wind profiles of
ARM's Halo lidars (Newsom et al., Doppler Lidar Wind Value-Added Product, DOE/SC-ARM-TR-148, 2015).
-27 dB is in use for scanning WindCubes; it is not derived, and the status of their own software
rejects as well.
"""

BLIND_RANGE = {"Halo Photonics (hpl)": 90.0, "ARM": 90.0, "": 0.0}
"""Range up to which the outgoing pulse is seen, m: three gates of 30 m of Halo Photonics' lidars.

WindCube's gates begin behind it. That of others is unknown.
"""

HARD_TARGET_DB = 10.0
"""Rise of the signal over the gates before it, dB.

Aerosol changes by less within a few gates; a wall returns orders of magnitude more.
"""
HARD_TARGET_SPEED = 0.3
"""Largest speed of a hard target, m/s: at rest, to a few steps of the velocity."""
HARD_TARGET_ELEVATION = 30.0
"""Largest elevation of hard targets, degrees: above it, bright gates are clouds."""

_GATES_BEFORE = 5  # gates whose median is the signal before a target
# a reflection of the outgoing pulse has the same speed in all directions, to this, m/s
_SAME_SPEED = 0.1
_LONGEST_PULSES = 4  # gate lengths that a reflection may cover


EXCESS = 4.0
"""Least frequency of a repeated number over that of its neighbours."""
LEAST_REPEATED = 40
"""Least number of cells with a repeated number."""

_LEAST_NOISE = 500  # gates: a tenth of uniform velocities is above 90 % of the largest, to 1.5 %
_LEAST_GATES = 8  # whose velocities are not equal by coincidence


def flags(
    scan: Scan, min_cnr: float | None = None, blind_range: float | None = None
) -> tuple[np.ndarray, dict[str, float]]:
    """Flags (lines, gates) of a scan, and the thresholds that they were made with.

    scan: reflections and repeated numbers that are found are added to its remarks.
    min_cnr: dB; default: `MIN_CNR` of the kind of file.
    blind_range: m; default: `BLIND_RANGE` of the kind of file, and behind it gates that measure the
        same velocity in all directions.
    """
    kind = str(scan.about.get("kind", ""))
    explicit = blind_range is not None
    limit = _limit(scan, min_cnr)
    blind = BLIND_RANGE.get(kind, BLIND_RANGE[""]) if blind_range is None else blind_range
    velocity, snr = scan.fields["radial_velocity"], scan.fields.get("snr")
    flag = np.zeros(velocity.shape, np.uint16)
    flag[~np.isfinite(velocity)] |= LineFlag.MISSING.value
    overlap = 1.0
    if snr is not None:
        # no total power: never written
        flag[snr <= -1.0] |= LineFlag.MISSING.value
        overlap = overlapping(scan, snr, limit)[0]
        flag[np.isfinite(velocity) & ~(snr >= 10 ** (limit / 10))] |= LineFlag.LOW_CNR.value
        _nyquist_of_noise(scan, velocity[flag == LineFlag.LOW_CNR.value])
    near = np.broadcast_to(scan.range < blind, velocity.shape).copy()
    if not explicit:
        near |= reflection(scan, overlap)
    flag[near] |= LineFlag.BLIND_RANGE.value
    if snr is not None:
        flag[hard_targets(scan, snr, flag != 0, overlap)] |= LineFlag.HARD_TARGET.value
    same = repeated(np.where(flag == 0, velocity, np.nan))
    if same.any():
        number = velocity[same][0]
        flag[same] |= LineFlag.REPEATED.value
        scan.remarks.append(
            f"{int(same.sum())} cells in {int(same.any(1).sum())} lines repeat one number "
            f"({number:g} m/s): flagged"
        )
    if scan.rejected is not None:
        flag[scan.rejected] |= LineFlag.REJECTED.value
    return flag, {"min_cnr": limit, "blind_range": blind}


def _nyquist_of_noise(scan: Scan, noise: np.ndarray) -> None:
    """Nyquist velocity of the file: velocities of gates without a signal are uniform below it."""
    top = float(np.abs(noise).max()) if noise.size >= _LEAST_NOISE else 0.0
    if top > 0 and 0.05 < np.mean(np.abs(noise) > 0.9 * top) < 0.2:
        scan.about.setdefault("nyquist_velocity", top * (1 + 1 / noise.size))


def correct_steps(scan: Scan, min_cnr: float | None = None) -> None:
    """Correct the ranges of overlapping gates that the file states to be adjacent.

    The correlation of the noise gives the number that overlap; ranges are corrected where it
    determines a whole number, or agrees with that of the file.
    """
    snr = scan.fields.get("snr")
    step = float(np.nanmedian(np.diff(scan.range)))
    length = float(scan.about.get("gate_length", step))
    if snr is None or step <= 0.7 * length:
        return
    count, error = overlapping(scan, snr, _limit(scan, min_cnr))
    if count == 1.0:
        return
    finding = (
        f"noise of neighbouring gates correlates by {1 - 1 / count:.2f}, as of gates that overlap "
        f"{count:.0f}-fold, but range has steps of {step:g} m for gates of {length:g} m"
    )
    if error < 1 / 6:
        count = round(count)
        scan.range = scan.range[:1] + step / count * np.arange(scan.range.size)
        # adjacent gates are as long as their steps
        scan.about.setdefault("gate_length", length)
        scan.remarks.append(f"{finding}: steps of {step / count:.3g} m are used (range_step)")
    else:
        scan.remarks.append(
            f"{finding}: ranges may be {count:.0f} times too long "
            f"(range_step: '{step / count:.3g} m')"
        )


def overlapping(scan: Scan, snr: np.ndarray, limit: float) -> tuple[float, float]:
    """Number of neighbouring gates with common samples, and its standard error; 1: none overlap.

    From the correlation of the noise: gates of n samples that are one sample apart correlate by
    1 - 1/n. The error is that of the lines' own estimates, 0 where the file's number agrees.
    """
    if scan.range.ndim > 1 or snr.shape[1] < 40:
        return 1.0, 0.0
    # gates of the far half in which no line has a signal
    noise = np.where(snr > -1.0, snr, np.nan)[:, snr.shape[1] // 2 :]
    noise = noise[:, (noise < 10 ** (limit / 10)).all(0)]
    if noise.size < 400 or noise.shape[1] < 150:
        return 1.0, 0.0
    # by structure functions, which offsets of the background do not change
    far = np.mean([_structure(noise, lag) for lag in range(60, 80)], axis=0)
    first = _structure(noise, 1)
    if not (far.sum() > 0 and first.sum() / far.sum() < 0.5):
        return 1.0, 0.0
    count = float(far.sum() / first.sum())
    lines = len(noise)
    error = np.inf
    if lines > 2:
        error = float(np.std(far - count * first) / first.mean() / math.sqrt(lines))
    # the number of samples in the file, if the noise agrees
    samples = float(scan.about.get("samples_per_gate", np.nan))
    return (samples, 0.0) if abs(count / samples - 1) < 0.3 else (count, error)


def _limit(scan: Scan, min_cnr: float | None) -> float:
    kind = str(scan.about.get("kind", ""))
    return MIN_CNR.get(kind, MIN_CNR[""]) if min_cnr is None else min_cnr


def repeated(velocity: np.ndarray) -> np.ndarray:
    """Cells (lines, gates) that hold a constant instead of a measurement, as with a blocked beam.

    Either every gate of a line has the same velocity while other lines vary; or one velocity is
    there `EXCESS` times as often as any of its neighbours. Of a smooth distribution with at most
    `LEAST_REPEATED` / `EXCESS` cells at each velocity, the second happens by chance once in 1e8.
    """
    finite = np.isfinite(velocity)
    many = finite.sum(1) >= _LEAST_GATES
    low, high = (
        np.where(many, f(np.where(finite, velocity, limit), axis=1), limit)
        for f, limit in ((np.min, np.inf), (np.max, -np.inf))
    )
    constant = many & (low == high)
    cells = np.zeros(velocity.shape, bool)
    if many.any() and (not constant[many].all() or np.unique(low[constant]).size == 1):
        cells |= constant[:, None] & finite
    values, counts = np.unique(np.round(velocity[finite], 6), return_counts=True)
    if values.size > 10:
        top = int(counts.argmax())
        near = counts[max(top - 10, 0) : top + 11].copy()
        near[min(top, 10)] = 0
        if counts[top] >= max(LEAST_REPEATED, EXCESS * near.max()):
            cells |= np.round(velocity, 6) == values[top]
    return cells


def _structure(values: np.ndarray, lag: int) -> np.ndarray:
    """Mean square difference of gates so many apart, (lines,)."""
    return np.mean((values[:, lag:] - values[:, :-lag]) ** 2, axis=1)


def reflection(scan: Scan, overlap: float = 1.0) -> np.ndarray:
    """First gates in which the velocity does not depend on direction, (gates,) or (lines, gates).

    They hold the reflection of the outgoing pulse, not air. Found in scans that look round at less
    than 80 degrees of elevation and that see wind behind it.
    """
    velocity = scan.fields["radial_velocity"]
    none = np.zeros(scan.range.shape, bool)
    slanted = np.abs(scan.angles["elevation"]) < 80
    azimuth = np.unique(np.round(scan.angles["azimuth"][slanted]))
    gaps = np.diff(azimuth, append=azimuth[:1] + 360)
    if scan.range.ndim > 1 or azimuth.size < 4 or gaps.max() > 120:
        return none
    most = math.ceil(_LONGEST_PULSES * overlap)
    spread = np.nanstd(velocity[slanted][:, : 2 * most], axis=0)
    same = spread < _SAME_SPEED
    count = int(np.argmin(same)) if not same.all() else 0
    behind = spread[count + math.ceil(overlap) : count + 3 * math.ceil(overlap)]
    if not (0 < count <= most and behind.size and np.nanmedian(behind) > 5 * _SAME_SPEED):
        return none
    # the gates in which reflection and air mix
    count += math.ceil(overlap / 2)
    none[:count] = True
    scan.remarks.append(
        f"the first {count} gates, to {scan.range[count - 1]:g} m, measure the same velocity in "
        "all directions, the reflection of the pulse: flagged as blind"
    )
    return none


def hard_targets(scan: Scan, snr: np.ndarray, bad: np.ndarray, overlap: float = 1.0) -> np.ndarray:
    """Gates (lines, gates) with a target at rest, those that its pulse fills, and all behind it.

    A target is at most at `HARD_TARGET_ELEVATION`, returns `HARD_TARGET_DB` more than the gates
    before it and moves by less than `HARD_TARGET_SPEED`.
    """
    velocity = scan.fields["radial_velocity"]
    blocked = np.zeros(snr.shape, bool)
    low = np.abs(scan.angles["elevation"]) <= HARD_TARGET_ELEVATION
    if not low.any() or snr.shape[1] <= 2 * _GATES_BEFORE:
        return blocked
    width = math.ceil(overlap)
    usable = np.where(bad, np.nan, snr)
    for line in np.flatnonzero(low):
        bright = 10 ** (HARD_TARGET_DB / 10) * _median_before(usable[line], width)
        at_rest = np.abs(velocity[line]) < HARD_TARGET_SPEED
        (gates,) = np.nonzero(at_rest & (usable[line] > bright))
        if gates.size:
            blocked[line, max(gates[0] - width, 0) :] = True
    return blocked


def _median_before(snr: np.ndarray, width: int) -> np.ndarray:
    """Median of the gates before each, (gates,), but its direct neighbours; NaN: too few."""
    reach = _GATES_BEFORE * width
    padded = np.concatenate([np.full(reach + width, np.nan), snr])
    windows = np.lib.stride_tricks.sliding_window_view(padded, reach)[: snr.size]
    enough = np.isfinite(windows).sum(1) >= min(3, _GATES_BEFORE)
    median = np.full(snr.size, np.nan)
    median[enough] = np.nanmedian(windows[enough], axis=1)
    return median
