"""Light in the images of a Doppler lidar, and limits of the velocities from them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from lidar_mi.assessment.metrics.names import bound_key, reference_key


@dataclass(frozen=True)
class RingBudget:
    """Light, line and etalon of a Doppler lidar, and limits of its velocities.

    photons, background_photons, signal: of a pulse on the whole image: of the laser, of the sun;
        photoelectrons of the laser's.
    line_width, free_spectral_range: Hz.
    velocity_range: unambiguous range of line-of-sight velocities, m s^-1.
    speckle_modes: degrees of freedom of the speckle in a pixel; inf: no speckle.
    bound (mapping of str to (float, float)): Cramer-Rao bounds of the standard deviation of one
        image's velocity and of that of its frame of the laser, m s^-1, by whether the centre is
        "free" or "known"; of averages by the roots of their numbers.
    relative_error: Monte Carlo standard error of a rendered image's pixel over its signal, median.
    largest_error: of velocities retrieved from the rendered images without noise, m s^-1.
    reference_every: pulses from one frame of the laser to the next.
    reference_errors: standard errors that no image shows, m s^-1, by cause; of drifts those of a
        single pulse.
    scrambling_needed: fraction of the light to be scrambled for an error of 0.5 m/s by plates and
        pupil.
    """

    photons: float
    background_photons: float
    signal: float
    line_width: float
    free_spectral_range: float
    finesse: float
    velocity_range: float
    speckle_modes: float
    bound: Mapping[str, tuple[float, float]]
    relative_error: float
    largest_error: float
    reference_every: int
    reference_errors: Mapping[str, float]
    scrambling_needed: float


def ring_budget_metrics(budget: RingBudget, averaged: tuple[int, ...]) -> dict[str, float]:
    """Flat, ``doppler.photons`` and so on; bounds of averages of so many images."""
    metrics = {
        f"doppler.{name}": getattr(budget, name)
        for name in (
            "photons",
            "background_photons",
            "signal",
            "line_width",
            "free_spectral_range",
            "finesse",
            "velocity_range",
        )
    }
    if math.isfinite(budget.speckle_modes):
        metrics["doppler.speckle_modes"] = budget.speckle_modes
    metrics["doppler.render.mc_relative_error"] = budget.relative_error
    metrics["doppler.render.largest_error"] = budget.largest_error
    for centre, (air, laser) in budget.bound.items():
        for number in averaged:
            # an average shorter than the interval has one frame of the laser
            frames = max(1, number // budget.reference_every)
            # speeds are differences: the variance of their zero adds
            std = math.hypot(air / math.sqrt(number), laser / math.sqrt(frames))
            metrics[bound_key(centre, number)] = std
    for cause, error in budget.reference_errors.items():
        metrics[reference_key(cause)] = error
    metrics["doppler.reference.scrambling_needed"] = budget.scrambling_needed
    return metrics
