"""What every solver of the flow gives: the most probable flow, with its distribution.

With the information H of the images about a flow, the precision P of its prior and the gradient g
of the log-posterior, a Gauss-Newton step is (H + P)^-1 g, and (H + P)^-1 is the posterior's
covariance. `direct`, `strips` and `iterative` each have a function `solved`, a `Solver`. Forms in
a plane are factored by `band_cholesky` or `cyclic_reduction`, each by its function `factored`, to
a `Root`.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.flow.settings import VariationalSettings

Response = Callable[[torch.Tensor], torch.Tensor]
"""From gradients of the log-likelihood (n, components, knots) to the flow's changes."""


class Root(Protocol):
    """Factor of a quadratic form of a plane flow's coefficients."""

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Coefficients that solve the system, of right hand sides (..., 2, Z, Y), in their type."""

    def covariance(self) -> torch.Tensor:
        """The inverse within the band, as a form is held: (2, 2, 7, Z, 4, Y)."""


class Posterior(Protocol):
    """A flow after a Gauss-Newton step, with its distribution."""

    @property
    def coefficients(self) -> torch.Tensor:
        """Of the flow, (components, knots ...)."""

    @property
    def prior(self) -> Prior:
        """Of the flow."""

    @property
    def response(self) -> Response | None:
        """Change of the coefficients by a gradient of the log-likelihood, if it is affordable."""

    def prior_gradient(self, flows: torch.Tensor) -> torch.Tensor:
        """The prior's precision times coefficients (n, components, knots ...)."""

    def fitted(self, gradients: torch.Tensor, strength: float = 1.0) -> torch.Tensor:
        """Coefficients by gradients (n, ...), with the prior's precision times a strength."""

    def evidence(self) -> tuple[torch.Tensor, torch.Tensor]:
        """By kind of motion: prior less posterior variance, and its square in the flow.

        They are equal at the largest evidence (MacKay's fixed point).
        """

    def covariance(self, places: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the flow (components, components, ...) at a mesh, after the images and before."""


class Solver(Protocol):
    """One Gauss-Newton step of the flow; the number of the iteration seeds random draws."""

    def __call__(
        self,
        linear: Linear,
        mesh: Mesh,
        coefficients: torch.Tensor,
        prior: Prior,
        settings: VariationalSettings,
        iteration: int,
    ) -> Posterior:
        """From the likelihood about the flow of these coefficients, on a mesh of the pixels."""
