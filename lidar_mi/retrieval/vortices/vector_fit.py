"""A pair of wake vortices from retrieved wind vectors."""

from dataclasses import dataclass, replace

import numpy as np
import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.common_error import common_rotation, common_stderr, own_errors
from lidar_mi.retrieval.vortices.acceptance import (
    NOT_TOLD,
    STARTS,
    TOLERANCE,
    check_profile,
    checked_fit,
    no_fit,
    step_limits,
    within,
)
from lidar_mi.retrieval.vortices.ambient import AmbientWind, ambient_errors, in_ambient_wind
from lidar_mi.retrieval.vortices.covariance import (
    change_by_flow,
    model_error_of,
    parameter_covariance,
    shared_error,
)
from lidar_mi.retrieval.vortices.model import Profile, rotations, sensitivity, wind
from lidar_mi.retrieval.vortices.model_error import mean_length
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.robust_fit import Misfit, fit
from lidar_mi.retrieval.vortices.search import Observations, starting_points


@dataclass(frozen=True)
class _Vectors:
    """Wind vectors on a grid, whitened by their covariance; call with parameters for the misfit."""

    y: torch.Tensor
    z: torch.Tensor
    root: torch.Tensor
    """Inverse of the covariance's Cholesky factor, (2, 2, z, y)."""
    value: torch.Tensor
    valid: torch.Tensor
    profile: Profile
    ambient: torch.Tensor | float = 0.0
    """Wind (2, z, y) in addition to that of the pair."""

    def off(self, parameters: torch.Tensor) -> torch.Tensor:
        """What is left of the vectors, m/s."""
        return self.value - wind(parameters, self.y, self.z, self.profile) - self.ambient

    def __call__(self, parameters: torch.Tensor) -> Misfit:
        off = self.off(parameters)
        residual = (self.root * off).sum(1)
        about = rotations(parameters, self.y, self.z, self.profile)
        jacobian = torch.stack([-sensitivity(about, along) for along in self.root], 1)
        one = torch.ones_like(residual)
        valid = self.valid.expand_as(residual)
        return Misfit(residual, jacobian, -self.root.transpose(0, 1), valid, one, one)


@checked_arguments
def fit_vortices_to_wind(vectors: xr.Dataset, profile: Profile = "lamb_oseen") -> VortexPairFit:
    """Two vortices and a mean wind fitted to retrieved vectors.

    Parameters
    ----------
    vectors : Dataset, dims (z, y)
        From `lidar_mi.retrieval.wind.pair.retrieve_wind`: v, w, and if present v_stderr,
        w_stderr, vw_correlation, flag, y_vector, z_vector. Vectors that are flagged or NaN are
        masked. Without standard errors all have the same weight, with the error estimated from
        their residuals.
    profile : {"lamb_oseen", "burnham_hallock"}

    Returns
    -------
    VortexPairFit
        Errors correlated between neighbouring vectors appear in the residuals and count as model
        error.

    Raises
    ------
    InputError
        Variables missing, or fewer than 20 vectors.

    Examples
    --------
    The wind of a pair, as vectors without errors:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
    >>> y, z = np.arange(-40.0, 41.0, 2.0), np.arange(-24.0, 25.0, 2.0)
    >>> v, w = velocity(vortex_pair(300.0, separation=30.0, core_radius=3.0), y, z[:, None])
    >>> vectors = xr.Dataset({"v": (("z", "y"), v), "w": (("z", "y"), w)}, {"z": z, "y": y})
    >>> pair = lm.fit_vortices_to_wind(vectors)
    >>> pair.success, round(pair.port.circulation), round(pair.port.y)
    (True, 300, 15)
    """
    check_profile(profile)
    for name in ("v", "w"):
        if name not in vectors:
            raise InputError(f"vectors.{name}: missing; expected v and w on (z, y)")
    if set(vectors.sizes) != {"z", "y"}:
        raise InputError(f"vectors: dims {tuple(vectors.sizes)} are not allowed; expected z and y")
    vectors = vectors.transpose("z", "y")

    def numbers(name: str) -> np.ndarray:
        kind = vectors[name].dtype
        if kind.kind not in "biuf":
            raise InputError(f"vectors.{name}: {kind} is not allowed; expected real numbers")
        return vectors[name].values.astype(float)

    def field(name: str, default: np.ndarray | float = 0.0) -> np.ndarray:
        known = name in vectors or name in vectors.coords
        return np.broadcast_to(numbers(name) if known else default, vectors["v"].shape)

    z, y = numbers("z"), numbers("y")
    grid_z, grid_y = np.meshgrid(z, y, indexing="ij")
    value = np.stack([field("v"), field("w")])
    place = np.stack([field("y_vector", grid_y), field("z_vector", grid_z)])
    usable = np.isfinite(value).all(0) & np.isfinite(place).all(0)
    usable &= field("flag") == 0
    common = common_stderr(vectors)
    stderr = np.stack([field(name, np.nan) for name in ("v_stderr", "w_stderr")])
    known = bool(np.isfinite(stderr[:, usable]).any())
    if known:
        usable &= (np.isfinite(stderr) & (stderr > 0)).all(0)
    if int(usable.sum()) < 20:
        raise InputError(f"vectors: {int(usable.sum())} are valid; expected at least 20")
    stderr = np.where(usable, stderr if known else 1.0, 1.0)
    rho = np.nan_to_num(field("vw_correlation")) * usable
    stderr, rho = own_errors(stderr, rho, common if known else np.zeros(2))
    rho = rho.clip(-0.999, 0.999) if known else 0 * rho
    root = np.zeros((2, 2, *usable.shape))
    root[0, 0] = 1 / stderr[0]
    root[1, 0] = -rho / np.sqrt(1 - rho**2) / stderr[0]
    root[1, 1] = 1 / np.sqrt(1 - rho**2) / stderr[1]

    vector_y, vector_z, vector = (
        torch.as_tensor(np.where(usable, a, 0.0)) for a in (*place, value)
    )
    valid = torch.as_tensor(usable)
    model = _Vectors(vector_y, vector_z, torch.as_tensor(root), vector, valid, profile)
    limits = step_limits(y, z, profile)
    # a search needs only its order of magnitude: a quarter of the mean square wind
    flow_variance = float(np.square(value[:, usable]).mean()) / 4
    best = None
    for start in starting_points(_components(model, flow_variance), STARTS, profile):
        solution = fit(model, start, limits, flow_variance, 30, TOLERANCE)
        if best is None or solution.cost < best.cost:
            best = solution
    if best is None:
        return no_fit(profile, "no vortex signature")
    # without standard errors their size follows from the residuals, robustly
    if not known:
        off = best.misfit.residual[:, valid]
        spread = float(1.4826 * (off - off.median()).abs().median())
        if spread > 0:
            model = replace(model, root=model.root / spread)
    # weights, model error and ambient wind depend on each other
    lateral, vertical = torch.as_tensor(grid_y), torch.as_tensor(grid_z)
    around: AmbientWind | None = None
    for _ in range(3):
        error = model_error_of(best, 1.0)
        best = fit(model, best.parameters[:10], limits, error.variance, 12, TOLERANCE)
        ambient = in_ambient_wind(best, lateral, vertical, 1.0, around)
        # linear in the pair: beyond, any other pair would do in some air
        if within(limits, best.parameters, ambient.solution) is None:
            return no_fit(profile, NOT_TOLD)
        around, best = ambient.wind, ambient.solution
        model = replace(model, ambient=around.at(lateral, vertical))
    error = model_error_of(best, 1.0)
    departure = model_error_of(best, 1.0, before=error)
    by_air = ambient_errors(ambient)
    covariance = parameter_covariance(best, error, departure, 1.0, by_air.covariance)
    chi2 = float(best.misfit.residual[:, valid].square().mean()) if known else np.nan
    residual = model.off(best.parameters)[:, valid]
    varied = model.value[:, valid] - model.value[:, valid].mean(1, keepdim=True)
    explained = 1 - float(residual.square().sum() / varied.square().sum())
    spacing = (float(np.diff(y).mean()) * float(np.diff(z).mean())) ** 0.5
    pair = checked_fit(
        best,
        covariance,
        profile,
        chi2,
        explained,
        error.variance**0.5,
        mean_length(error) * spacing,
        z,
        y,
        change_by_flow(best, torch.stack([-model.z, model.y])),
        further=by_air.further,
    )
    shared, length = shared_error(by_air)
    pair = replace(pair, ambient=around, shared=shared, shared_length=length)
    v_stderr, w_stderr = common
    rotation, centre = common_rotation(vectors)
    return pair.with_common_error(v_stderr, w_stderr, rotation, centre)


def _components(vectors: _Vectors, flow_variance: float) -> Observations:
    """Vectors as single components, thinned to a few hundred places."""
    # the search is quadratic in the places and needs no more than a thousand vectors
    step = max(1, round((float(vectors.valid.sum()) / 1000) ** 0.5))
    part = (Ellipsis, slice(step // 2, None, step), slice(step // 2, None, step))
    valid = vectors.valid[part]
    root, value = vectors.root[part][..., valid], vectors.value[part][..., valid]
    along = root.transpose(0, 1)
    weight = 1 / (1 + flow_variance * along.square().sum(0))
    y, z = (axis[part][valid] for axis in (vectors.y, vectors.z))
    return Observations(
        y.repeat(2),
        z.repeat(2),
        along.flatten(1),
        (root * value).sum(1).flatten(),
        weight.flatten(),
    )
