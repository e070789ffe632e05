"""The flow of two vortices in a mean wind: wind, paths of the air, sensitivity to each parameter.

Frame: y to port, z up. A vortex with positive circulation rotates from +y towards +z.
"""

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Literal, NamedTuple, get_args

import torch

Profile = Literal["lamb_oseen", "burnham_hallock"]
PROFILES: tuple[str, ...] = get_args(Profile)

PARAMETERS = (
    "port_circulation",
    "port_log_radius",
    "port_y",
    "port_z",
    "starboard_circulation",
    "starboard_log_radius",
    "starboard_y",
    "starboard_z",
    "mean_v",
    "mean_w",
)
"""Order of the parameters: m^2 s^-1, log of the core radius in m, m, m; twice; m s^-1."""

# Root of 1 + 2 a = exp(a): puts the peak of the Lamb-Oseen swirl at the core radius.
_LAMB_OSEEN = 1.2564
# Angle (rad) by which the fastest air may rotate in one Runge-Kutta step: an error of 3e-4 of
# its radius.
_STEP_ANGLE = 0.5
# Angle (rad) up to which the midpoint rule is used: an error of 2e-5 of the radius.
_SLOW_ANGLE = 0.05
# Steps for all air together; beyond, only air near a core takes as many as the core does.
_FEW_STEPS = 4


def angular_velocity(s: torch.Tensor, profile: Profile) -> tuple[torch.Tensor, torch.Tensor]:
    """Angular velocity over Gamma/(2 pi r_c^2), and its derivative, at s = r^2 / r_c^2.

    Lamb-Oseen: (1 - exp(-1.2564 s)) / s. Burnham-Hallock: 1 / (1 + s).
    """
    value = swirl(s, profile)
    if profile == "burnham_hallock":
        return value, -(value**2)
    a = _LAMB_OSEEN
    small = s < 1e-3
    t = torch.where(small, 1.0, s)
    slope = (a - (1 + a * t) * value) / t
    return value, torch.where(small, -(a**2) / 2 + a**3 * s / 3, slope)


def swirl(s: torch.Tensor, profile: Profile) -> torch.Tensor:
    """The first of `angular_velocity` alone."""
    if profile == "burnham_hallock":
        return 1 / (1 + s)
    a = _LAMB_OSEEN
    small = s < 1e-3
    some = bool(small.any())
    t = torch.where(small, 1.0, s) if some else s
    # 1 - exp(-x) = 2 tanh(x/2) / (1 + tanh(x/2)), which takes a tenth of the time of expm1
    half = torch.tanh(a / 2 * t)
    value = 2 * half / ((1 + half) * t)
    if some:
        value = torch.where(small, a - a**2 * s / 2 + a**3 * s**2 / 6, value)
    return value


def wind(theta: torch.Tensor, y: torch.Tensor, z: torch.Tensor, profile: Profile) -> torch.Tensor:
    """Wind (2, ...), v and w in m s^-1, at places (...) with the parameters (10,)."""
    v, w = theta[8].expand(y.shape), theta[9].expand(y.shape)
    for first in (0, 4):
        circulation, radius = theta[first], theta[first + 1].exp()
        dy, dz = y - theta[first + 2], z - theta[first + 3]
        value = swirl(torch.addcmul(dy * dy, dz, dz) / radius**2, profile)
        omega = circulation / (2 * torch.pi * radius**2) * value
        v, w = torch.addcmul(v, omega, dz, value=-1), torch.addcmul(w, omega, dy)
    return torch.stack([v, w])


def widened(theta: torch.Tensor, width: float) -> torch.Tensor:
    """Parameters (10, ...) of the wind's mean over a Gaussian of standard deviation `width` (m).

    The vorticity of a Lamb-Oseen vortex is a Gaussian of variance r_c^2 / (2 1.2564), to which that
    of the mean adds. That of Burnham and Hallock is widened as much, which is right far away.
    """
    wider = theta.clone()
    for radius in (1, 5):
        square = (2 * theta[radius]).exp() + 2 * _LAMB_OSEEN * width**2
        wider[radius] = square.log() / 2
    return wider


class Rotation(NamedTuple):
    """Rotation of the air at places about one vortex, tensors (...).

    dy, dz, square: from its axis, m, and their squares' sum.
    unit, omega: angular velocity per circulation, m^-2, and itself, s^-1.
    omega_slope: derivative of `omega` by half of `square`, m^-2 s^-1.
    """

    dy: torch.Tensor
    dz: torch.Tensor
    square: torch.Tensor
    unit: torch.Tensor
    omega: torch.Tensor
    omega_slope: torch.Tensor


def rotations(
    theta: torch.Tensor, y: torch.Tensor, z: torch.Tensor, profile: Profile
) -> list[Rotation]:
    """About both vortices with the parameters (10,)."""
    rotations_of_pairs = []
    for first in (0, 4):
        circulation, radius = theta[first], theta[first + 1].exp()
        dy, dz = y - theta[first + 2], z - theta[first + 3]
        square = dy**2 + dz**2
        value, slope = angular_velocity(square / radius**2, profile)
        unit = value / (2 * torch.pi * radius**2)
        omega_slope = circulation / (torch.pi * radius**4) * slope
        rotations_of_pairs.append(Rotation(dy, dz, square, unit, circulation * unit, omega_slope))
    return rotations_of_pairs


def gradient(about: Sequence[Rotation]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """dv/dy, dv/dz and dw/dy of the wind of `rotations`, s^-1; dw/dz = -dv/dy."""
    v_y = -_total(one.omega_slope * one.dy * one.dz for one in about)
    v_z = -_total(one.omega + one.omega_slope * one.dz**2 for one in about)
    w_y = _total(one.omega + one.omega_slope * one.dy**2 for one in about)
    return v_y, v_z, w_y


def _total(parts: Iterable[torch.Tensor]) -> torch.Tensor:
    return reduce(torch.add, parts)


def sensitivity(about: Sequence[Rotation], along: torch.Tensor) -> torch.Tensor:
    """Derivatives (10, ...) of along . wind with respect to `PARAMETERS`; along is (2, ...)."""
    along_y, along_z = along
    columns = about[0].dy.new_empty(10, *about[0].dy.shape)
    for number, one in enumerate(about):
        first = 4 * number
        across = along_z * one.dy - along_y * one.dz
        columns[first] = one.unit * across
        # the parameter is the logarithm of the core radius
        columns[first + 1] = -(2 * one.omega + one.omega_slope * one.square) * across
        columns[first + 2] = -(one.omega_slope * one.dy * across + one.omega * along_z)
        columns[first + 3] = -(one.omega_slope * one.dz * across - one.omega * along_y)
    columns[8], columns[9] = along_y, along_z
    return columns


def advected(
    theta: torch.Tensor,
    y: torch.Tensor,
    z: torch.Tensor,
    time: float | torch.Tensor,
    profile: Profile,
    began: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions of air after half of a time and after all of it, (2, ...) each, in m.

    Places and times are broadcast.

    Runge-Kutta of fourth order in a steady flow; `time` in s, of all air or of each, negative:
    backward. `began` is the wind (2, ...) at the places, where it is known. The middle, which is
    used for derivatives only, is by Hermite's cubic. Air that rotates little takes one step of the
    midpoint rule. Where the core takes many steps, air that rotates less than half as fast as four
    steps allow takes four.
    """
    centre = {"lamb_oseen": _LAMB_OSEEN, "burnham_hallock": 1.0}[profile] / (2 * torch.pi)
    fastest = max(
        float(centre * theta[first].abs() * (-2 * theta[first + 1]).exp()) for first in (0, 4)
    )
    longest = float(time.abs().max()) if isinstance(time, torch.Tensor) else abs(time)
    steps = int(min(64, 1 + fastest * longest // _STEP_ANGLE))
    start = torch.stack([y, z])
    began = wind(theta, y, z, profile) if began is None else began
    if isinstance(time, torch.Tensor):
        shape = torch.broadcast_shapes(y.shape, time.shape)
        start, began, time = start.expand(2, *shape), began.expand(2, *shape), time.expand(shape)
    half_y, half_z = torch.add(start, began * time, alpha=0.5)
    there = wind(theta, half_y, half_z, profile)
    place = start + time * there
    # the wind at the end of a step is that at its middle as much further again
    middle = (start + place) / 2 + time / 4 * (began - there)
    angle = _angular_speed(theta, y, z) * (
        time.abs() if isinstance(time, torch.Tensor) else abs(time)
    )
    near = angle > _SLOW_ANGLE
    groups = [(near, steps)]
    if steps > _FEW_STEPS:
        fast = angle > _FEW_STEPS / 2 * _STEP_ANGLE
        groups = [(fast, steps), (near & ~fast, _FEW_STEPS)]
    for some, number in groups:
        part = time[some] if isinstance(time, torch.Tensor) else time
        first, k1 = start[:, some], began[:, some]
        last, ended = _followed(theta, first, k1, part, number, profile)
        place[:, some], middle[:, some] = last, (first + last) / 2 + part / 8 * (k1 - ended)
    return middle, place


def _followed(
    theta: torch.Tensor,
    place: torch.Tensor,
    k1: torch.Tensor,
    time: float | torch.Tensor,
    steps: int,
    profile: Profile,
) -> tuple[torch.Tensor, torch.Tensor]:
    """End of the path of air at places (2, n) with the wind k1 after so many steps; wind there."""

    def wind_at(place: torch.Tensor) -> torch.Tensor:
        y, z = place
        return wind(theta, y, z, profile)

    h = time / steps
    for _ in range(steps):
        k2 = wind_at(place + h / 2 * k1)
        k3 = wind_at(place + h / 2 * k2)
        k4 = wind_at(place + h * k3)
        place = place + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        k1 = wind_at(place)
    return place, k1


def _angular_speed(theta: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """Upper limit of the angular speed: the sum of both vortices' absolute values, s^-1."""
    total = torch.zeros_like(y)
    for first in (0, 4):
        dy, dz = y - theta[first + 2], z - theta[first + 3]
        # that of a vortex without a core, and in the core's middle
        square = torch.addcmul(dy * dy, dz, dz).clamp(
            min=(2 * theta[first + 1]).exp() / _LAMB_OSEEN
        )
        total = total + theta[first].abs() / (2 * torch.pi) / square
    return total


def core_turns(theta: torch.Tensor, time: float, profile: Profile) -> float:
    """Revolutions of the air at the core radius in a time in s, of the faster vortex."""
    value, _ = angular_velocity(torch.ones_like(theta[:1]), profile)
    fastest = max(float(theta[first].abs() * (-2 * theta[first + 1]).exp()) for first in (0, 4)) / (
        2 * torch.pi
    )
    return float(value) * fastest * time / (2 * torch.pi)


def drift(theta: torch.Tensor, profile: Profile) -> torch.Tensor:
    """Velocity (2,) of the pair, m s^-1: mean wind plus mutual induction of the vortices."""
    centres = theta[[2, 6]], theta[[3, 7]]
    return wind(theta, *centres, profile).mean(1)


def path_sensitivity(
    theta: torch.Tensor,
    middle: torch.Tensor,
    along: torch.Tensor,
    time: float | torch.Tensor,
    profile: Profile,
) -> torch.Tensor:
    """Derivatives (10, ...) of along . (end of the path) with respect to `PARAMETERS`.

    A parameter's change du of the wind along the path is advected to its end by the flow. The
    integral over the path is by the midpoint rule, advected on by exp(L time/2) with the gradient L
    of the wind there: a relative error of (omega time)^2/24, 0.7 % for 0.4 rad.
    """
    y, z = middle
    about = rotations(theta, y, z, profile)
    v_y, v_z, w_y = gradient(about)
    h = time / 2
    # exp(L h) = cosh(c) + L sinh(c) / c with c^2 = -det(L h), as L has no trace
    square = h**2 * (v_y**2 + v_z * w_y)
    even = 1 + square / 2 + square**2 / 24
    odd = h * (1 + square / 6 + square**2 / 120)
    along_y, along_z = along
    adjoint = torch.stack(
        [
            even * along_y + odd * (v_y * along_y + w_y * along_z),
            even * along_z + odd * (v_z * along_y - v_y * along_z),
        ]
    )
    return sensitivity(about, time * adjoint)
