"""The wake of a wind turbine: deficit, swirl and turbulence at a distance from it.

Frame of the lidar: the turbine's axis is the x axis and the wind blows along +x, away from a lidar
on the nacelle that looks downstream. r is the distance from the axis.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.texture import gaussian_field
from lidar_mi.atmosphere.vortices.vortex import LAMB_OSEEN_CONSTANT
from lidar_mi.errors import InputError


@dataclass(frozen=True)
class TurbineWake:
    """The mean wake at one place downstream of an actuator disc.

    diameter: D of the rotor, m.
    thrust: thrust coefficient C_T, above 0 and below 1.
    tip_speed_ratio: speed of the blades' tips over that of the wind; negative: the rotor rotates
        from +z towards +y, and the wake's swirl from +y towards +z.
    wind_speed: U of the undisturbed wind, m s^-1.
    growth: k*, by which the wake's width grows with the distance: 0.02 to 0.06, more in turbulent
        air.
    downstream: distance from the rotor, m.
    hub_core: radius of the swirl's core, m.

    Raises InputError: numbers out of range, or a place so near that the far wake's formula has no
    value there.

    Notes
    -----
    Deficit: Bastankhah and Porte-Agel 2014 (Renew. Energy 70, 116-123), eq. 23. It conserves mass
    and momentum for a Gaussian profile and holds in the far wake, from about three diameters on.

    Swirl: the angular momentum that the rotor's torque adds to the wake, in a profile of our
    choice: that of a hub vortex with a core, enclosed by the opposite vorticity that the tips have
    shed, which has spread as the deficit has. Torque: power over rotation rate, power: thrust times
    the wind at the disc, U (1 - a), a = (1 - sqrt(1 - C_T)) / 2. That is the ideal rotor; real ones
    have some tenths less swirl.
    """

    diameter: float
    thrust: float
    tip_speed_ratio: float
    wind_speed: float
    growth: float
    downstream: float
    hub_core: float

    def __post_init__(self) -> None:
        for name, unit in (
            ("diameter", " m"),
            ("wind_speed", " m/s"),
            ("growth", ""),
            ("downstream", " m"),
            ("hub_core", " m"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"turbine.{name}: {value}{unit} is not allowed; expected above 0")
        if not 0 < self.thrust < 1:
            raise InputError(f"turbine.thrust: {self.thrust} is not allowed; expected 0 to 1")
        if not (math.isfinite(self.tip_speed_ratio) and self.tip_speed_ratio != 0):
            raise InputError(
                f"turbine.tip_speed_ratio: {self.tip_speed_ratio} is not allowed; not 0"
            )
        # where the root of the deficit would be imaginary
        if self.thrust > 8 * self._relative_width**2:
            widest = (math.sqrt(self.thrust / 8) - self._initial_width) / self.growth
            raise InputError(
                f"turbine.downstream: {self.downstream:g} m is not allowed; expected the far wake, "
                f"beyond {widest * self.diameter:.4g} m for this thrust and growth"
            )

    @property
    def _initial_width(self) -> float:
        root = math.sqrt(1 - self.thrust)
        # 0.2 beta^(1/2), beta the area of the expanded wake over that of the rotor
        return 0.2 * math.sqrt((1 + root) / (2 * root))

    @property
    def _relative_width(self) -> float:
        return self.growth * self.downstream / self.diameter + self._initial_width

    @property
    def width(self) -> float:
        """sigma of the Gaussian deficit, m."""
        return self._relative_width * self.diameter

    @property
    def axial_deficit(self) -> float:
        """Deficit on the axis as a fraction of the wind."""
        return 1 - math.sqrt(1 - self.thrust / (8 * self._relative_width**2))

    @property
    def torque_coefficient(self) -> float:
        """Torque over rho U^2 pi R^3 / 2, of the ideal rotor."""
        # 1 - a of momentum theory
        at_disc = (1 + math.sqrt(1 - self.thrust)) / 2
        return self.thrust * at_disc / self.tip_speed_ratio

    @property
    def circulation(self) -> float:
        """Gamma of the hub vortex, m^2 s^-1, positive from +y towards +z.

        So that rho u r v_t, integrated over the plane, is the torque.
        """
        radius = self.diameter / 2
        torque = self.torque_coefficient * self.wind_speed**2 * math.pi * radius**3 / 2
        # the integrand falls like a Gaussian of sigma
        # angular momentum r v_t, which u carries through the plane; rho cancels
        momentum, _ = scipy.integrate.quad(
            lambda r: self.axial_speed(r) * r * self._profile(r) * 2 * math.pi * r,
            0,
            12 * self.width,
            limit=400,
            points=[self.hub_core, self.width],
        )
        return torque / momentum

    def axial_speed(self, r: ArrayLike) -> np.ndarray:
        """u at distances r (m) from the axis, m s^-1."""
        deficit = self.axial_deficit * np.exp(-(np.asarray(r, float) ** 2) / (2 * self.width**2))
        return self.wind_speed * (1 - deficit)

    def tangential_speed(self, r: ArrayLike) -> np.ndarray:
        """Swirl at distances r (m) from the axis, m s^-1."""
        return self.circulation * self._profile(r)

    def _profile(self, r: ArrayLike) -> np.ndarray:
        """Swirl of a hub vortex of circulation 1: Lamb-Oseen, less the tip vorticity within r."""
        r = np.asarray(r, float)
        core = -np.expm1(-LAMB_OSEEN_CONSTANT * (r / self.hub_core) ** 2)
        outer = np.exp(-(r**2) / (2 * self.width**2))
        return np.divide(core * outer, 2 * math.pi * r, out=np.zeros_like(r), where=r > 0)


def added_turbulence(thrust: float, ambient: float, downstream: float, diameter: float) -> float:
    """Turbulence intensity (of u) that a rotor adds in its wake.

    0.73 a^0.8325 I^0.0325 (x/D)^-0.32 (Crespo and Hernandez 1996, J. Wind Eng. Ind. Aerodyn. 61,
    71-85, eq. 21), fitted for 5 < x/D < 15, 0.07 < I < 0.14, 0.1 < a < 0.4; nearer it is an
    extrapolation.
    """
    induction = (1 - math.sqrt(1 - thrust)) / 2
    return 0.73 * induction**0.8325 * ambient**0.0325 * (downstream / diameter) ** -0.32


def isotropic_turbulence(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, outer_scale: float, seed: int
) -> np.ndarray:
    """Frozen isotropic turbulence (3, x, y, z), of mean square 1 a component, m s^-1.

    The curl of a Gaussian vector potential, with von Karman's energy spectrum
    k^4 / (k^2 + k0^2)^(17/6), k0 = 2 pi / ``outer_scale``. Derivatives are central differences:
    the divergence by these is zero, and gusts shorter than four cells are damped.

    x, y, z: axes, m, equally spaced, two nodes at least.
    """
    axes = (x, y, z)
    step = [float(axis[1] - axis[0]) for axis in axes]
    # a node more at both ends, for the central differences
    shape = [len(axis) + 2 for axis in axes]
    period = [
        scipy.fft.next_fast_len(n + math.ceil(outer_scale / h))
        for n, h in zip(shape, step, strict=True)
    ]
    cut = tuple(slice(n) for n in shape)
    # with this slope the density is (k^2 + k0^2)^(-17/6); k^2 is by the curl, k^2 by the shells
    potential = [
        gaussian_field(tuple(period), tuple(step), outer_scale, part, slope=11 / 3)[cut]
        for part in np.random.SeedSequence(seed).generate_state(3).tolist()
    ]

    def slope(component: int, along: int) -> np.ndarray:
        """Derivative of a component of the potential at the inner nodes."""
        ends = [slice(1, -1)] * 3
        high, low = list(ends), list(ends)
        high[along], low[along] = slice(2, None), slice(None, -2)
        field = potential[component]
        return (field[tuple(high)] - field[tuple(low)]) / (2 * step[along])

    gusts = np.stack(
        [slope((k + 2) % 3, (k + 1) % 3) - slope((k + 1) % 3, (k + 2) % 3) for k in range(3)]
    )
    # the mean wind is that of the wake alone
    gusts -= gusts.mean((1, 2, 3), keepdims=True)
    return gusts / math.sqrt((gusts**2).mean())


def turbine_flow(
    wake: TurbineWake,
    x: ArrayLike,
    y: ArrayLike,
    z: ArrayLike,
    ambient: float = 0.0,
    outer_scale: float = 30.0,
    seed: int = 0,
) -> xr.Dataset:
    """u, v, w behind a turbine: the mean wake, the same on all planes x, and turbulence.

    Turbulence is isotropic, of the intensity ``ambient`` plus, in squares, what the wake adds
    (`added_turbulence`) in its middle, fading outwards as the deficit does. This modulation causes
    a divergence of some per cent of the gusts' gradients.

    x, y, z: axes, m, equally spaced.
    ambient: turbulence intensity of the undisturbed wind, rms of u over U; 0: no turbulence at all.
    outer_scale: of the turbulence, m.

    Returns
    -------
    xarray.Dataset
        m s^-1 on (x, y, z).
    """
    coordinates = {"x": x, "y": y, "z": z}
    axes = {name: np.atleast_1d(np.asarray(values, float)) for name, values in coordinates.items()}
    lateral, vertical = np.meshgrid(axes["y"], axes["z"], indexing="ij")
    r = np.hypot(lateral, vertical)
    # v_t / r, which has no direction to choose on the axis
    swirl = np.divide(wake.tangential_speed(r), r, out=np.zeros_like(r), where=r > 0)
    mean = np.stack([wake.axial_speed(r), -swirl * vertical, swirl * lateral])
    flow = np.broadcast_to(mean[:, None], (3, len(axes["x"]), *r.shape)).copy()
    if ambient > 0:
        added = added_turbulence(wake.thrust, ambient, wake.downstream, wake.diameter)
        added *= np.exp(-(r**2) / (2 * wake.width**2))
        gusts = isotropic_turbulence(**axes, outer_scale=outer_scale, seed=seed)
        # variances of independent turbulence add
        flow += wake.wind_speed * np.hypot(ambient, added) * gusts
    titles = {
        "u": "velocity along the wind",
        "v": "velocity across the wind, positive to the left",
        "w": "vertical velocity, positive upwards",
    }
    return xr.Dataset(
        {
            name: (tuple(axes), field, {"units": "m s-1", "long_name": titles[name]})
            for name, field in zip(titles, flow, strict=True)
        },
        coords={name: (name, nodes, {"units": "m"}) for name, nodes in axes.items()},
    )
