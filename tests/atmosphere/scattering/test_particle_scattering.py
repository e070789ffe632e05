"""Particles against published numbers, independent solvers and closed forms.

Detects: a wrong sign of b1 or b2, spheroids that do not become spheres, a size average or
normalisation off by 1 %. `validation.scattering_matrices` has other solvers; tests/validation runs
it. Tests that compute need the library scatrs.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.atmosphere.scattering import particle_scattering
from lidar_mi.atmosphere.scattering.aerosols import Aerosol, LogNormal
from lidar_mi.atmosphere.scattering.particle_scattering import make_table
from lidar_mi.errors import InputError
from validation.amplitude_matrix import phase_matrix

GREEN = 532e-9


@pytest.fixture
def scatrs():
    return pytest.importorskip("scatrs", reason="scatrs (extra 'particles') is not installed")


def single_size(radius, m, elongation=1.0):
    """All but one radius left out: sizes within 1e-6 of it."""
    sizes = LogNormal(radius, 2.0, radius * (1 - 1e-6), radius * (1 + 1e-6))
    return Aerosol("one", "test", sizes, ((GREEN, m),), elongation)


def one_matrix(x, m, elongation, angle):
    """Efficiencies and normalised elements of particles of one size parameter."""
    make = particle_scattering._sphere if elongation == 1 else particle_scattering._spheroid
    return make(x, m, elongation, np.cos(np.radians(angle)))


# Bohren & Huffman 1983, appendix A: sphere of radius 0.525 um, index 1.55, at 632.8 nm. Angle,
# S11 relative to forward, -S12/S11, S33/S11, S34/S11.
BOHREN_HUFFMAN = np.array(
    [
        [0, 1.0, 0.0, 1.0, 0.0],
        [9, 0.785390, -0.459811e-2, 0.999400, 0.343261e-1],
        [18, 0.356897, -0.458541e-1, 0.986022, 0.160184],
        [27, 0.766119e-1, -0.364744, 0.843603, 0.394076],
        [36, 0.355355e-1, -0.534997, 0.686967, -0.491787],
        [45, 0.701845e-1, 0.959953e-2, 0.959825, -0.280434],
        [54, 0.574313e-1, 0.477927e-1, 0.985371, 0.163584],
        [63, 0.219660e-1, -0.440604, 0.648043, 0.621216],
        [72, 0.125959e-1, -0.831996, 0.203255, -0.516208],
        [81, 0.173750e-1, 0.341670e-1, 0.795354, -0.605182],
        [90, 0.124601e-1, 0.230462, 0.937497, 0.260742],
    ]
)


def test_sphere_of_bohren_and_huffman(scatrs):
    """Their table gives the signs of b1 and b2 in the layout (0,0,a3,b2), (0,0,-b2,a4)."""
    angle = BOHREN_HUFFMAN[:, 0]
    q_ext, q_sca, elements = one_matrix(2 * math.pi * 0.525 / 0.6328, 1.55, 1.0, angle)
    assert q_ext == pytest.approx(3.10543, abs=5e-6)
    assert q_sca == pytest.approx(q_ext, rel=1e-9)
    a1, a2, a3, a4, b1, b2 = elements.T
    got = np.stack([angle, a1 / a1[0], -b1 / a1, a3 / a1, b2 / a1], axis=1)
    np.testing.assert_allclose(got, BOHREN_HUFFMAN, atol=1.1e-6)
    assert (a2 == a1).all() and (a4 == a3).all()


def test_nearly_round_spheroid_is_a_sphere(scatrs):
    """Elongation 1 + 1e-5 against Lorenz-Mie: the two solvers share no formula."""
    angle = np.linspace(0, 180, 37)
    for x in (0.5, 3.0, 8.0):
        sphere = one_matrix(x, 1.53 + 0.008j, 1.0, angle)
        spheroid = one_matrix(x, 1.53 + 0.008j, 1 + 1e-5, angle)
        assert spheroid[0] == pytest.approx(sphere[0], rel=2e-4)
        assert spheroid[1] == pytest.approx(sphere[1], rel=2e-4)
        np.testing.assert_allclose(
            spheroid[2] / sphere[2][:, :1], sphere[2] / sphere[2][:, :1], atol=1e-3
        )


@pytest.fixture
def rustmatrix():
    return pytest.importorskip("rustmatrix", reason="rustmatrix (extra 'test') is not installed")


def amplitudes(solver, incident, scattered, azimuths, alpha, beta):
    solver.set_geometry((incident, scattered, *azimuths, alpha, beta))
    return solver.get_S()


def test_published_amplitude_matrix_of_a_prolate_spheroid(rustmatrix):
    """The test result in the head of Mishchenko's ampld.lp.f (2000, Appl. Opt. 39, 1026).

    Width/length 0.5, equal-surface-area radius 10 (that of equal volume is 0.963711 times it),
    wavelength 2 pi, m = 1.5 + 0.02i. Makes rustmatrix, with the definition of the phase matrix
    used below, a witness for `validation.scattering_matrices`.
    """
    spheroid = rustmatrix.Scatterer(
        radius=9.63711, wavelength=2 * math.pi, m=1.5 + 0.02j, axis_ratio=0.5, ddelt=1e-6, ndgs=4
    )
    s = amplitudes(spheroid, 56.0, 65.0, (114.0, 128.0), 145.0, 52.0)
    expected = [[-5.0941 + 24.402j, -1.9425 + 1.9971j], [-1.1521 - 3.0977j, -6.9323 + 24.748j]]
    np.testing.assert_allclose(s, expected, atol=6e-4)
    published = [650.3172, 631.6323, 635.2768, 643.1738, -17.9846, -34.7730]
    np.testing.assert_allclose(phase_matrix(s[None])[0], published, atol=6e-3)


def test_spheroid_table_keeps_every_law(scatrs):
    """A coarse size average through the whole of make_table: `check` has passed when it returns,
    the mean cosine is that of the solver, albedo below one, and without absorption one."""
    small = LogNormal(0.15e-6, 1.5, 0.05e-6, 0.4e-6)
    absorbing = Aerosol("a", "test", small, ((GREEN, 1.53 + 0.008j),), 2.0)
    table = make_table(absorbing, GREEN, nodes=12)
    assert 0.9 < table.albedo < 1
    assert 0 < table.depolarization_ratio < 1
    clear = Aerosol("c", "test", small, ((GREEN, 1.53 + 0j),), 2.0)
    assert make_table(clear, GREEN, nodes=6).albedo == pytest.approx(1, abs=2e-4)
    # one size: the table's mean cosine against the solver's own, from its expansion coefficients
    one = make_table(replace(absorbing, sizes=single_size(0.3e-6, 1.5).sizes), GREEN, nodes=1)
    solver = scatrs.tmatrix.compute(2 * math.pi * 0.3e-6 / GREEN, 1.53 + 0.008j, 0.5)
    assert one.asymmetry == pytest.approx(float(solver.efficiencies().g), abs=3e-4)


def test_size_average_against_an_independent_one(scatrs):
    """The library's own adaptive average over a log-normal, which has no limits of size."""
    sizes = LogNormal(0.1e-6, 1.6, 0.002e-6, 4e-6)
    ours = make_table(Aerosol("a", "t", sizes, ((GREEN, 1.45 + 0.01j),)), GREEN, nodes=3000)
    theirs = scatrs.Ensemble(scatrs.Sphere(1.45 + 0.01j), scatrs.LogNormal(0.1, 1.6)).compute(
        0.532, refine_backscatter=True
    )
    assert ours.extinction_cross_section == pytest.approx(float(theirs.c_ext) * 1e-12, rel=1e-4)
    assert ours.albedo == pytest.approx(float(theirs.ssa), rel=1e-5)
    assert ours.lidar_ratio == pytest.approx(float(theirs.lidar_ratio), rel=1e-3)
    assert ours.asymmetry == pytest.approx(float(theirs.g), abs=3e-4)


def test_missing_library_is_answered_with_the_line_to_type(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "scatrs.mie", None)
    with pytest.raises(InputError, match=r"pip install 'lidar-mi\[particles\]'"):
        make_table("spheres", GREEN)
