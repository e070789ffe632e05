"""How wrong the prior of a flow is: asked of the images by a second fit with a weaker prior.

A prior that is wrong makes errors that no residual shows. The fit u with the prior's precision P
and the fit with P / 4 differ by what the prior does to the flow, and by noise. Their difference has
a known distribution where the prior holds (in the manner of Stein 1981, Ann. Stat. 9, 1135-1151).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.flow.components import normal_fields
from lidar_mi.retrieval.flow.flow_spline import Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.posterior import Posterior

WEAKER = 0.25
"""Strength of the prior of the second fit, over that of the first."""
_DRAWS = 4
"""Flows and noise drawn: the ratio scatters by 5 % with them, by more from flow to flow."""
_LEAST = 0.05
"""Of the ratio, which the noise of the difference may make negative."""
_FIRST_SEED = 11


class PriorCheck(NamedTuple):
    """How wrong a prior is, and how much of the posterior variance is its.

    ratio: mean square of the prior's bias over the one that it expects, of the whole image.
    fraction (*prior.mesh.shape): of the posterior variance, that of the bias as expected.
    mesh: that of the prior.
    """

    ratio: float
    fraction: torch.Tensor
    mesh: Mesh

    def factor(self, places: Sequence[torch.Tensor]) -> torch.Tensor:
        """By which the posterior covariance is to be multiplied at a mesh of places."""
        factor = 1 + (self.ratio - 1) * self.fraction
        return interpolated(factor, self.mesh.places, [place.to(factor) for place in places])


def prior_check(fit: Posterior, linear: Linear, mesh: Mesh) -> PriorCheck:
    """The ratio of the prior's bias to its expectation, by fits with P and P / 4.

    With the information H of the images, C = (H + P)^-1 and C_w = (H + P / 4)^-1, both fits of one
    linearised likelihood differ by u_w - u = 3/4 C_w P u. Noise of the images' weights makes the
    flow C A' W^1/2 n. A flow u_0 of the prior has the bias C P u_0, and P u_0 = P^1/2 z. Draws of
    both give the noise's and the bias's part of the posterior variance, C = C H C + C P C, and the
    mean squares e_noise and e_prior that they make in u_w - u. With means over the image,

        ratio = <(|u_w - u|^2 - e_noise) / e> / <e_prior / e>,    e = e_noise + e_prior.

    The likelihood ``linear`` is that of the fit.
    """
    prior, flow = fit.prior, fit.coefficients
    by_noise = torch.cat([_score(linear, mesh, seed).to(flow) for seed in range(_DRAWS)])
    weights = prior.weights
    z = normal_fields((_DRAWS, *weights.shape), weights, _FIRST_SEED + _DRAWS)
    by_prior = prior.rates_transposed(weights.sqrt() * z).to(flow)
    noise, bias = fit.fitted(torch.cat([by_noise, by_prior])).split(_DRAWS)
    fits = torch.cat([flow[None], noise, -bias])
    gradients = fit.prior_gradient(fits)
    gradients[-_DRAWS:] += by_prior
    changes = fit.fitted((1 - WEAKER) * gradients, WEAKER)

    def squares(flows: torch.Tensor) -> torch.Tensor:
        # means over the width of the prior: those of few draws scatter
        return prior.smooth(prior.mesh.field(flows).square().sum(1))

    seen, of_noise, of_prior = (
        squares(part).mean(0) for part in changes.split([1, _DRAWS, _DRAWS])
    )
    expected = (of_noise + of_prior).clamp(min=1e-30)
    by_bias = (of_prior / expected).mean().clamp(min=1e-30)
    ratio = max(float(((seen - of_noise) / expected).mean() / by_bias), _LEAST)
    part, other = squares(bias).mean(0), squares(noise).mean(0)
    return PriorCheck(ratio, part / (part + other).clamp(min=1e-30), prior.mesh)


def _score(linear: Linear, mesh: Mesh, seed: int) -> torch.Tensor:
    """Gradient (1, components, knots ...) of the likelihood by noise of the images' weights."""
    noise = normal_fields(linear.weight.shape, linear.weight, _FIRST_SEED + seed)
    return mesh.transposed(linear.slope * (linear.weight.sqrt() * noise))[None]
