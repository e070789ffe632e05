"""What light an experiment's backscatter lidar can expect, by the lidar equation."""

import math
from typing import NamedTuple

import numpy as np

from lidar_mi.experiment.stages.brightness import overlap
from lidar_mi.experiment.truth.clear_air import ClearAir, are_particles
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.instrument.detector import Detector, gate_duration
from lidar_mi.instrument.detector_noise import expected_counts, noise_variance
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.rendering.phase import Scatterer, backscatter_phase_function
from lidar_mi.schema.scattering import Scattering
from lidar_mi.schema.wake import ExtinctionMapping, Wake

LEAST_OVERLAP = 0.9
"""Of the field of view and the beam; with less, a warning states the light that is lost."""


class LightBudget(NamedTuple):
    """The median pixel of the first gate of the first image.

    overlap: fraction of the light from there that arrives within the field of view.
    transmittance: of the environment, to the gate and back.
    lidar_ratio: extinction over backscatter coefficient of slab and environment without the
        molecular part, sr.
    s0: received energy over emitted pulse energy, of single scattering.
    photoelectrons, noise: of a pulse, and the relative standard deviation of the signal of all
        pulses of a beam; None without a detector.
    """

    overlap: float
    transmittance: float
    lidar_ratio: float
    s0: float
    photoelectrons: float | None
    noise: float | None


class BackscatterFractions(NamedTuple):
    """Fractions of the backscatter of the first gate, mean over the first image; their sum is 1.

    molecules: of clear air.
    background: of the scatterers with the extinction ``wake.extinction.background``.
    exhaust: of what is added to it: by the wake's tracer, or by its speed.
    """

    molecules: float
    background: float
    exhaust: float


def backscatter_fractions(
    wake_extinction: ExtinctionMapping, truth: Truth, air: Scatterer, clear_air: ClearAir
) -> BackscatterFractions:
    """What scatters back, by the coefficients of the air alone: without attenuation."""
    particles = float(truth.image(0, smooth=True).mean()) - truth.molecules
    background = min(wake_extinction.background, particles)
    if particles - background < 1e-9 * particles:  # rounding of a mean
        background = particles
    per_extinction = air.albedo * backscatter_phase_function(air)
    parts = [
        clear_air.backscatter,
        per_extinction * background,
        per_extinction * (particles - background),
    ]
    total = sum(parts)
    return BackscatterFractions(*(part / total for part in parts))


def fractions_in_words(fractions: BackscatterFractions, scattering: Scattering) -> str:
    """The fractions in per cent, without those that are 0."""
    names = ("molecules", "aerosol" if are_particles(scattering) else "background", "exhaust")
    return ", ".join(
        f"{name} {fraction:.1%}" if fraction < 0.01 else f"{name} {fraction:.0%}"
        for name, fraction in zip(names, fractions, strict=True)
        if fraction > 0
    )


def light_budget(
    wake: Wake,
    scan: Scan,
    lidar: BackscatterLidar,
    detector: Detector | None,
    truth: Truth,
    plan: ScanPlan,
    air: Scatterer,
    clear_air: ClearAir,
) -> LightBudget:
    """Light and noise of the median pixel.

    Single scattering of air whose extinction is that of the truth's median; attenuation within the
    slab is neglected. Accurate to some per cent where the air is optically thin; multiple
    scattering adds to it.
    """
    mapping = wake.extinction
    distance = float(np.median(plan.ranges()[0]))
    length = float(np.median(plan.gate_length()))
    extinction = float(np.median(truth.extinction[0].values))
    in_view = overlap(lidar, distance)
    passing = math.exp(-2 * min((mapping.background + truth.molecules) * distance, 300))
    per_extinction = air.albedo * backscatter_phase_function(air)
    backscatter = per_extinction * (extinction - clear_air.extinction) + clear_air.backscatter
    s0 = in_view * passing * lidar.aperture_area / distance**2 * backscatter * length
    counted = spread = None
    if detector:
        duration, pulses = gate_duration(length), scan.pulses_per_beam
        means = expected_counts(np.array(s0), lidar, detector, duration, distance, 1.0, pulses)
        variance, summed = noise_variance(*means, detector, pulses), float(means[0])
        counted = summed / pulses
        spread = math.sqrt(float(variance)) / summed if summed > 0 else math.inf
    return LightBudget(in_view, passing, 1 / per_extinction, s0, counted, spread)
