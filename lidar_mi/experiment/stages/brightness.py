"""Whether images will have light, before they are rendered."""

import math

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.experiment.memory import most_samples
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.schema.wake import ExtinctionMapping
from lidar_mi.units import shown

SINGLE = 1e-17
"""S0 whose squared error is the smallest number of single precision."""
CONTRIBUTIONS = 5
"""Contributing samples required per pixel, on average: 0.7 % of all pixels then have none."""


def check_brightness(
    lidar: BackscatterLidar,
    render: RenderSettings,
    detector: Detector | None,
    mapping: ExtinctionMapping,
    truth: Truth,
    plan: ScanPlan,
    albedo: float,
) -> None:
    """Refuse images whose pixels would mostly be dark, by the lidar equation of the median pixel.

    Raises InputError: too few samples contribute: free flights that end elsewhere, or a field of
    view that contains hardly any of the beam; or light too weak for its error in single precision.
    """
    inside = float(np.median(truth.extinction[0].values))
    if not inside > 0:
        raise InputError(
            "wake.extinction.background: 0 is not allowed with a wake that fills less than half "
            "of the image; expected more, so that pixels have light and errors"
        )
    length, distance = float(np.median(plan.gate_length())), float(np.median(plan.ranges()[0]))
    around = mapping.background + truth.molecules
    arriving = math.exp(-min(around * plan.gate_start, 300))
    light = lidar.aperture_area / distance**2 * albedo * inside * length / (4 * math.pi)
    if light * arriving**2 < SINGLE:
        raise InputError(
            f"wake.extinction: {around:g} 1/m on the way to {inside:g} 1/m of albedo {albedo:g} at "
            f"{distance:g} m is not allowed; expected that at least {SINGLE:g} of the light comes "
            f"back, not {light * arriving**2:.1g}"
        )
    beams = len(plan.y) * len(plan.z)
    samples = most_samples(render, detector, beams, plan.gate_count)
    least = least_samples(lidar, render, mapping, truth, plan)
    if samples < least:
        key, value = "lidar.fov_half", shown(lidar.fov_half, "mrad")
        if render.estimator == "analog":
            key, value = "render.estimator", "analog"
        chosen = render.samples_per_beam == "auto" and detector
        asked, needed = ("max_samples", least * beams) if chosen else ("samples_per_beam", least)
        raise InputError(
            f"{key}: {value} is not allowed with {samples} samples per beam, of "
            f"which {CONTRIBUTIONS * samples / least:.2g} would bring light to a pixel; expected "
            f"render.{asked} of {needed:.3g} or more"
        )


def least_samples(
    lidar: BackscatterLidar,
    render: RenderSettings,
    mapping: ExtinctionMapping,
    truth: Truth,
    plan: ScanPlan,
) -> int:
    """Samples per beam of which `CONTRIBUTIONS` bring light to a pixel of the median extinction.

    2 where nearly all do.
    """
    distance = float(np.median(plan.ranges()[0]))
    in_view = overlap(lidar, distance)
    if render.estimator == "analog":
        # samples contribute if they collide in the gate
        inside = float(np.median(truth.extinction[0].values))
        around = mapping.background + truth.molecules
        arriving = math.exp(-min(around * plan.gate_start, 300))
        fraction = in_view * inside * float(np.median(plan.gate_length())) * arriving
    else:
        fraction = in_view / plan.gate_count
        if in_view >= 0.9:
            return 2
    # their number is counted in 31 bits
    return math.ceil(min(CONTRIBUTIONS / max(fraction, 1e-300), 2.0**31))


def overlap(lidar: BackscatterLidar, distance: float) -> float:
    """Fraction of the light from a distance (m) that arrives within the field of view.

    Mean over the beam's Gaussian cross-section and the telescope's disc, which are concentric: a
    point at r from the axis is in view of points of the disc within ``fov_half`` times the
    distance.
    """
    field_radius = math.tan(lidar.fov_half) * distance
    sigma = float(lidar.radius_at(distance)) / 2
    # of a Gaussian in the plane, the fraction beyond r is exp(-r^2 / 2 sigma^2): its quantiles
    beyond = (np.arange(1000) + 0.5) / 1000
    gap = sigma * np.sqrt(-2 * np.log(beyond))
    area = math.pi * lidar.aperture_radius**2
    return float(_lens(gap, field_radius, lidar.aperture_radius).mean() / area)


def _lens(gap: np.ndarray, first: float, second: float) -> np.ndarray:
    """Area of the overlap of two circles of given radii, with ``gap`` between their centres."""
    small, large = min(first, second), max(first, second)
    # the formula is that of circles that cut each other; the others are replaced below
    separation = np.clip(gap, large - small + 1e-12 * large, large + small)
    # angles at both centres to where the circles meet
    at_small = (separation**2 + small**2 - large**2) / (2 * separation * small)
    at_large = (separation**2 + large**2 - small**2) / (2 * separation * large)
    at_small, at_large = (np.arccos(np.clip(c, -1, 1)) for c in (at_small, at_large))
    area = small**2 * (at_small - np.sin(2 * at_small) / 2)
    area = area + large**2 * (at_large - np.sin(2 * at_large) / 2)
    area = np.where(gap <= large - small, math.pi * small**2, area)
    return np.where(gap >= large + small, 0.0, area)
