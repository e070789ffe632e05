"""Limits of the steps of a fit of a pair, and the conditions on which its result is accepted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy.stats import chi2 as chi_square

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.covariance import far_from_minimum
from lidar_mi.retrieval.vortices.model import PROFILES, Profile, core_turns
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.robust_fit import Solution

# Number of starting points that are fitted.
STARTS = 3
# A fit has converged when its squared step, in standard errors, is smaller.
TOLERANCE = 0.03

# Least circulation over its standard error and least correlation of the images of a valid fit.
_SIGNIFICANCE = 5.0
_MATCH = 0.5
# Largest core radius over the separation. Wider cores deform each other (Sipp, Jacquin & Cossu
# 2000, Phys. Fluids 12, 245-248), so that two circular ones are no model of them; and smoke that
# hides a vortex, as it is round like it, looks as if the core were wide.
_WIDEST = 0.3
# Chi-square of one more vortex that a pair in turbulence exceeds by chance in one of 1000 slabs, at
# 150 places.
_FURTHER = float(chi_square.isf(1e-3 / 150, 1))

Limits = Callable[[torch.Tensor, torch.Tensor], bool]
"""Whether a step from some parameters may be tried."""

NOT_TOLD = "the pair cannot be told from the wind around it"


def step_limits(y: np.ndarray, z: np.ndarray, profile: Profile, dt: float = 0.0) -> Limits:
    """Limits of a step: its size, and core radii between half a cell and half the region.

    Between two images, separated by ``dt``, no core rotates more than once: images do not determine
    the number of rotations, and following many of them takes minutes.
    """
    sides = float(y[-1] - y[0]), float(z[-1] - z[0])
    cell = max(sides[0] / (len(y) - 1), sides[1] / (len(z) - 1))
    smallest, largest = np.log(cell / 2), np.log(min(sides) / 2)

    def allowed(parameters: torch.Tensor, step: torch.Tensor) -> bool:
        reached = parameters + step
        # beyond these radii the data do not determine a core
        radii = reached[[1, 5]]
        near = step[[2, 3, 6, 7]].abs().max() <= 0.15 * min(sides)
        return bool(
            near
            and step[[1, 5]].abs().max() <= 1
            and radii.min() >= smallest
            and radii.max() <= largest
            and core_turns(reached, dt, profile) <= 1
        )

    return allowed


def within(limits: Limits, parameters: torch.Tensor, solution: Solution | None) -> Solution | None:
    """The solution if the limits allow the step to it; it may have further parameters behind."""
    if solution and limits(parameters, solution.parameters[: len(parameters)] - parameters):
        return solution
    return None


def no_fit(profile: Profile, reason: str) -> VortexPairFit:
    """A failed fit without numbers."""
    nothing = np.full(10, np.nan)
    return VortexPairFit(
        nothing, np.full((10, 10), np.nan), profile, np.nan, np.nan, np.nan, np.nan, (reason,)
    )


def with_reasons(
    pair: VortexPairFit, solution: Solution, y: np.ndarray, z: np.ndarray, further: float = 0.0
) -> VortexPairFit:
    """The fit with the reasons for which it is not accepted.

    solution: that it was made of.
    y, z: axes of the region, m.
    further: chi-square of one more vortex.
    """
    theta, covariance = pair.parameters, pair.covariance
    reasons = []
    if not solution.converged and far_from_minimum(solution, covariance):
        reasons.append("did not converge")
    if not pair.correlation >= _MATCH:
        reasons.append(f"correlation {pair.correlation:.2f}; expected at least {_MATCH:g}")
    if not (np.isfinite(covariance).all() and (np.diagonal(covariance) > 0).all()):
        reasons.append("some parameters are undetermined")
    spread = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    separation = float(np.hypot(*(theta[2:4] - theta[6:8])))
    for side, first in (("port", 0), ("starboard", 4)):
        circulation, log_radius, at_y, at_z = theta[first : first + 4]
        sign = 1 if side == "port" else -1
        if not sign * circulation > _SIGNIFICANCE * spread[first]:
            reasons.append(
                f"{side} circulation {circulation:.0f} +- {spread[first]:.0f} m2/s is not "
                f"significant (below {_SIGNIFICANCE:g} standard errors)"
            )
        if not (y[0] <= at_y <= y[-1] and z[0] <= at_z <= z[-1]):
            reasons.append(f"{side} vortex at ({at_y:.1f}, {at_z:.1f}) m is outside")
        radius = np.exp(log_radius)
        if not radius <= _WIDEST * separation:
            reasons.append(
                f"{side} core radius {radius:.1f} m; expected at most {_WIDEST:g} of the "
                f"separation of {separation:.1f} m"
            )
    if not further <= _FURTHER:
        reasons.append(
            f"there are more than two vortices (chi-square of one more {further:.0f}; expected at "
            f"most {_FURTHER:.0f})"
        )
    return replace(pair, reasons=tuple(reasons))


def check_profile(profile: str) -> None:
    """Raises InputError for an unknown profile."""
    if profile not in PROFILES:
        raise InputError(f"profile: {profile!r} is not one of {', '.join(PROFILES)}")
