"""What the counts of two images tell of the wind: the exact likelihood beside `variational`."""

import math
from typing import NamedTuple

import numpy as np
import torch

import lidar_mi as lm
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.flows import flows_of, mean_flow
from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.variational import variational_and_flow
from lidar_mi.retrieval.images.windows import Windows

from .marginal_likelihood import Counts, likelihood, precision_of, spectra
from .report import Check, Comparison
from .scenes import Effort

TITLE = "Wind of counts"
INTRODUCTION = (
    "Images of the air of `wake_backscatter` and `wake_sensor`, 48 m x 50 m about the port vortex, "
    "blurred by the beams and counted. The wind is retrieved by `variational`. Its prior is then "
    "combined with the likelihood that integrates over the air (`validation/marginal_likelihood`)."
)
CASES = (
    ("wake_sensor", 150.0, 2.5, 0.011),
    ("wake_backscatter", 500.0, 0.0, 0.034),
    ("wake_backscatter", 500.0, 0.0, 0.11),
)
"""Experiment, range (m), depth of the gate (m) that smears, noise of a pixel over the mean."""
SEEDS = (1,)
STEPS = 5
DT, SPACING = 0.1, 0.5
_AREA = {"z": slice(20, 120), "y": slice(16, 112)}
_DAMPING = 0.7
"""Of a step: whole ones swing about the maximum where texture is weak."""
_RIM = 8
"""Pixels at the edge that are not judged."""
_INNER = (..., slice(_RIM, -_RIM), slice(_RIM, -_RIM))
_LINEAR = 1 / 6
"""Variance, px^2, of the linear interpolation between the nodes that the beams see."""


class Air(NamedTuple):
    """Images without noise (z, y), their flow (2, z, y), px in dt, and the footprint, px^2."""

    images: list[np.ndarray]
    flow: torch.Tensor
    footprint: float


def air(name: str, distance: float, depth: float) -> Air:
    """About the port vortex."""
    experiment = lm.load_experiment(name)
    truth = lm.make_truth(experiment)
    wind = mean_flow(flows_of(experiment)).mean("x").transpose("z", "y").isel(_AREA)
    images = [
        blur_by_beam(truth.image(k), experiment.lidar, distance, depth).isel(_AREA).values
        for k in (0, 1)
    ]
    flow = torch.as_tensor(np.stack([wind["w"].values, wind["v"].values])) * DT / SPACING
    radius = float(experiment.lidar.radius_at(distance)) / 2 / SPACING
    return Air(images, flow.double(), radius**2 + _LINEAR)


class Judged(NamedTuple):
    """rms errors of v and w, m/s, and the variance of their normalised errors."""

    v: float
    w: float
    variance: float = math.nan


def judged(found: torch.Tensor, true: torch.Tensor, covariance: torch.Tensor) -> Judged:
    """Errors within the rim; covariance (2, 2, z, y), px^2."""
    square = (found - true)[_INNER].square()
    return Judged(*_rms(square), float((square / _variances(covariance)[_INNER]).mean()))


def _rms(square: torch.Tensor) -> tuple[float, float]:
    """rms of v and w, m/s, of squares (2, z, y) of w and v, px^2."""
    w, v = (square.mean((1, 2)).sqrt() * SPACING / DT).tolist()
    return v, w


def _variances(covariance: torch.Tensor) -> torch.Tensor:
    return covariance.diagonal(dim1=0, dim2=1).movedim(-1, 0)


def of_case(name: str, distance: float, depth: float, noise: float, seed: int) -> list[Judged]:
    """`variational`; the exact likelihood: expected, from `variational` and from the truth."""
    true = air(name, distance, depth)
    expected = [image / true.images[0].mean() / noise**2 for image in true.images]
    random = np.random.default_rng(seed)
    images = [torch.as_tensor(random.poisson(mean).astype(float)) for mean in expected]
    variances = [torch.as_tensor(mean) for mean in expected]
    counts = Counts(images, variances, true.footprint)
    windows = Windows(tuple(images[0].shape), 8, 16, 1)
    level = ((variances[0] + variances[1]) / 2).sqrt()
    vectors, start = variational_and_flow(images, windows, noise=level, keep=True)
    if start is None:
        raise RuntimeError(f"{name}, noise {noise}: the images do not determine the flow")
    pixels = [torch.arange(n).double() for n in windows.shape]
    mesh = Mesh(start.prior.mesh.axes, pixels)
    retrieved = start.coefficients.double()
    # of vectors at windows' centres, which lie within the rim
    margin = (windows.shape[0] - vectors.d.shape[-2]) // 2
    covariance = torch.ones(2, 2, *windows.shape, dtype=torch.double)
    within = (slice(margin, margin + n) for n in vectors.d.shape[-2:])
    covariance[..., *within] = torch.as_tensor(vectors.covariance)
    results = [judged(mesh.field(retrieved), true.flow, covariance)]

    prior = precision_of(start.prior.to(retrieved), start.settings.ridge)
    truth = mesh.fitted(true.flow)
    results.append(_expected(counts, mesh, truth, prior))
    for found in (retrieved, truth):
        found, covariance = _most_probable(counts, mesh, found, prior)
        results.append(judged(mesh.field(found), true.flow, _of_pixels(mesh, covariance)))
    return results


def _most_probable(
    counts: Counts, mesh: Mesh, start: torch.Tensor, prior: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Coefficients and their covariance by Fisher's scoring, with the spectra of the start."""
    found, known = start, spectra(counts, mesh, start)
    for _ in range(STEPS):
        here = likelihood(counts, mesh, found, known)
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(here.information + prior))
        step = covariance @ (here.gradient - prior @ found.reshape(-1))
        found = found + _DAMPING * step.reshape(found.shape)
    return found, covariance


def _expected(counts: Counts, mesh: Mesh, truth: torch.Tensor, prior: torch.Tensor) -> Judged:
    """rms error of the most probable flow, linearised about the truth: bias and noise.

    With the information I and the prior P the most probable flow has the bias -(I + P)^-1 P c and
    the covariance (I + P)^-1 I (I + P)^-1 for the true coefficients c.
    """
    information = likelihood(counts, mesh, truth, spectra(counts, mesh, truth)).information
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(information + prior))
    bias = mesh.field((inverse @ prior @ truth.reshape(-1)).reshape(truth.shape))
    noise = _of_pixels(mesh, inverse @ information @ inverse)
    return Judged(*_rms((bias.square() + _variances(noise))[_INNER]))


def _of_pixels(mesh: Mesh, covariance: torch.Tensor) -> torch.Tensor:
    """Covariance of the flow (2, 2, z, y) by that of the coefficients."""
    knots = [axis.knots for axis in mesh.axes]
    parts = covariance.reshape(2, *knots, 2, *knots)
    z, y = mesh.basis(0).to(covariance), mesh.basis(1).to(covariance)
    return torch.einsum("pi,qj,cijdkl,pk,ql->cdpq", z, y, parts, z, y)


def wind(effort: Effort) -> Check:
    heads = ("range", "noise", "seed", "flow", "rms error of v, m/s", "of w, m/s", "variance")
    names = (
        "`variational`",
        "exact, expected",
        "exact, from `variational`",
        "exact, from the truth",
    )
    lines = []
    for case in CASES:
        for seed in SEEDS:
            for name, one in zip(names, of_case(*case, seed), strict=True):
                variance = "" if math.isnan(one.variance) else f"{one.variance:.2f}"
                errors = f"{one.v:.3f}", f"{one.w:.3f}", variance
                lines.append((f"{case[1]:g} m", f"{case[3]:.1%}", str(seed), name, *errors))
    return Check(
        "Error of the most probable flow, with the likelihood of `variational` and the exact one",
        "*Expected*: linearised about the true flow, with the prior that `variational` found. "
        f"*From*: {STEPS} damped steps of Fisher's scoring from that flow. All vectors count, "
        "flagged ones too.",
        (),
        comparison=Comparison(heads, tuple(lines)),
    )


CHECKS = (wind,)
