"""Partial overlap: rendered signals against a brute-force Monte Carlo of the geometry in numpy.

Where the field of view cuts the beam and the telescope is large against the range there is no
closed form. The reference draws the collision anywhere along the ray and asks afterwards whether
its path falls into the gate (the renderer inverts the path), scatters fields of dipoles (the
renderer multiplies Mueller matrices), and knows the beam as the axis x alone.

Detects: 1 % of S0, S1 and S2, from every piece of the geometry: inversion of the path and its
Jacobian, field of view, obliquity of the telescope, truncation, phase function off 180 degrees.
"""

import functools
import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

BEAMS = 36  # the same beam again and again, for the statistics of every component


@dataclass(frozen=True)
class Case:
    gate: tuple[float, float]
    aperture_radius: float
    fov_half_mrad: float
    divergence_full_mrad: float
    beam_radius: float
    beam_cut: float
    extinction: float = 1e-3
    pulse_duration: float = 0.0


CASES = {
    # the paper's instrument with too narrow a field of view
    "narrow field of view": Case((500.0, 502.5), 0.5, 0.6, 2.0, 0.1, 0.1),
    "telescope beside the beam": Case((100.0, 110.0), 2.0, 12.0, 2.0, 0.1, 0.1),
    # parallax of up to 10 degrees: gates are ellipsoids, dipoles are seen from aside
    "near and wide": Case((20.0, 25.0), 3.0, 120.0, 60.0, 0.5, 0.8, 2e-2),
    "near, wide, cut by the view": Case((8.0, 9.0), 3.0, 250.0, 200.0, 1.0, 2.0, 5e-2),
    # parallax of up to 45 degrees: obliquity and the path's Jacobian far from those of backscatter
    "nearer than wide": Case((3.0, 4.0), 3.0, 1200.0, 100.0, 0.3, 0.6, 5e-2),
    "near, wide, long pulse": Case((20.0, 25.0), 3.0, 120.0, 60.0, 0.5, 0.8, 2e-2, 30e-9),
}
# of which each is like one of the others
RARE = (
    "near, wide, cut by the view",
    "telescope beside the beam",
    "near, wide, long pulse",
    "nearer than wide",
)


@functools.cache
def reference(case, rounds=3):
    """Means and standard errors of S0, S1, S2, from a million photons a round, seed 2."""
    rng = np.random.default_rng(2)
    means, errors = zip(*(one_round(case, rng, 1_000_000) for _ in range(rounds)), strict=True)
    return np.mean(means, 0), np.linalg.norm(errors, axis=0) / rounds


def one_round(case, rng, number):
    """The same from ``number`` photons; the beam goes along x, e_h = y."""

    def disc(radius, fraction):
        azimuth = 2 * np.pi * rng.random(number)
        return radius(fraction) * np.cos(azimuth), radius(fraction) * np.sin(azimuth)

    # the beam, by rejection: uncut Gaussian radii, those beyond the cut drawn again
    y, z = np.empty((2, number))
    missing = np.arange(number)
    while missing.size:
        y[missing], z[missing] = rng.normal(0, case.beam_radius / 2, (2, missing.size))
        missing = missing[np.hypot(y[missing], z[missing]) > case.beam_cut]
    origin = np.stack([np.zeros(number), y, z], -1)
    slope = rng.normal(0, case.divergence_full_mrad * 1e-3 / 4, (2, number))
    out = np.stack([np.ones(number), *slope], -1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)

    y, z = disc(lambda fraction: case.aperture_radius * np.sqrt(fraction), rng.random(number))
    telescope = np.stack([np.zeros(number), y, z], -1)

    sigma = 299_792_458.0 / 2 * case.pulse_duration / (2 * math.sqrt(2 * math.log(2)))
    delay = sigma * rng.standard_normal(number)
    # the way back differs from the way out by no more than the telescope point from the origin
    slack = (case.aperture_radius + case.beam_cut) / 2 + 6 * sigma
    first, last = max(case.gate[0] - slack, 0.0), case.gate[1] + slack
    distance = rng.uniform(first, last, number)
    place = origin + distance[:, None] * out
    back = telescope - place
    length = np.linalg.norm(back, axis=1)
    back /= length[:, None]
    path = (distance + length) / 2 + delay

    observed = (path >= case.gate[0]) & (path < case.gate[1])
    observed &= np.arccos(np.clip(-back[:, 0], -1, 1)) <= case.fov_half_mrad * 1e-3
    area = math.pi * case.aperture_radius**2
    weight = observed * case.extinction * np.exp(-case.extinction * (distance + length))
    weight = weight * area * -back[:, 0] / length**2 * (last - first)

    # a dipole along the transverse part of e_h; its field where it leaves for the telescope
    dipole = np.array([0.0, 1.0, 0.0]) - out * out[:, 1:2]
    dipole /= np.linalg.norm(dipole, axis=1, keepdims=True)
    field = dipole - back * (back * dipole).sum(1, keepdims=True)
    horizontal = np.array([0.0, 1.0, 0.0]) - back * back[:, 1:2]
    horizontal /= np.linalg.norm(horizontal, axis=1, keepdims=True)
    along = (field * horizontal).sum(1)
    across = (field * np.cross(back, horizontal)).sum(1)
    stokes = np.stack([along**2 + across**2, along**2 - across**2, 2 * along * across])
    stokes *= 3 / (8 * math.pi) * weight
    return stokes.mean(1), stokes.std(1) / math.sqrt(number)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "pose"),
    [pytest.param(name, "as it is", marks=[pytest.mark.slow] * (name in RARE)) for name in CASES]
    + [("narrow field of view", "turned and moved"), ("near and wide", "turned and moved")],
)
def test_partial_overlap(world, name, pose):
    """Turned about the vertical, e_h turns along: the same Stokes vector. Seeds 1 and 2."""
    case = CASES[name]
    yaw = 0.0 if pose == "as it is" else 0.3
    photons = 20_000
    beam = [math.cos(yaw), math.sin(yaw), 0.0]
    to_world = mi.ScalarTransform4f()
    if yaw:
        # half of the turn by the table, half by the pose
        to_world = to_world.translate([30, -20, 10]).rotate([0, 0, 1], math.degrees(yaw))
    sensor = world.lidar(
        (BEAMS, 1),
        case.gate,
        {
            "beam_radius": case.beam_radius,
            "beam_cut": case.beam_cut,
            "divergence_full_mrad": case.divergence_full_mrad,
            "pulse_duration": case.pulse_duration,
        },
        environment=world.homogeneous(case.extinction),
        directions=mi.TensorXf(np.tile(beam, (BEAMS, 1))),
        gate_kind="spherical",
        aperture_radius=case.aperture_radius,
        fov_half_mrad=case.fov_half_mrad,
        to_world=to_world,
    )
    stokes, error = world.render(world.scene(sensor), seed=1, spp=photons)
    beams = stokes[0, :3, 0]
    found, spread = beams.mean(1), beams.std(1, ddof=1) / math.sqrt(BEAMS)
    expected, uncertainty = reference(case)

    both = np.hypot(spread, uncertainty)
    assert both[0] / expected[0] < 3e-3
    assert np.abs((found - expected) / both).max() < 4.5
    # the rendered error bar describes the spread over equal beams: chi-square, 4 sigma
    z2 = ((beams[0] - found[0]) ** 2 / error[0, 0] ** 2).sum()
    assert abs(z2 - (BEAMS - 1)) < 4 * math.sqrt(2 * (BEAMS - 1))
    # the case is what its name says: something is lost, or the geometry is far from ideal
    ideal = reference_full_overlap(case)
    assert abs(expected[0] / ideal - 1) > 0.02


def reference_full_overlap(case):
    """The lidar equation with everything in view."""
    r = np.linspace(*case.gate, 1001)
    area = math.pi * case.aperture_radius**2
    value = case.extinction * np.exp(-2 * case.extinction * r) / r**2
    return 3 / (8 * math.pi) * area * np.trapezoid(value, r)
