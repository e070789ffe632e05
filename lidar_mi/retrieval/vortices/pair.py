"""A pair of vortices in a mean wind: parameters, covariance, derived quantities, wind anywhere."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.errors import InputError
from lidar_mi.retrieval.quantity import Quantity
from lidar_mi.retrieval.vortices.ambient import AmbientWind
from lidar_mi.retrieval.vortices.model import (
    Profile,
    angular_velocity,
    drift,
    rotations,
    sensitivity,
    wind,
)
from lidar_mi.tables import Table, Tabular, with_error


@dataclass(frozen=True, eq=False, repr=False)
class VortexPairFit(Tabular):
    """Two vortices in a mean wind, at mid-time.

    Attributes
    ----------
    parameters : ndarray, shape (10,)
        In the order of `lidar_mi.retrieval.vortices.model.PARAMETERS`; NaN if there is no fit; the
        start values, without a covariance, if a fit was attempted and failed. Port is the vortex
        that rotates from +y towards +z (circulation > 0).
    covariance : ndarray, shape (10, 10)
        Of the parameters: from the noise and from the flow's departure from the model.
    profile : {"lamb_oseen", "burnham_hallock"}
        Of the swirl, which circulation and core radius refer to: the same data give different
        radii for each.
    chi2 : float
        Mean square of the residuals over that of the noise; 1 without model error. NaN where the
        noise is not known.
    correlation : float
        Of image 1 and image 2, each advected to mid-time by the fit; of fits to vectors the
        fraction of their variance that is explained.
    model_error : float
        Rms departure of each wind component from the pair in its ambient wind, m s^-1, estimated
        from the residuals.
    model_error_length : float
        Its correlation length, m.
    success : bool
    reasons : tuple of str
        Why the fit is not accepted; empty if it is.
    from_start : bool
        Whether it was found from an expected pair, without a search.
    probability : float
        Probability that the images show a vortex, from `lidar_mi.retrieval.vortices.detection`,
        whether the fit is accepted or not; NaN if it was not requested.
    turned : ndarray, shape (10,), optional
        Derivative of the parameters with respect to a rotation (rad/s) of the observations about y
        = z = 0 between the scans, from +y towards +z, as by an unknown roll.
    inclined : ndarray, shape (10, 2), optional
        Derivative of the parameters with respect to the slopes dy/dx and dz/dx of the pair's axis,
        if all motion of the air along x were visible in oblique beams; see `with_slopes`.
    slopes, slope_covariance : ndarray, shapes (2,) and (2, 2), optional
        Of the pair's axis, dy/dx and dz/dx, where more than one slab determines them.
    ambient : AmbientWind, optional
        Gradient and turbulence of the air around the pair.
    shared : ndarray, shape (10, 10), optional
        The part of the covariance that is by the ambient wind, which slabs nearby share.
    shared_length : float
        Over which along x its correlation falls to 1/e, m; 0: slabs share nothing.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    profile: Profile
    chi2: float
    correlation: float
    model_error: float
    model_error_length: float
    reasons: tuple[str, ...] = ()
    from_start: bool = False
    probability: float = np.nan
    turned: np.ndarray | None = None
    inclined: np.ndarray | None = None
    slopes: np.ndarray | None = None
    slope_covariance: np.ndarray | None = None
    ambient: AmbientWind | None = None
    shared: np.ndarray | None = None
    shared_length: float = 0.0

    @property
    def success(self) -> bool:
        """Whether the fit is accepted; if not, see `reasons`."""
        return not self.reasons

    @property
    def port(self) -> Vortex:
        """The port vortex, of positive circulation."""
        return self._vortex(0)

    @property
    def starboard(self) -> Vortex:
        """The starboard vortex, of negative circulation."""
        return self._vortex(4)

    def tables(self) -> list[Table]:
        """Both vortices and the pair, with standard errors, after whether the fit is accepted."""
        tables = self.quantities

        def shown(name: str) -> str:
            return with_error(tables[name].value, tables[name].stderr, _SIGNS[tables[name].units])

        sides = [
            (name.replace("_", " "), shown(f"port_{name}"), shown(f"starboard_{name}"))
            for name in ("circulation", "circulation_5_15", "core_radius", "y", "z")
        ]
        names = [name for name in tables if not name.startswith(("port_", "starboard_"))]
        verdict = f"no fit: {', '.join(self.reasons)}" if self.reasons else "vortex pair"
        return [
            Table(f"{verdict} ({self.profile})", sides, ("", "port", "starboard")),
            Table("as a pair", [(name.replace("_", " "), shown(name)) for name in names]),
        ]

    @property
    def mean_wind(self) -> tuple[float, float]:
        """v and w of the ambient air, m s^-1."""
        return float(self.parameters[8]), float(self.parameters[9])

    def _vortex(self, first: int) -> Vortex:
        circulation, log_radius, y, z = self.parameters[first : first + 4]
        return Vortex(
            float(circulation), float(np.exp(log_radius)), float(y), float(z), self.profile
        )

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """Derived quantities of the pair, with standard errors to first order.

        circulation (Gamma, far from the core) and circulation_5_15 (Gamma of the single vortex,
        mean over radii from 5 to 15 m), core_radius (of the largest swirl), y, z of port and
        starboard; separation b_0, centre_y, centre_z, descent_speed w_0 = Gamma/(2 pi b_0) with
        the mean circulation, time_scale t_0 = b_0/w_0; mean_v, mean_w; drift_v and drift_w, the
        velocity of the pair from mean wind and mutual induction.
        """
        theta = torch.as_tensor(self.parameters)

        def derived(theta: torch.Tensor) -> torch.Tensor:
            return torch.stack(list(_derived(theta, self.profile).values()))

        values = _derived(theta, self.profile)
        slope = _jacobian(derived, self.parameters)
        spread = np.sqrt(np.einsum("ij,jk,ik->i", slope, self.covariance, slope))
        turned = np.zeros(len(spread)) if self.turned is None else slope @ self.turned
        return {
            name: Quantity(float(value), float(error), *MEANING[name], float(rotated))
            for (name, value), error, rotated in zip(values.items(), spread, turned, strict=True)
        }

    def with_common_error(
        self,
        v_stderr: float,
        w_stderr: float,
        rotation_stderr: float = 0.0,
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> "VortexPairFit":
        """With errors of the wind common to all of its observations, by an unknown pointing error.

        An error of v and w (m/s) affects only the fitted mean wind and what derives from it: drift,
        wind at any place, positions after some time. Circulations, radii and separation are not
        affected. Positions refer to the mean pointing of both scans. A rotation (rad/s, about
        ``centre``: y, z in m) changes all parameters: a vortex pair cannot rotate everywhere, and
        the fit attributes part of it to circulation.

        Raises
        ------
        InputError
            A rotation of a pair that is not known to respond to it, as one read from a file.
        """
        common = np.zeros(len(self.parameters))
        common[8:10] = v_stderr, w_stderr
        covariance = self.covariance + np.diag(common**2)
        if rotation_stderr and np.isfinite(self.parameters).all():
            if self.turned is None:
                raise InputError(
                    f"rotation_stderr: {rotation_stderr:g} rad/s is not allowed for a pair without "
                    "`turned`; expected one that was fitted"
                )
            turned = self.turned.copy()
            turned[8:10] += centre[1], -centre[0]
            covariance = covariance + rotation_stderr**2 * np.outer(turned, turned)
        return replace(self, covariance=covariance)

    def with_slopes(self, slopes: np.ndarray, covariance: np.ndarray) -> "VortexPairFit":
        """The pair, corrected for the inclination of its axis in images from oblique beams.

        Images show between none and all of the motion along x that a wholly resolved gate would
        show: none where the texture is the same throughout the depth of the gate, all where it is
        much finer. This fraction is taken to be uniform over both, 1/2 with a standard error of
        1/sqrt(12), which is added, as are the errors of the slopes.

        Parameters
        ----------
        slopes, covariance : ndarray, shapes (2,) and (2, 2)
            dy/dx and dz/dx of the axis.

        Raises
        ------
        InputError
            A pair that was fitted without a telescope, or to something else than images.
        """
        if self.inclined is None:
            raise InputError("slopes: not allowed for a pair without `inclined`; give a telescope")
        change, variance = self.inclined @ slopes, _OBLIQUE_STD**2
        by_slopes = (_OBLIQUE**2 + variance) * self.inclined @ covariance @ self.inclined.T
        return replace(
            self,
            parameters=self.parameters - _OBLIQUE * change,
            covariance=self.covariance + by_slopes + variance * np.outer(change, change),
            slopes=slopes,
            slope_covariance=covariance,
        )

    def after(self, seconds: float) -> "VortexPairFit":
        """The pair after some time of drift, with its growing errors.

        The vortices keep their circulation, core radius and distance: valid for a fraction of the
        time in which the pair descends by its separation.
        """

        def moved(theta: torch.Tensor) -> torch.Tensor:
            return theta + seconds * drift(theta, self.profile) @ _CENTRES.to(theta)

        theta = torch.as_tensor(self.parameters)
        slope = _jacobian(moved, self.parameters)
        covariance = slope @ self.covariance @ slope.T
        return replace(self, parameters=moved(theta).numpy(), covariance=covariance)

    def wind(self, y: ArrayLike, z: ArrayLike) -> xr.Dataset:
        """The wind of the fit anywhere, at mid-time; see `after` for later times.

        Parameters
        ----------
        y, z : array_like
            m; they broadcast. One-dimensional DataArrays or arrays of the same shape give values
            place by place; use ``y[None, :]`` and ``z[:, None]`` for a grid.

        Returns
        -------
        Dataset
            `v`, `w`, `v_stderr`, `w_stderr` (m s^-1) and `vw_correlation`, dims (row, column) or
            those of the arrays. The errors contain those of the parameters, the model error and the
            rms of the ambient wind, which is no part of the values.
        """
        y, z = np.broadcast_arrays(np.asarray(y, dtype=float), np.asarray(z, dtype=float))
        values, covariance = self.wind_and_covariance(y, z)
        stderr = np.sqrt(covariance[:2])
        both = stderr[0] * stderr[1]
        dims = [f"dim_{k}" for k in range(y.ndim)]
        fields = {
            "v": values[0],
            "w": values[1],
            "v_stderr": stderr[0],
            "w_stderr": stderr[1],
            "vw_correlation": np.divide(
                covariance[2], both, out=np.zeros_like(both), where=both > 0
            ),
        }
        return xr.Dataset(
            {
                name: (dims, field, {"units": "1" if "correlation" in name else "m s-1"})
                for name, field in fields.items()
            },
            coords={"y": (dims, y, {"units": "m"}), "z": (dims, z, {"units": "m"})},
        )

    def wind_and_covariance(self, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """v, w (2, ...) at places and their covariance vv, ww, vw (3, ...)."""
        y, z = np.broadcast_arrays(y, z)
        theta = torch.as_tensor(self.parameters)
        lateral, vertical = (torch.as_tensor(np.array(axis, dtype=float)) for axis in (y, z))
        unit = torch.eye(2, dtype=theta.dtype)
        about = rotations(theta, lateral, vertical, self.profile)
        slope = [sensitivity(about, direction.view(2, *[1] * lateral.ndim)) for direction in unit]
        covariance = torch.as_tensor(self.covariance)
        v, w = (torch.tensordot(covariance, part, 1) for part in slope)
        model = self.model_error**2 + (self.ambient.rms**2 if self.ambient else 0.0)
        spread = torch.stack(
            [(v * slope[0]).sum(0) + model, (w * slope[1]).sum(0) + model, (v * slope[1]).sum(0)]
        )
        return wind(theta, lateral, vertical, self.profile).numpy(), spread.numpy()


# Fraction of the motion along x that oblique beams show, uniform from 0 to 1.
_OBLIQUE, _OBLIQUE_STD = 1 / 2, 12**-0.5
# Derivatives of the parameters by a shift of the pair along y and along z.
_CENTRES = torch.zeros(2, 10)
_CENTRES[0, [2, 6]] = _CENTRES[1, [3, 7]] = 1.0

MEANING = {
    f"{side}_{name}": (units, f"{text} of the {side} vortex")
    for side in ("port", "starboard")
    for name, units, text in (
        ("circulation", "m2 s-1", "circulation"),
        ("circulation_5_15", "m2 s-1", "circulation, mean over radii from 5 to 15 m,"),
        ("core_radius", "m", "radius of the largest swirl"),
        ("y", "m", "y of the centre"),
        ("z", "m", "z of the centre"),
    )
} | {
    "separation": ("m", "distance of the vortices, b0"),
    "centre_y": ("m", "y half way between the vortices"),
    "centre_z": ("m", "z half way between the vortices"),
    "descent_speed": ("m s-1", "descent speed of the pair, w0 = Gamma / (2 pi b0)"),
    "time_scale": ("s", "time in which the pair descends by its separation, t0 = b0 / w0"),
    "mean_v": ("m s-1", "mean wind along y"),
    "mean_w": ("m s-1", "mean wind along z"),
    "drift_v": ("m s-1", "velocity of the pair along y, mean wind included"),
    "drift_w": ("m s-1", "velocity of the pair along z, mean wind included"),
}
"""Units and long name of every quantity of a pair."""

_SIGNS = {"m2 s-1": "m²/s", "m s-1": "m/s", "m": "m", "s": "s"}


def circulation_5_15(
    circulation: float | torch.Tensor,
    core_radius: float | torch.Tensor,
    profile: Profile = "lamb_oseen",
) -> torch.Tensor:
    """Circulation of a vortex averaged over radii from 5 to 15 m, as usual for lidars, m^2 s^-1."""
    circulation = torch.as_tensor(circulation, dtype=torch.float64)
    core_radius = torch.as_tensor(core_radius, dtype=torch.float64)
    radius = torch.linspace(5, 15, 101, dtype=torch.float64)
    s = (radius / core_radius) ** 2
    return circulation * torch.trapezoid(angular_velocity(s, profile)[0] * s, radius) / 10


def _jacobian(
    function: Callable[[torch.Tensor], torch.Tensor], parameters: np.ndarray
) -> np.ndarray:
    """Derivatives (values, parameters) at parameters; also where torch records no derivatives."""
    with torch.inference_mode(False), torch.enable_grad():
        return torch.autograd.functional.jacobian(function, torch.tensor(parameters)).numpy()


def _derived(theta: torch.Tensor, profile: Profile) -> dict[str, torch.Tensor]:
    values = {}
    for side, first in (("port", 0), ("starboard", 4)):
        circulation, radius = theta[first], theta[first + 1].exp()
        values[f"{side}_circulation"] = circulation
        values[f"{side}_circulation_5_15"] = circulation_5_15(circulation, radius, profile)
        values[f"{side}_core_radius"] = radius
        values[f"{side}_y"], values[f"{side}_z"] = theta[first + 2], theta[first + 3]
    separation = torch.hypot(theta[2] - theta[6], theta[3] - theta[7])
    speed = (theta[0] - theta[4]) / 2 / (2 * torch.pi * separation)
    values["separation"] = separation
    values["centre_y"], values["centre_z"] = (theta[2] + theta[6]) / 2, (theta[3] + theta[7]) / 2
    values["descent_speed"], values["time_scale"] = speed, separation / speed
    values["mean_v"], values["mean_w"] = theta[8], theta[9]
    values["drift_v"], values["drift_w"] = drift(theta, profile)
    return values
