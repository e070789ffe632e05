"""Warnings before images are rendered: of what is allowed and likely wrong."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.flow_checks import MOST_DIVERGENCE, relative_divergence, rises
from lidar_mi.atmosphere.vortices.cores import find_cores
from lidar_mi.description import Description
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.brightness import overlap
from lidar_mi.experiment.stages.light_budget import (
    LEAST_OVERLAP,
    backscatter_fractions,
    fractions_in_words,
)
from lidar_mi.experiment.truth.clear_air import ClearAir
from lidar_mi.experiment.truth.extinction import ObservedAir, Truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.rendering.phase import Scatterer
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.retrieval import Retrieval
from lidar_mi.schema.scattering import Scattering
from lidar_mi.schema.site import Site
from lidar_mi.schema.wake import ExtinctionMapping, Wake
from lidar_mi.units import shown

MOST_WIND = 150.0
"""Winds across the path, m/s, beyond those of wakes: of a heavy aircraft's cores some 50 m/s."""


def image_remarks(
    observed: ObservedAir,
    lidar: BackscatterLidar,
    retrieval: Retrieval,
    scattering: Scattering,
    air: Scatterer,
    clear_air: ClearAir,
    site: Site,
) -> list[str]:
    """Warnings of an experiment with a wake, a line each."""
    observation, truth, plan = observed.observation, observed.truth, observed.plans[0]
    wake = observation.wake
    flow = _of_the_flow(wake, truth.wind) if wake.file else []
    interpolated = observed.flows[0].attrs.get("interpolated")
    grid = [f"wake.file: {interpolated}"] if interpolated else []
    return [
        *grid,
        *flow,
        *_of_the_speed(observation, retrieval, truth.wind, plan),
        *_of_the_light(lidar, observation.scan, plan),
        *_of_the_pattern(observation.scan),
        *_of_the_molecules(wake.extinction, truth, scattering, air, clear_air, site),
    ]


def first_set(sections: Mapping[str, Description], *keys: str) -> str:
    """The first of some dotted keys that an experiment sets itself; the last, if it sets none."""
    for key in keys:
        name, _, rest = key.partition(".")
        if rest and name in sections and _is_set(sections[name], rest):
            return key
    return keys[-1]


def _is_set(section: Any, key: str) -> bool:
    first, _, rest = key.partition(".")
    if section is None or first not in section.model_fields_set:
        return False
    return not rest or _is_set(getattr(section, first), rest)


def _of_the_flow(wake: Wake, wind: xr.Dataset) -> list[str]:
    """Components or axes of the wrong sign in a user's file; analytic flows have none."""
    key = first_set({"wake": wake}, "wake.names", "wake.file")
    divergence = relative_divergence(wind)
    if divergence > MOST_DIVERGENCE:
        return [
            f"{key}: the divergence of v, w has {divergence:.2g} of the vorticity's rms, as "
            "if a component or an axis had the wrong sign; expected y to port, z up, v along y, w "
            "along z (a minus sign changes one: names: {v: -V})"
        ]
    if rises(find_cores(wind)):
        return [
            f"{key}: both vortices turn against the lift of an aircraft, and the pair rises; "
            "expected the port vortex (y > 0) to turn from +y towards +z (where z points "
            "down: names: {z: -Z, w: -W})"
        ]
    return []


def _of_the_speed(
    observation: Observation, retrieval: Retrieval, wind: xr.Dataset, plan: ScanPlan
) -> list[str]:
    """Winds that no wake has, or that windows of this size cannot follow."""
    wake, platform = observation.wake, observation.platform
    fastest = max(float(np.abs(wind[name]).max()) for name in ("v", "w"))
    if fastest > MOST_WIND:
        doubt = "is the unit of v and w in the file right (attribute units)"
        if not wake.file:
            doubt = "are circulation and core radius right"
        return [
            f"wake: winds across the path reach {fastest:.3g} m/s; those of wakes of aircraft and "
            f"turbines stay below {MOST_WIND:g} m/s: {doubt}?"
        ]
    reach = window_reach(retrieval, platform, plan)
    taken = () if observation.volume else retrieval.methods
    methods = [method for method in (ImageMethod.CC, ImageMethod.WS) if method in taken]
    if not methods or fastest <= reach:
        return []
    sections = {"retrieval": retrieval, "platform": platform}
    key = first_set(sections, "retrieval.search", "retrieval.template", "platform.dt", "wake")
    return [
        f"{key}: windows of {' and '.join(methods)} follow {reach:.3g} m/s, the wind "
        f"reaches {fastest:.3g} m/s; expected a larger retrieval.search or a smaller platform.dt"
    ]


def window_reach(retrieval: Retrieval, platform: Platform, plan: ScanPlan) -> float:
    """Fastest wind that a window's search region holds, m/s; NaN for a single column of beams."""
    pixel = float(plan.y[1] - plan.y[0]) if plan.y.size > 1 else float("nan")
    return ((retrieval.search - retrieval.template) // 2 - 0.5) * pixel / platform.dt


def _of_the_light(lidar: BackscatterLidar, scan: Scan, plan: ScanPlan) -> list[str]:
    """Light that the telescope does not see."""
    in_view = overlap(lidar, float(np.median(plan.ranges()[0])))
    if in_view >= LEAST_OVERLAP:
        return []
    key = first_set({"lidar": lidar, "scan": scan}, "lidar.fov_half", "scan.range")
    half = "" if key == "lidar.fov_half" else "a field of view (half angle) of "
    return [
        f"{key}: {half}{shown(lidar.fov_half, 'mrad')} sees {in_view:.0%} of "
        f"the light from {plan.centre:.0f} m (overlap of beam, telescope and field of view)"
    ]


def _of_the_molecules(
    mapping: ExtinctionMapping,
    truth: Truth,
    scattering: Scattering,
    air: Scatterer,
    clear_air: ClearAir,
    site: Site,
) -> list[str]:
    """Molecules that a file does not ask for, neither by itself nor by a site, or leaves out."""
    if mapping.molecules == 0 and site.model_fields_set:
        return [
            "site: the images have none of its air, as wake.extinction.molecules is 0; expected "
            "auto, by which molecules scatter"
        ]
    asked = "molecules" in mapping.model_fields_set or site.model_fields_set
    if asked or not clear_air.extinction:
        return []
    fractions = backscatter_fractions(mapping, truth, air, clear_air)
    return [
        "wake.extinction.molecules: not set, so those of the air (auto): backscatter by "
        f"{fractions_in_words(fractions, scattering)} "
        f"({clear_air.origin}); expected auto or 0"
    ]


def _of_the_pattern(scan: Scan) -> list[str]:
    """Beams along a curve, whose images are resampled."""
    timing = scan.timing
    if timing is None or timing.pattern in ("raster", "serpentine"):
        return []
    return [
        f"scan.timing.pattern: beams of {timing.pattern} are resampled to the nodes of the image; "
        "stated errors of flagged vectors do not hold, and whether those of the others do was not "
        "measured for every curve (docs/experiments/scan_patterns.md); rows, raster or serpentine, "
        "are not resampled"
    ]
