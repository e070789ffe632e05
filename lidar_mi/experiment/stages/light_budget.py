"""What light an experiment's backscatter lidar can expect, by the lidar equation."""

import math
from typing import NamedTuple

import numpy as np

from lidar_mi.experiment.schema.wake import Wake
from lidar_mi.experiment.stages.brightness import overlap
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.instrument.detector import Detector, gate_duration
from lidar_mi.instrument.detector_noise import expected_counts, noise_variance
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.rendering.phase import Scatterer, backscatter_phase_function

LEAST_OVERLAP = 0.9
"""Of the field of view and the beam; with less, a warning states the light that is lost."""


class LightBudget(NamedTuple):
    """The median pixel of the first gate of the first image.

    Attributes
    ----------
    overlap : float
        Fraction of the light from there that arrives within the field of view.
    transmittance : float
        Of the environment, to the gate and back.
    lidar_ratio : float
        Extinction over backscatter coefficient of slab and environment without the molecular part,
        sr.
    s0 : float
        Received energy over emitted pulse energy, of single scattering.
    photoelectrons, noise : float or None
        Of a pulse, and the relative standard deviation of the signal of all pulses of a beam; None
        without a detector.
    """

    overlap: float
    transmittance: float
    lidar_ratio: float
    s0: float
    photoelectrons: float | None
    noise: float | None


def light_budget(
    wake: Wake,
    scan: Scan,
    lidar: BackscatterLidar,
    detector: Detector | None,
    truth: Truth,
    plan: ScanPlan,
    air: Scatterer,
) -> LightBudget:
    """Light and noise of the median pixel.

    Single scattering of air whose extinction is that of the truth's median; attenuation within the
    slab and the molecular part's own phase function are neglected. Accurate to some per cent where
    the air is optically thin; multiple scattering adds to it.
    """
    mapping = wake.extinction
    distance = float(np.median(plan.ranges()[0]))
    length = float(np.median(plan.gate_length()))
    extinction = float(np.median(truth.extinction[0].values))
    in_view = overlap(lidar, distance)
    passing = math.exp(-2 * min((mapping.background + mapping.molecules) * distance, 300))
    backscatter = air.albedo * backscatter_phase_function(air)
    s0 = in_view * passing * lidar.aperture_area / distance**2 * backscatter * extinction * length
    counted = spread = None
    if detector:
        duration, pulses = gate_duration(length), scan.pulses_per_beam
        means = expected_counts(np.array(s0), lidar, detector, duration, distance, 1.0, pulses)
        variance, summed = noise_variance(*means, detector, pulses), float(means[0])
        counted = summed / pulses
        spread = math.sqrt(float(variance)) / summed if summed > 0 else math.inf
    return LightBudget(in_view, passing, 1 / backscatter, s0, counted, spread)
