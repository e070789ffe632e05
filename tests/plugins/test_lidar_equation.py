"""Rendered scans against the single-scattering lidar equation, integrated in numpy.

Full overlap: telescope 0.5 m, field of view 5 mrad, beam 2 mrad. What the equation leaves out (the
finite beam and telescope) is 1e-6 of the signal at 500 m.

Detects: a medium, gate or pulse that enters wrongly, a majorant that matters.
`validation.lidar_equation` has the paper's whole scan and a valley of extinction.
"""

import itertools
import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf

pytestmark = pytest.mark.usefixtures("variant")

RAYLEIGH_BACKSCATTER = 3 / (8 * math.pi)
AREA = math.pi * 0.5**2
# of a mean over a scan, relative: float32 ranges, finite beam
TRUNCATION = 1e-5


def lidar_equation(edges, extinction, depth, breaks=()):
    """Received over emitted energy of gates: the integral of A p sigma exp(-2 tau) / R^2.

    Gauss-Legendre of 12 nodes between the breaks, exact to 1e-12 for gates much shorter than R.

    Parameters
    ----------
    edges : (gates + 1, ...) array
        Ranges along each beam, m.
    extinction, depth : functions
        Scattering coefficient (1 / m) and optical depth as functions of the range.
    breaks : sequence of arrays
        Ranges along each beam where the extinction jumps, ascending.
    """
    total = 0.0
    for begin, end in itertools.pairwise([-np.inf, *breaks, np.inf]):
        low, high = (np.clip(e, begin, end) for e in (edges[:-1], edges[1:]))
        for node, weight in zip(*np.polynomial.legendre.leggauss(12), strict=True):
            r = (low + high) / 2 + (high - low) / 2 * node
            part = AREA * RAYLEIGH_BACKSCATTER * extinction(r) / r**2 * np.exp(-2 * depth(r))
            total = total + weight * (high - low) / 2 * part
    return total


def secants(scene, shape):
    """1 / cos between beam and x, (rows, columns)."""
    directions = np.array(mi.traverse(scene)["sensor.directions"]).reshape(*shape, 3)
    return 1 / directions[..., 0].astype(float)


SCAN = {
    "azimuth_min_deg": -6.2,
    "azimuth_max_deg": 6.2,
    "elevation_min_deg": -3.9,
    "elevation_max_deg": 3.9,
}


def slab_scene(world, size=(219, 139), gate=(500.0, 502.5), slab=None, low=490.0, high=512.0, **kw):
    """A slab from ``low`` to ``high``, wider than the scan, in an environment of 1e-4 / m."""
    return world.scene(
        world.lidar(size, gate, environment=world.ENVIRONMENT, **(SCAN | kw)),
        environment=world.homogeneous(1e-4),
        slab=world.box(
            [low, -65, -45], [high, 65, 45], slab or world.homogeneous(2e-2), world.ENVIRONMENT
        ),
    )


class TestGates:
    def test_spherical_and_planar_gates_cut_out_their_own_ranges(self, world, statistics):
        """Beams up to 40 degrees off: a planar gate is longer there by 1.3, and farther away."""
        photons = 2000
        angles = {"azimuth_min_deg": -40.0, "azimuth_max_deg": 40.0, "elevation_max_deg": 20.0}
        for kind in ("spherical", "planar"):
            scene = world.scene(
                world.lidar(
                    (41, 5),
                    (300.0, 310.0),
                    gate_kind=kind,
                    gate_count=2,
                    environment=world.homogeneous(2e-3),
                    **angles,
                )
            )
            stokes, error = world.render(scene, seed=6, spp=2 * photons)
            scale = secants(scene, (5, 41)) if kind == "planar" else np.ones((5, 41))
            edges = np.array([300, 305, 310])[:, None, None] * scale
            truth = lidar_equation(edges, lambda r: 2e-3 + 0 * r, lambda r: 2e-3 * r)
            for gate in range(2):
                statistics.assert_agree(
                    stokes[gate, 0], error[gate], truth[gate], photons, bias=TRUNCATION
                )

    def test_many_gates_are_the_single_gates_one_by_one(self, world, statistics):
        """And their sum is the signal of one gate over all of them."""
        photons, gates = 1000, 8
        low, high = 495.0, 505.0
        step = (high - low) / gates
        size = (15, 10)
        # a front inside the gates: they differ
        scene = slab_scene(world, size, (low, high), low=498.0, gate_count=gates)
        many, error = world.render(scene, seed=7, spp=gates * photons)
        ones, ones_error = [], []
        for gate in range(gates):
            one = slab_scene(world, size, (low + gate * step, low + (gate + 1) * step), low=498.0)
            stokes, single = world.render(one, seed=100 + gate, spp=photons)
            ones.append(stokes[0, 0])
            ones_error.append(single[0])
        statistics.assert_agree(many[:, 0], np.hypot(error, ones_error), ones, photons)
        assert (many[4:, 0] > 30 * many[:1, 0]).all()
        together, total_error = world.render(
            slab_scene(world, size, (low, high), low=498.0), seed=8, spp=gates * photons
        )
        both = np.sqrt((error**2).sum(0) + total_error[0] ** 2)
        statistics.assert_agree(many[:, 0].sum(0), both, together[0, 0], gates * photons)

    def test_every_gate_gets_the_same_number_of_samples(self, world):
        """Samples that do not divide by the gates are rounded up: the same image."""
        images = [
            world.render(
                slab_scene(world, (5, 4), (500.0, 508.0), gate_count=4), seed=9, spp=samples
            )[0]
            for samples in (13, 16)
        ]
        assert np.array_equal(*images)

    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_long_pulse_smears_an_edge_as_an_error_function(self, world, statistics, estimator):
        """A slab begins at 500 m; a pulse of 10 ns (fwhm) has 0.64 m rms in range."""
        duration = 10e-9
        sigma = 299_792_458.0 / 2 * duration / (2 * math.sqrt(2 * math.log(2)))
        gates, photons = 32, 4000
        analog = estimator == "analog"
        extinction = 0.5 if analog else 1e-4  # deep penetration, or photons enough
        scene = world.scene(
            world.lidar(
                (2, 2) if analog else (6, 6),
                (497.5, 502.5),
                {"pulse_duration": duration},
                gate_count=gates,
                azimuth_min_deg=-0.5,
                azimuth_max_deg=0.5,
            )
            | {"elevation_min_deg": -0.5, "elevation_max_deg": 0.5},
            {"estimator": estimator},
            slab=world.box([500, -65, -45], [530, 65, 45], world.homogeneous(extinction)),
        )
        samples = 400_000 if analog else gates * photons
        stokes, error = world.render(scene, seed=10, spp=samples)
        profile, spread = stokes[:, 0].mean((1, 2)), np.sqrt((error**2).sum((1, 2))) / error[0].size
        edges = np.linspace(497.5, 502.5, gates + 1)

        # emitted at delay d (in range), scattered at r - d: the signal of a step, convolved
        delay = np.linspace(-6, 6, 2401) * sigma
        weight = np.exp(-0.5 * (delay / sigma) ** 2)
        weight /= weight.sum()
        fraction = np.linspace(0, 1, 101)
        ranges = edges[:-1] + fraction[:, None] * (edges[1:] - edges[:-1])
        place = ranges[..., None] - delay
        signal = AREA * RAYLEIGH_BACKSCATTER * extinction / place**2
        signal *= np.exp(-2 * extinction * np.maximum(place - 500, 0)) * (place >= 500)
        truth = np.trapezoid((signal * weight).sum(-1), ranges, axis=0)
        # the numerical convolution is good: the thin slab's profile is the error function
        if not analog:
            middle = (edges[1:] + edges[:-1]) / 2
            shape = 0.5 * (1 + erf((middle - 500) / sigma / math.sqrt(2)))
            assert truth / truth[-1] == pytest.approx(shape, abs=2e-2)
        observed = spread > 0
        assert observed.sum() > 25
        z = (profile - truth)[observed] / spread[observed]
        enough = truth[observed] > 1e-3 * truth.max()
        chi2 = (z[enough] ** 2).sum()
        number = enough.sum()
        assert abs(chi2 - number) < 4 * math.sqrt(2 * number)


def test_albedo_scales_the_signal_alone(world):
    """Half the light absorbed at the collision; extinction stays. Same random numbers."""
    images = []
    for albedo in (1.0, 0.5):
        scene = slab_scene(world, (5, 4), slab=world.homogeneous(2e-2, albedo=albedo))
        images.append(world.render(scene, seed=11)[0][0, 0])
    assert images[1] / images[0] == pytest.approx(0.5, rel=1e-6)


def test_pulse_energy_and_wavelength_do_not_change_the_relative_signal(world):
    images = []
    for laser in ({}, {"pulse_energy": 1e-3, "wavelength": 354.7e-9}):
        scene = slab_scene(world, (5, 4), laser=laser)
        images.append(world.render(scene, seed=13)[0])
    assert np.array_equal(*images)
