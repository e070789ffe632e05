"""One instrument from frames of several lines: its gap, and all that does not depend on the line.

Every line is calibrated for itself; the estimates are then combined with their covariances, which
to first order is the fit of all frames together. The geometry is common to all lines. Each has its
own fractional order, illumination, and finesse (mirrors and plates in units of its wavelength); the
fractions give the gap by the method of exact fractions, see `lidar_mi.retrieval.rings.gap`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.constants import speed_of_light
from scipy.stats import chi2

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.calibration import Calibration
from lidar_mi.retrieval.rings.calibration_fit import TOLERANCES
from lidar_mi.retrieval.rings.gap import gap_of_covariance
from lidar_mi.retrieval.rings.model import INSTRUMENT

CHROMATIC = ("focal_length", "blur")
"""Parameters that differ from line to line of a lens that is not achromatic."""
_GEOMETRY = ("focal_length", "tilt_x", "tilt_y", "distortion", "blur")
_DETERMINED = 0.1  # of the tolerance: the prior is then 1 % of the information
_UNLIKELY = 1e-6  # probability below which lines have different instruments


def combined(
    lines: Sequence[Calibration],
    gap: float,
    gap_tolerance: float,
    *,
    mirror_orders: Sequence[float],
    wavelength_accuracy: float = 1e-8,
    achromatic: bool = True,
    tolerances: Mapping[str, float] = TOLERANCES,
) -> Calibration:
    """The instrument of the first line, with its gap, from all lines.

    lines: two or more, all for the same nominal gap.
    gap, gap_tolerance: the nominal gap times its refractive index, and its largest error, m.
    mirror_orders: of every line, by which the mirrors' phase shifts its orders.
    wavelength_accuracy: relative standard error of every wavelength.
    achromatic: whether the lines share focal length and blur, too.
    tolerances: those of the calibrations.

    Raises InputError: a line whose rings are those of another instrument or wavelength, fractions
    that agree with no gap in range.

    Returns
    -------
    Calibration
        With the absolute order and its ``whole_orders``, or, where several ``gaps`` agree, with the
        nominal whole number.
    """
    if not (math.isfinite(wavelength_accuracy) and 0 <= wavelength_accuracy <= 1e-5):
        raise InputError(
            f"wavelength_accuracy: {wavelength_accuracy:g} is not allowed; expected 0 to 1e-05"
        )
    if not 0 < gap_tolerance <= 0.01 * gap:
        raise InputError(
            f"gap_tolerance: {gap_tolerance:g} m is not allowed; expected above 0, at most 1 % of "
            f"the gap, {0.01 * gap:.3g} m"
        )
    shared = [n for n in _GEOMETRY if achromatic or n not in CHROMATIC]
    parts = [_geometry(line, shared, tolerances) for line in lines]
    for line, part in zip(lines[1:], parts[1:], strict=True):
        _check_same(lines[0], line, parts[0], part, achromatic)
    information = parts[0].information + sum(p.determined for p in parts[1:])
    covariance = np.linalg.inv(information)
    # as departures from the first line, so that no digits are lost
    step = covariance @ sum(p.determined @ (p.value - parts[0].value) for p in parts[1:])
    common = parts[0].value + step
    slopes, independent, fraction = [], [], []
    for line, part, shift in zip(lines, parts, mirror_orders, strict=True):
        by = line.systematic[0, part.places] @ part.information  # m/s per unit
        per_order = _per_order(line)
        moved = by @ (common - part.value) / per_order
        slopes.append(by / per_order)
        independent.append(
            (line.systematic[0, 0] - by @ line.systematic[part.places, 0]) / per_order**2
        )
        fraction.append((line.order_at_centre + moved - shift) % 1)
    errors = np.diag(independent) + np.array(slopes) @ covariance @ np.array(slopes).T
    orders = np.array([line.order_at_centre for line in lines])
    errors += np.diag((wavelength_accuracy * orders) ** 2)
    wavelengths = [line.wavelength for line in lines]
    common_gap = gap_of_covariance(fraction, errors, wavelengths, gap, gap_tolerance)
    first = _moved(lines[0], parts[0], step, covariance)
    groups = tuple(zip(common_gap.group.tolist(), common_gap.group_std.tolist(), strict=True))
    first = replace(first, lines=tuple(wavelengths), gaps=groups)
    if len(groups) > 1:
        return first
    best = int(common_gap.chi_square.argmin())
    order = float(common_gap.order[best, 0] + fraction[0] + mirror_orders[0])
    return replace(
        first,
        whole_orders=tuple(sorted(set(common_gap.order[:, 0].tolist()))),
        focal_length=first.focal_length * math.sqrt(order / first.order_at_centre),
        order_at_centre=order,
    )


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Estimate from one line of the shared part of the instrument.

    ``information`` is the inverse of its covariance, ``determined`` that of its frames without the
    prior, as all lines share the prior.
    """

    places: list[int]  # in `Calibration.systematic`
    value: np.ndarray
    information: np.ndarray
    determined: np.ndarray
    known: np.ndarray


def _geometry(
    line: Calibration, shared: Sequence[str], tolerances: Mapping[str, float]
) -> _Geometry:
    value = {
        "focal_length": math.log(line.focal_length),
        "tilt_x": line.tilt[0],
        "tilt_y": line.tilt[1],
        "distortion": line.distortion,
        "blur": line.blur,
    }
    places = [1 + INSTRUMENT.index(name) for name in shared]
    covariance = line.systematic[np.ix_(places, places)]
    known = np.array([line.std[name] < _DETERMINED * tolerances[name] for name in shared])
    index = np.ix_(known, known)
    determined = np.zeros_like(covariance)
    determined[index] = np.linalg.inv(covariance[index])
    return _Geometry(
        places,
        np.array([value[name] for name in shared]),
        np.linalg.inv(covariance),
        determined,
        known,
    )


def _check_same(
    first: Calibration, second: Calibration, part1: _Geometry, part2: _Geometry, achromatic: bool
) -> None:
    """Refuse lines whose rings are not of one instrument."""
    known = part1.known & part2.known
    if not known.any():
        return
    index = np.ix_(known, known)
    off = (part2.value - part1.value)[known]
    noise = np.linalg.inv(part1.information)[index] + np.linalg.inv(part2.information)[index]
    misfit = float(off @ np.linalg.solve(noise, off))
    if chi2.sf(misfit, known.sum()) > _UNLIKELY:
        return
    wider = second.focal_length / first.focal_length - 1
    cause = "or a lens that is not achromatic" if achromatic else "or one camera for both"
    raise InputError(
        f"line of {1e9 * second.wavelength:.7g} nm: its rings, wider by {wider:+.2g} than those of "
        f"{1e9 * first.wavelength:.7g} nm allow, are not of the same instrument; expected the "
        f"line's true wavelength, {cause}"
    )


def _per_order(line: Calibration) -> float:
    """Speed that moves rings by one order, m/s."""
    return speed_of_light / (2 * line.order_at_centre)


def _moved(
    line: Calibration, part: _Geometry, step: np.ndarray, covariance: np.ndarray
) -> Calibration:
    """A calibration after a step of its shared part and of the parameters correlated with it."""
    gain = line.systematic[:, part.places] @ part.information
    change = dict(zip(("v_los", *INSTRUMENT), gain @ step, strict=True))
    systematic = line.systematic - gain @ (np.linalg.inv(part.information) - covariance) @ gain.T
    std = dict(zip(INSTRUMENT, np.sqrt(np.diag(systematic))[1:].tolist(), strict=True))
    return replace(
        line,
        focal_length=line.focal_length * math.exp(change["focal_length"]),
        order_at_centre=line.order_at_centre + change["v_los"] / _per_order(line),
        tilt=(line.tilt[0] + change["tilt_x"], line.tilt[1] + change["tilt_y"]),
        distortion=line.distortion + change["distortion"],
        blur=line.blur + change["blur"],
        damping=line.damping + change["damping"],
        roughness=line.roughness + change["roughness"],
        std={**line.std, **std},
        systematic=systematic,
    )
