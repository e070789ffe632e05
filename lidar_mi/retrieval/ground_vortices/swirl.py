"""Radial velocities of moving vortices through the range weighting, with their derivatives."""

from dataclasses import dataclass

import numpy as np
import scipy

from lidar_mi.atmosphere.vortices.vortex import LAMB_OSEEN_CONSTANT, Model
from lidar_mi.instrument.coherent.weighting import CoherentLidar, range_weight

OF_VORTEX = 4
"""Numbers of a vortex: y, z (m), circulation (m^2/s), logarithm of the core radius (m)."""

_NODES = np.array([-0.5, 0.5]) / np.sqrt(3)  # Gauss and Legendre's over a moving beam
_SMALL = 1e-4
_STEP = 1.5  # m, of the quadrature along a line
_REACH = 3.5  # standard deviations of the pulse


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines and gates of a part of a scan, and the quadrature along them.

    time, angle (lines,): s and rad.
    span (lines,): angle that the beam moves through, rad.
    rate (lines,): time over angle of the moving beam, s/rad.
    ranges (gates,): m.
    distance (points,): m.
    weight (points, gates): sums to 1 for every gate.
    """

    time: np.ndarray
    angle: np.ndarray
    span: np.ndarray
    rate: np.ndarray
    ranges: np.ndarray
    distance: np.ndarray
    weight: np.ndarray


def lines_of(
    time: np.ndarray,
    angle: np.ndarray,
    span: np.ndarray,
    rate: np.ndarray,
    ranges: np.ndarray,
    lidar: CoherentLidar,
) -> Lines:
    """Lines with their quadrature; of the lidar only pulse and gate length are used."""
    sigma = lidar.pulse_length / np.sqrt(8 * np.log(2))
    reach = lidar.gate_length / 2 + _REACH * sigma
    near, far = max(ranges[0] - reach, 0.0), ranges[-1] + reach
    count = int(np.ceil((far - near) / _STEP))
    distance = near + (far - near) * (np.arange(count) + 0.5) / count
    weight = range_weight(distance[:, None] - ranges, lidar)
    return Lines(time, angle, span, rate, ranges, distance, weight / weight.sum(0))


def shape(square: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity 2 pi r_c^2 / circulation, and its derivative, of (r / r_c)^2."""
    if model == "burnham_hallock":
        value = 1 / (1 + square)
        return value, -(value**2)
    a = LAMB_OSEEN_CONSTANT
    s = np.maximum(square, _SMALL)
    decay = np.exp(-a * s)
    value = (1 - decay) / s
    slope = (a * decay - value) / s
    # the series for small s, exact to 1e-8
    small = square < _SMALL
    value = np.where(small, a - a**2 * square / 2, value)
    return value, np.where(small, -(a**2) / 2 + a**3 * square / 3, slope)


def mixed(
    square: np.ndarray, model: Model, departure: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`shape` and its derivative, with a fraction of the other profile; what the fraction adds.

    Both profiles have their largest speed at the core radius, so that all mixtures have.
    """
    other: Model = "lamb_oseen" if model == "burnham_hallock" else "burnham_hallock"
    (value, slope), (second, second_slope) = shape(square, model), shape(square, other)
    more = second - value
    return value + departure * more, slope + departure * (second_slope - slope), more


def circulation_5_15(core_radius: np.ndarray, departure: np.ndarray, model: Model) -> np.ndarray:
    """Mean circulation over radii from 5 to 15 m, as usual for lidars, over the whole one."""
    radius = np.linspace(5.0, 15.0, 101)
    square = (radius / np.asarray(core_radius)[..., None]) ** 2
    values = mixed(square, model, np.asarray(departure)[..., None])[0] * square
    return np.asarray(scipy.integrate.trapezoid(values, radius) / 10)


def motion(
    vortices: np.ndarray, wind: np.ndarray, reference: float, ground: float | None, model: Model
) -> np.ndarray:
    """Velocity (..., vortices, 2) of vortices along y and z, m/s.

    It is the wind at their height, the induction of each other, and that of the image vortices of
    opposite circulation below the ground. The wind is a polynomial of the height above the
    reference (m): m/s, m/s per m, ...
    """
    y, z, circulation, core = np.moveaxis(vortices, -1, 0)
    above = z - reference
    v = sum(wind[..., k, None] * above**k for k in range(wind.shape[-1]))
    w = np.zeros_like(z)
    for image in (False, True) if ground is not None else (False,):
        height = 2 * ground - z if image and ground is not None else z
        strength = -circulation if image else circulation
        dy = y[..., :, None] - y[..., None, :]
        dz = z[..., :, None] - height[..., None, :]
        square = np.exp(-2 * core)[..., None, :]
        omega = shape((dy**2 + dz**2) * square, model)[0] * square
        omega = omega * strength[..., None, :] / (2 * np.pi)
        # zero for the vortex itself, at distance 0
        v, w = v - (omega * dz).sum(-1), w + (omega * dy).sum(-1)
    return np.stack([v, w], -1)


def radial_velocity(
    lines: Lines,
    places: np.ndarray,
    strengths: np.ndarray,
    ground: float | None,
    model: Model,
    departure: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Radial velocity of one vortex and its derivatives.

    The distance q of a vortex from a line does not depend on the place along it, so that the
    velocity is q omega.

    places (lines, nodes, 2): y and z of the vortex at the times of the lines' nodes, m.
    strengths (2,): circulation and logarithm of the core radius.
    departure: fraction of the other profile.

    Returns
    -------
    value : (lines, gates) array
    slope : (7, lines, gates) array
        By y, z, circulation, logarithm of the core radius, departure; by y and z times the time of
        the node, s, after `Lines.time`: of a line whose beam moves.
    """
    value, slope = _radial_velocity(lines, places, strengths, None, model, departure)
    if ground is None:
        return value, slope
    image, by = _radial_velocity(lines, places, strengths, ground, model, departure)
    return value + image, slope + by


def node_angles(lines: Lines) -> tuple[np.ndarray, np.ndarray]:
    """Angles (lines, nodes) of the quadrature over the moving beam, and their times, s."""
    offset = lines.span[:, None] * _NODES
    return lines.angle[:, None] + offset, lines.time[:, None] + lines.rate[:, None] * offset


def _radial_velocity(
    lines: Lines,
    places: np.ndarray,
    strengths: np.ndarray,
    mirror: float | None,
    model: Model,
    departure: float,
) -> tuple[np.ndarray, np.ndarray]:
    angle, time = node_angles(lines)
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    y, z = places[..., 0, None], places[..., 1, None]
    if mirror is not None:
        z = 2 * mirror - z
    inverse = np.exp(-2 * strengths[1])
    along = y * cos + z * sin
    across = z * cos - y * sin
    offset = lines.distance - along
    square = (offset**2 + across**2) * inverse
    f, df, more = mixed(square, model, departure)
    # of unit circulation, before the weighting
    unit = inverse / (2 * np.pi)
    omega = f @ lines.weight * unit
    by_square = df @ lines.weight * unit * inverse
    by_offset = (df * offset) @ lines.weight * unit * inverse
    by_core = (f + square * df) @ lines.weight * (-2 * unit)
    by_departure = more @ lines.weight * unit
    gamma = strengths[0] if mirror is None else -strengths[0]
    # the square is offset^2 + across^2: d offset = -(cos, sin), d across = (-sin, cos)
    by_y = gamma * (-sin * omega + 2 * across * (-cos * by_offset - sin * across * by_square))
    by_z = gamma * (cos * omega + 2 * across * (-sin * by_offset + cos * across * by_square))
    sign = 1.0 if mirror is None else -1.0
    by_z, by_gamma = sign * by_z, sign * across * omega
    later = (time - lines.time[:, None])[..., None]
    by_shape = [gamma * across * by_core, gamma * across * by_departure]
    parts = [by_y, by_z, by_gamma, *by_shape, by_y * later, by_z * later]
    return (gamma * across * omega).mean(1), np.stack(parts).mean(2)
