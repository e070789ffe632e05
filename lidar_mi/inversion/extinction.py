"""Extinction along beams: the profile whose rendered signal makes the counts most probable."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.inversion.layers import Layers
from lidar_mi.inversion.scoring import Fit, Known, fit
from lidar_mi.rendering.backscatter import ScanRenderer
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.extinction.profile import numbers

MOST_ROUNDS = 24
NEAR, CONVERGED = 2.0, 0.1
"""Rms change of the logarithms between rounds, in standard errors: below the first, of noise alone,
rounds are averaged; the second ends them."""
_FEWER = 16
"""Of the samples in rounds that are not near yet."""
_NODES = 3
"""Of a layer: extinction is linear between them. With one or two a jump between layers is no
profile of the model; four change nothing."""


@dataclass(frozen=True)
class LayeredAir:
    """Air whose extinction changes along x alone, and is to be found.

    Attributes
    ----------
    x : (layers,) array
        Middles of the layers whose mean extinction is sought, m, equally spaced. Thinner ones than
        gates are known by the prior more than by the counts.
    phase : dict
        Mitsuba phase function, as `rendering.phase.ScatteringAir` has it.
    albedo : float
        Of single scattering.
    environment : float
        Extinction before and behind, m^-1, above 0.
    """

    def nodes(self) -> np.ndarray:
        """Where the extinction is described, m: the middles of equal parts of the layers."""
        step = self.x[1] - self.x[0]
        count = len(self.x) * _NODES
        return self.x[0] + step * ((np.arange(count) + 0.5) / _NODES - 0.5)

    x: np.ndarray
    phase: dict[str, Any]
    albedo: float = 1.0
    environment: float = 1e-6


class _Rendered(NamedTuple):
    """S0, its Monte Carlo variance, and S0 of single scattering, (gates, beams)."""

    signal: np.ndarray
    variance: np.ndarray
    single: np.ndarray


def invert_extinction(
    counts: ArrayLike,
    plan: ScanPlan,
    lidar: BackscatterLidar,
    air: LayeredAir,
    counts_per_signal: float,
    settings: RenderSettings,
    background: float = 0.0,
    calibration_error: float = 0.0,
    reference: tuple[float, float] | None = None,
    seed: int = 0,
    start: ArrayLike | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> xr.Dataset:
    """Extinction along beams from the counts of their gates, by inverting the renderer.

    The counts are Poisson numbers of the mean m = c S(s) + b with the signal S as rendered: all
    orders of scattering, overlap, width of beams. Fisher's scoring solves

        J^T V^-1 (n - m(s)) = P ln s

    for the profile s. The residual has the full model. The derivative J has that of single
    scattering, times the rendered ratio to it, with attenuation by a factor that the rendered
    orders give. J decides the path and the efficiency, not whether the solution is consistent: the
    left side has the mean 0 at the true profile whatever J is (Godambe 1960, Ann. Math. Statist.
    31, 1208). V has the counts' variance and the Monte Carlo variance of c S. P is a random walk's
    whose step comes from the counts by restricted maximum likelihood.

    Parameters
    ----------
    counts : (gates, rows, columns) array
        As detected, with background; rows and columns ascending in z and y.
    plan : ScanPlan
        With spherical gates.
    counts_per_signal : float
        Counts of all pulses per S0, see `instrument.detector.signal_photoelectrons`.
    settings : RenderSettings
        Samples per beam of a round, as a number; rounds are added until the Monte Carlo variance is
        ``monte_carlo_fraction`` of the counts'. ``max_order`` 1 inverts single scattering.
    background : float
        Mean counts of a gate without signal.
    calibration_error : float
        Relative standard error of ``counts_per_signal``.
    reference : (float, float), optional
        Extinction of the farthest layer, m^-1, and its relative standard error, as Klett's
        inversion needs it. Without it the error grows as exp(2 depth): at depths of 2 and more, or
        with an error of the calibration, stated errors hold with a reference alone.
    start : (layers,) array, optional
        Extinction to start with, m^-1, such as that of an inversion that was stopped.
    progress : callable, optional
        Called after every round with its number and the rms change in standard errors.

    Returns
    -------
    xr.Dataset
        Means of the layers: ``extinction``, ``extinction_stderr`` (m^-1, dim x), ``log_covariance``
        of their logarithms (x, x_other). ``ratio`` of the signal to single scattering's (gate, z,
        y). Attributes ``rounds``, ``reason`` (why they ended), ``walk_step`` of the prior,
        ``attenuation_factor``, ``monte_carlo_fraction`` (variance of the renderer over that of the
        counts, mean).

    Raises
    ------
    InputError
        Planar gates, counts of another shape or below 0, no counts above the background, gates
        that receive no light, air that is not equally spaced, samples not given as a number.
    """
    counts = _checked(counts, plan, air, counts_per_signal, settings, background)
    known = _known(background, calibration_error, reference, air)
    use_variant(settings.variant)
    nodes = air.nodes()
    layers = Layers(
        nodes - plan.position,
        np.linspace(plan.gate_start, plan.gate_stop, plan.gate_count + 1),
        1 / plan.obliquity().ravel(),
    )
    number = counts.reshape(len(counts), -1)
    profile = _first(start, air)
    _check_light(layers.signal(profile, 1.0)[0], plan)
    # in the first rounds the profile is far from the last: few samples do
    samples = int(settings.samples_per_beam)
    fewer = max(samples // _FEWER, 2 * plan.gate_count)
    quick = _renderer(
        profile, plan, lidar, air, settings.model_copy(update={"samples_per_beam": fewer})
    )
    full = _renderer(profile, plan, lidar, air, settings)
    reason = f"{MOST_ROUNDS} rounds, of which the last still changed it or was noisy"
    near = False
    gains: list[np.ndarray] = []
    variances: list[np.ndarray] = []
    for round_ in range(1, MOST_ROUNDS + 1):
        rendered = _render(full if near else quick, profile, plan, air, seed + round_)
        if not gains:
            factor = attenuation_factor(rendered, layers.depth(profile))
        # the ratio of all orders to the model hardly depends on the profile: rounds are averaged
        gains.append(counts_per_signal * rendered.signal / layers.signal(profile, factor)[0])
        variances.append(counts_per_signal**2 * rendered.variance)
        gain, variance = np.mean(gains, 0), np.mean(variances, 0) / len(variances)
        solution = fit(number, gain, variance, layers, factor, known, profile)
        steps = np.log(solution.extinction / profile) ** 2 / np.diag(solution.covariance)
        profile, change = solution.extinction, float(np.sqrt(steps.mean()))
        if progress:
            progress(round_, change)
        noisy = solution.monte_carlo_fraction > settings.monte_carlo_fraction
        if near and change < CONVERGED and not noisy:
            reason = f"no change above {CONVERGED:g} standard errors"
            break
        if not near or change > NEAR:
            near = near or change < NEAR
            gains, variances = [], []
    return _dataset(solution, rendered, plan, air, factor, round_, reason)


def attenuation_factor(rendered: _Rendered, depth: np.ndarray) -> float:
    """Factor of the attenuation that remains with multiple scattering.

    Platt (1981): the ratio of the signal to single scattering's is exp(2 (1 - q) t) in the optical
    depth t. Least squares of its logarithm, weighted by the Monte Carlo variance, give q.
    """
    ratio = np.log(np.maximum(rendered.signal, rendered.single) / rendered.single)
    # a floor: variances from few samples are uncertain
    weights = 1 / (rendered.variance / rendered.signal**2 + 1e-4)
    slope = (weights * ratio * depth).sum() / (weights * depth**2).sum()
    return float(np.clip(1 - slope / 2, 0.3, 1))


def _render(
    renderer: ScanRenderer, profile: np.ndarray, plan: ScanPlan, air: LayeredAir, seed: int
) -> _Rendered:
    scan = renderer.render(_grid(profile, plan, air), plan, seed)
    gates = plan.gate_count
    signal, error = (
        scan[name].transpose("gate", "z", "y").values.astype(float).reshape(gates, -1)
        for name in ("S0", "S0_stderr")
    )
    _check_light(signal, plan)
    single = signal
    if "order1.S0" in scan:
        single = scan["order1.S0"].transpose("gate", "z", "y").values.astype(float)
        single = single.reshape(gates, -1)
    return _Rendered(signal, error**2, np.maximum(single, 1e-3 * signal))


def _check_light(signal: np.ndarray, plan: ScanPlan) -> None:
    """Refuse gates without light, which count the background alone."""
    dark = np.argwhere(~(signal > 0))
    if dark.size:
        edges = np.linspace(plan.gate_start, plan.gate_stop, plan.gate_count + 1)
        low, high = edges[dark[0, 0] : dark[0, 0] + 2]
        raise InputError(
            f"gates: the one from {low:g} to {high:g} m receives no light; expected gates within "
            "the air and the field of view, and samples enough"
        )


def _renderer(
    profile: np.ndarray,
    plan: ScanPlan,
    lidar: BackscatterLidar,
    air: LayeredAir,
    settings: RenderSettings,
) -> ScanRenderer:
    around = ScatteringAir(air.environment, air.phase, air.albedo)
    return ScanRenderer(_grid(profile, plan, air), plan, lidar, around, settings)


def _grid(profile: np.ndarray, plan: ScanPlan, air: LayeredAir) -> xr.DataArray:
    """The profile as a field, so wide that light that leaves it sideways does not return."""
    lateral = max(np.abs(plan.y).max(), np.abs(plan.z).max()) * plan.gate_stop / plan.centre
    half, nodes = float(lateral + np.ptp(air.x)), air.nodes()
    field = np.broadcast_to(profile[:, None, None], (len(profile), 2, 2)).copy()
    sides = np.array([-half, half])
    return xr.DataArray(field, dims=("x", "y", "z"), coords={"x": nodes, "y": sides, "z": sides})


def _first(start: ArrayLike | None, air: LayeredAir) -> np.ndarray:
    """The start at the nodes: as given, or an optical depth of 1."""
    if start is None:
        return np.full(len(air.nodes()), 1 / (np.ptp(air.x) * len(air.x) / (len(air.x) - 1)))
    profile = numbers("start", start)
    if profile.shape != air.x.shape or not (np.isfinite(profile) & (profile > 0)).all():
        raise InputError(
            f"start: shape {profile.shape} or values are not allowed; expected an extinction above "
            f"0 in each of {len(air.x)} layers"
        )
    return np.repeat(profile, _NODES)


def _known(
    background: float,
    calibration_error: float,
    reference: tuple[float, float] | None,
    air: LayeredAir,
) -> Known:
    if not 0 <= calibration_error < 1:
        raise InputError(
            f"calibration_error: {calibration_error} is not allowed; expected 0 or more, below 1"
        )
    value, error = (1.0, np.inf) if reference is None else reference
    if not (np.isfinite(value) and value > 0 and error > 0):
        raise InputError(
            f"reference: {value:g} m^-1 with a relative error of {error:g} is not allowed; "
            "expected both above 0"
        )
    row = np.zeros(len(air.x) * _NODES)
    row[-_NODES:] = 1 / _NODES
    return Known(background, calibration_error, row, float(np.log(value)), error)


def _checked(
    counts: ArrayLike,
    plan: ScanPlan,
    air: LayeredAir,
    counts_per_signal: float,
    settings: RenderSettings,
    background: float,
) -> np.ndarray:
    counts = numbers("counts", counts)
    expected = (plan.gate_count, len(plan.z), len(plan.y))
    if plan.gate_kind != "spherical":
        raise InputError(f"scan.gates: {plan.gate_kind} is not allowed; expected spherical gates")
    if counts.shape != expected or not (np.isfinite(counts) & (counts >= 0)).all():
        raise InputError(
            f"counts: shape {counts.shape} or values are not allowed; expected 0 or more in gates, "
            f"rows and columns {expected}"
        )
    if not (np.isfinite(background) and background >= 0):
        raise InputError(f"background: {background} is not allowed; expected 0 counts or more")
    if not counts.sum() > background * counts.size:
        raise InputError(
            f"counts: {counts.sum():g} in all gates is not above the background of "
            f"{background * counts.size:g}; expected gates with light"
        )
    if not (np.isfinite(counts_per_signal) and counts_per_signal > 0):
        raise InputError(
            f"counts_per_signal: {counts_per_signal} is not allowed; expected a number above 0"
        )
    steps = np.diff(air.x)
    if len(air.x) < 3 or not (steps > 0).all() or np.ptp(steps) > 1e-6 * steps.mean():
        raise InputError(
            f"air.x: {len(air.x)} places are not allowed; expected three or more, equally spaced "
            "and ascending"
        )
    if not air.environment > 0:
        raise InputError(f"air.environment: {air.environment} is not allowed; expected above 0")
    # counts of all beams are summed: errors that beams share would not average out
    if settings.common:
        raise InputError(
            "render.random_numbers: common is not allowed for an inversion; expected independent"
        )
    if settings.samples_per_beam == "auto":
        raise InputError(
            "render.samples_per_beam: auto is not allowed for an inversion; expected a number"
        )
    return counts


def _dataset(
    solution: Fit,
    rendered: _Rendered,
    plan: ScanPlan,
    air: LayeredAir,
    factor: float,
    rounds: int,
    reason: str,
) -> xr.Dataset:
    ratio = (rendered.signal / rendered.single).reshape(-1, len(plan.z), len(plan.y))
    layers = len(air.x)
    mean = solution.extinction.reshape(layers, -1).mean(1)
    slopes = np.kron(np.eye(layers), np.ones(_NODES) / _NODES) * solution.extinction / mean[:, None]
    covariance = slopes @ solution.covariance @ slopes.T
    stderr = mean * np.sqrt(np.diag(covariance))
    unit = {"units": "m-1"}
    return xr.Dataset(
        {
            "extinction": ("x", mean, {**unit, "long_name": "extinction"}),
            "extinction_stderr": ("x", stderr, {**unit, "long_name": "its standard error"}),
            "log_covariance": (("x", "x_other"), covariance, {"units": "1"}),
            "ratio": (("gate", "z", "y"), ratio, {"units": "1"}),
        },
        coords={
            "x": ("x", air.x, {"units": "m"}),
            "z": ("z", plan.z, {"units": "m"}),
            "y": ("y", plan.y, {"units": "m"}),
        },
        attrs={
            "rounds": rounds,
            "reason": reason,
            "walk_step": solution.walk_step,
            "attenuation_factor": factor,
            "monte_carlo_fraction": solution.monte_carlo_fraction,
        },
    )
