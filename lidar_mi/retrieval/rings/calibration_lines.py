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
    """The instrument of the first line, with its gap and what the other lines say of it.

    Parameters
    ----------
    lines : sequence of Calibration
        Two or more, all for the same nominal gap.
    gap, gap_tolerance : float
        The nominal gap times its refractive index, and what it may differ by, m.
    mirror_orders : sequence of float
        Of every line, by which the mirrors' phase shifts its orders.
    wavelength_accuracy : float
        Relative standard error of every wavelength.
    achromatic : bool
        Whether the lines share focal length and blur, too.
    tolerances : mapping
        Those of the calibrations.

    Returns
    -------
    Calibration
        With the absolute order and its ``whole_orders``, or, where several ``gaps`` agree, with the
        nominal whole number.

    Raises
    ------
    InputError
        A line whose rings are those of another instrument or wavelength, fractions that agree with
        no gap in range.
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
    parts = [_geometry(one, shared, tolerances) for one in lines]
    for one, part in zip(lines[1:], parts[1:], strict=True):
        _check_same(lines[0], one, parts[0], part, achromatic)
    information = parts[0].information + sum(p.determined for p in parts[1:])
    covariance = np.linalg.inv(information)
    # of departures from the first line's, so that numbers of different size cause no loss
    step = covariance @ sum(p.determined @ (p.value - parts[0].value) for p in parts[1:])
    common = parts[0].value + step
    slopes, own, fraction = [], [], []
    for one, part, shift in zip(lines, parts, mirror_orders, strict=True):
        by = one.systematic[0, part.places] @ part.information  # m/s per unit
        per_order = _per_order(one)
        moved = by @ (common - part.value) / per_order
        slopes.append(by / per_order)
        own.append((one.systematic[0, 0] - by @ one.systematic[part.places, 0]) / per_order**2)
        fraction.append((one.order_at_centre + moved - shift) % 1)
    errors = np.diag(own) + np.array(slopes) @ covariance @ np.array(slopes).T
    orders = np.array([one.order_at_centre for one in lines])
    errors += np.diag((wavelength_accuracy * orders) ** 2)
    wavelengths = [one.wavelength for one in lines]
    found = gap_of_covariance(fraction, errors, wavelengths, gap, gap_tolerance)
    first = _moved(lines[0], parts[0], step, covariance)
    groups = tuple(zip(found.group.tolist(), found.group_std.tolist(), strict=True))
    first = replace(first, lines=tuple(wavelengths), gaps=groups)
    if len(groups) > 1:
        return first
    best = int(found.chi_square.argmin())
    order = float(found.order[best, 0] + fraction[0] + mirror_orders[0])
    return replace(
        first,
        whole_orders=tuple(sorted(set(found.order[:, 0].tolist()))),
        focal_length=first.focal_length * math.sqrt(order / first.order_at_centre),
        order_at_centre=order,
    )


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Estimate from one line of the shared part of the instrument.

    ``information`` is the inverse of its covariance, ``determined`` that of its
    frames without the prior, which all lines have in common.
    """

    places: list[int]  # in `Calibration.systematic`
    value: np.ndarray
    information: np.ndarray
    determined: np.ndarray
    known: np.ndarray


def _geometry(
    one: Calibration, shared: Sequence[str], tolerances: Mapping[str, float]
) -> _Geometry:
    value = {
        "focal_length": math.log(one.focal_length),
        "tilt_x": one.tilt[0],
        "tilt_y": one.tilt[1],
        "distortion": one.distortion,
        "blur": one.blur,
    }
    places = [1 + INSTRUMENT.index(name) for name in shared]
    covariance = one.systematic[np.ix_(places, places)]
    known = np.array([one.std[name] < _DETERMINED * tolerances[name] for name in shared])
    both = np.ix_(known, known)
    determined = np.zeros_like(covariance)
    determined[both] = np.linalg.inv(covariance[both])
    return _Geometry(
        places,
        np.array([value[name] for name in shared]),
        np.linalg.inv(covariance),
        determined,
        known,
    )


def _check_same(
    first: Calibration, other: Calibration, one: _Geometry, two: _Geometry, achromatic: bool
) -> None:
    """Refuse lines whose rings are not of one instrument."""
    known = one.known & two.known
    if not known.any():
        return
    both = np.ix_(known, known)
    off = (two.value - one.value)[known]
    noise = np.linalg.inv(one.information)[both] + np.linalg.inv(two.information)[both]
    misfit = float(off @ np.linalg.solve(noise, off))
    if chi2.sf(misfit, known.sum()) > _UNLIKELY:
        return
    wider = other.focal_length / first.focal_length - 1
    cause = "or a lens that is not achromatic" if achromatic else "or one camera for both"
    raise InputError(
        f"line of {1e9 * other.wavelength:.7g} nm: its rings, wider by {wider:+.2g} than those of "
        f"{1e9 * first.wavelength:.7g} nm allow, are not of the same instrument; expected the "
        f"line's true wavelength, {cause}"
    )


def _per_order(one: Calibration) -> float:
    """Speed that moves rings by one order, m/s."""
    return speed_of_light / (2 * one.order_at_centre)


def _moved(
    one: Calibration, part: _Geometry, step: np.ndarray, covariance: np.ndarray
) -> Calibration:
    """A calibration after its shared part is moved by a step, with what is correlated to that."""
    gain = one.systematic[:, part.places] @ part.information
    change = dict(zip(("v_los", *INSTRUMENT), gain @ step, strict=True))
    systematic = one.systematic - gain @ (np.linalg.inv(part.information) - covariance) @ gain.T
    std = dict(zip(INSTRUMENT, np.sqrt(np.diag(systematic))[1:].tolist(), strict=True))
    return replace(
        one,
        focal_length=one.focal_length * math.exp(change["focal_length"]),
        order_at_centre=one.order_at_centre + change["v_los"] / _per_order(one),
        tilt=(one.tilt[0] + change["tilt_x"], one.tilt[1] + change["tilt_y"]),
        distortion=one.distortion + change["distortion"],
        blur=one.blur + change["blur"],
        damping=one.damping + change["damping"],
        roughness=one.roughness + change["roughness"],
        std={**one.std, **std},
        systematic=systematic,
    )
