"""Ring images and the noise of the CCD.

Rings are compared with the derived radii (0.1 px), whole pixels with an independent quadrature over
gaps, line and pixel (3e-4), noise with its distributions (chi-square) and moments (4 sigma of
750 000 pixels: 0.5 % of a standard deviation, 0.7 % of a variance).
"""

import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy import constants, stats
from scipy.spatial.transform import Rotation

from lidar_mi.atmosphere.scattering.line import backscatter_line, laser_line
from lidar_mi.errors import InputError
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera, doppler_shift, fringe_image, ring_radii

WAVELENGTH = 354.7e-9
AIR = backscatter_line(WAVELENGTH, 232.9, 33154.0, aerosol_fraction=0.1)
LASER = laser_line(WAVELENGTH, 100e6)
ETALON = Etalon()
SOLID = Etalon(index=1.476, gap="9.3 mm")
CAMERA = FringeCamera()
SMALL = FringeCamera(width=60, height=40, pixel=60e-6)
# nothing but the Poisson noise of the light
IDEAL = CCD(read_noise=0, dark_current=0)


def ideal(**changes):
    return IDEAL.model_copy(update=changes)


# rings


@pytest.mark.parametrize("v", [-300.0, 1.0, 300.0])
def test_doppler_shift(v):
    """Light of a moving mirror, nu (1 + v/c) / (1 - v/c): up when it approaches, 5.64 MHz a m/s."""
    beta = v / constants.c
    exact = constants.c / WAVELENGTH * 2 * beta / (1 - beta)
    assert doppler_shift(v, WAVELENGTH) == pytest.approx(exact, rel=1.1 * abs(beta))
    assert doppler_shift(v, WAVELENGTH) / v == pytest.approx(5.64e6, rel=5e-4)


def test_radii_of_the_default_instrument():
    """145.9, 252.7, 326.2, 385.9 px, and 0.075 px a m/s at the first: r dr = f^2 dnu / nu."""
    radii = ring_radii(CAMERA, ETALON, WAVELENGTH)
    assert radii[:4] == pytest.approx([145.9, 252.7, 326.2, 385.9], abs=0.06)
    assert np.all(radii < math.hypot(480, 390)) and len(radii) == 9
    moved = ring_radii(CAMERA, ETALON, WAVELENGTH, 1.0)[0] - radii[0]
    expected = 0.3**2 * 2 / constants.c / (radii[0] * 7.4e-6) / 7.4e-6
    assert moved == pytest.approx(expected, rel=1e-3)
    assert moved == pytest.approx(0.075, abs=5e-4)


def gaussian(count):
    """Nodes and weights of the mean over a standard normal distribution."""
    nodes = np.linspace(-7, 7, count)
    weights = np.exp(-(nodes**2) / 2)
    return nodes, weights / weights.sum()


def slow_pixel(camera, etalon, line, v, column, row):
    """One pixel by brute force: quadrature over its area, the plates and the line."""
    points, area = np.polynomial.legendre.leggauss(6)
    area = np.outer(area, area).ravel() / 4
    x, y = np.meshgrid(column + points / 2, row + points / 2)
    cx, cy = camera.centre
    outside = np.arctan(np.hypot(x - cx, y - cy).ravel() * camera.pixel / camera.focal_length)
    angle = np.arcsin(np.sin(outside) / etalon.index)
    nodes, weights = gaussian(41)
    gaps = etalon.tuned_gap(WAVELENGTH) + etalon.surface_rms * nodes
    total = 0.0
    for fraction, centre, sigma in zip(line.weights, line.offsets, line.sigmas, strict=True):
        for node, weight in zip(*gaussian(101), strict=True):
            nu = constants.c / WAVELENGTH * (1 + 2 * v / constants.c) + centre + sigma * node
            # in long double, for 77 000 orders
            order = (
                np.longdouble(2) * etalon.index * gaps[:, None] * nu / constants.c * np.cos(angle)
            )
            order = (order - np.round(order)).astype(float)
            fringe = 1 / (1 + 4 * 0.7 / 0.3**2 * np.sin(np.pi * order) ** 2)
            total += fraction * weight * float(weights @ fringe @ area)
    return total


@pytest.mark.parametrize(
    "etalon, line, v",
    [(ETALON, AIR, -40.0), (ETALON, LASER, 250.0), (SOLID, AIR, 100.0)],
    ids=["air", "laser", "solid"],
)
def test_pixels_by_brute_force(etalon, line, v):
    """Ratios of pixels, at rings and between, in the middle and in a corner.

    To 3e-4: 850 px from the centre the line is taken as too wide by 2e-4, and flanks feel it.
    """
    camera = FringeCamera(centre=(300, 250.3))
    pixels = [(300, 250), (446, 250), (500, 400), (700, 60), (959, 779)]
    image = fringe_image(camera, etalon, line, v)
    found = np.array([float(image[row, column]) for column, row in pixels])
    expected = np.array([slow_pixel(camera, etalon, line, v, *pixel) for pixel in pixels])
    np.testing.assert_allclose(found / found.sum(), expected / expected.sum(), rtol=3e-4)


def test_one_point_a_pixel_is_as_good_as_stated():
    air = backscatter_line(WAVELENGTH, 232.9, 33154.0)
    fine, coarse = (fringe_image(CAMERA, ETALON, air, subsamples=n) for n in (2, 1))
    assert 1e-3 < float((coarse / fine - 1).abs().max()) < 3e-3


def test_photons_are_those_given():
    assert float(fringe_image(SMALL, ETALON, AIR, photons=1.3e7).sum()) == pytest.approx(1.3e7)


def test_photons_before_the_etalon_are_reduced_by_its_transmission():
    """Over many fringes, the mean of Airy's formula: (1 - R) / (1 + R)."""
    many = FringeCamera(pixel=60e-6)
    image = fringe_image(many, ETALON, AIR, photons=1e6, counted="before_etalon")
    assert float(image.sum()) / 1e6 == pytest.approx(0.3 / 1.7, rel=2e-3)


def test_speeds_in_one_batch():
    speeds = np.array([-300.0, 0.0, 12.5])
    batch = fringe_image(SMALL, ETALON, AIR, speeds)
    assert batch.shape == (3, 40, 60) and batch.dtype == torch.float64
    for image, speed in zip(batch, speeds, strict=True):
        torch.testing.assert_close(image, fringe_image(SMALL, ETALON, AIR, float(speed)))
    assert fringe_image(SMALL, ETALON, AIR, 0.0).shape == (40, 60)


def test_centre_moves_the_image():
    here, there = (
        fringe_image(FringeCamera(width=60, height=40, centre=c), ETALON, AIR)
        for c in ((-100, 200), (-98, 203))
    )
    torch.testing.assert_close(here[:-3, :-2] / here[0, 0], there[3:, 2:] / there[3, 2])


def test_illumination():
    """A Gaussian of 1/e^2 radius 2 mm about the centre, over that of even light.

    To 1e-3, for in both the fringes rise or fall within a pixel.
    """
    settings = {"width": 600, "height": 3, "centre": (0, 1)}
    dim, even = (
        fringe_image(FringeCamera(**settings, **light), ETALON, AIR)[1]
        for light in ({"illumination_radius": "2 mm"}, {})
    )
    ratio = (dim / even).numpy()
    radius = np.arange(600) * 7.4e-3
    np.testing.assert_allclose(ratio / ratio[0], np.exp(-(radius**2) / 2), rtol=1e-3)


# noise


def flat(mean, shape=(780, 960)):
    return torch.full(shape, float(mean), dtype=torch.float64)


def assert_moments(values, mean, variance, sigmas=4):
    values = np.asarray(values, float).ravel()
    n, deviation = len(values), values - mean
    assert abs(deviation.mean()) < sigmas * math.sqrt(variance / n)
    spread = math.sqrt((np.mean(deviation**4) - variance**2) / n)
    assert abs(np.mean(deviation**2) - variance) < sigmas * spread
    assert spread < 0.03 * variance


@pytest.mark.parametrize(
    "modes, law",
    [
        (math.inf, stats.poisson(32)),
        (1.0, stats.nbinom(1, 1 / 33)),
        (10.0, stats.nbinom(10, 10 / 42)),
    ],
)
def test_light_is_poisson_and_speckled_light_negative_binomial(modes, law, chi_square_p):
    counts = expose(flat(32), IDEAL, seed=2, modes=modes)[0].numpy().ravel()
    assert chi_square_p(counts, law) > 1e-3


@pytest.mark.parametrize(
    "changes, modes, mean, variance",
    [
        ({}, math.inf, 32, 32),
        ({}, 10.0, 32, 32 + 32**2 / 10),
        ({}, 350.0, 32, 32 + 32**2 / 350),
        ({"quantum_efficiency": 0.6}, 10.0, 19.2, 19.2 + 19.2**2 / 10),
        ({"read_noise": 5.0, "bits": None}, math.inf, 32, 32 + 25),
        # rounding adds that of an even distribution over a step
        ({"read_noise": 5.0}, math.inf, 32, 32 + 25 + 1 / 12),
        ({"read_noise": 5.0, "gain": 8.0}, math.inf, 32, 32 + 25 + 8**2 / 12),
        ({"dark_current": 400.0, "integration_time": 0.02}, 10.0, 40, 40 + 32**2 / 10),
    ],
)
def test_moments_of_every_noise(changes, modes, mean, variance):
    assert_moments(expose(flat(32), ideal(**changes), seed=3, modes=modes), mean, variance)


def test_background_is_incoherent_and_left_in():
    counts = expose(flat(20), ideal(quantum_efficiency=0.5), seed=4, modes=5.0, background=30.0)
    assert_moments(counts, 10 + 15, 25 + 10**2 / 5)


def test_modes_of_every_pixel():
    modes = torch.full((780, 960), math.inf)
    modes[:, 480:] = 4.0
    counts = expose(flat(32), IDEAL, seed=5, modes=modes)[0]
    assert_moments(counts[:, :480], 32, 32)
    assert_moments(counts[:, 480:], 32, 32 + 32**2 / 4)


def test_full_well():
    counts = expose(flat(1000), ideal(full_well=1000.0), seed=6)
    # half of the pixels are full, the others at least not above
    assert float(counts.max()) == 1000
    law = stats.poisson(1000)
    expected = float(law.sf(999))
    found = float((counts == 1000).double().mean())
    assert abs(found - expected) < 4 * math.sqrt(expected * (1 - expected) / counts.numel())


def test_digitiser_clips_at_both_ends():
    """6 bits, bias 10 and 2 electrons a step: -20 to 106 electrons."""
    noisy = ideal(read_noise=60.0, gain=2.0, bits=6, bias=10)
    counts = expose(flat(32), noisy, seed=7)
    assert (float(counts.min()), float(counts.max())) == (-20, 106)
    assert bool((counts % 2 == 0).all())


def test_an_image_is_its_seed_and_number_whatever_the_batch():
    expected = fringe_image(SMALL, ETALON, AIR, photons=1e5)
    settings = {"ccd": CCD(), "seed": 9, "modes": 10.0}
    four = expose(expected, images=4, **settings)
    assert four.shape == (4, 40, 60) and four.dtype == torch.float32
    torch.testing.assert_close(four[2:], expose(expected, images=[2, 3], **settings))
    torch.testing.assert_close(four, expose(expected.expand(4, 40, 60), **settings))
    assert expose(expected, **settings).shape == (1, 40, 60)


def test_images_and_seeds_are_independent():
    """Correlation of any two images, of neighbouring numbers, seeds and both, within 4.5 sigma."""
    images = torch.cat([expose(flat(32, (300, 400)), CCD(), k, images=4) for k in range(4)])
    correlation = np.corrcoef(images.reshape(16, -1).numpy())
    apart = correlation[~np.eye(16, dtype=bool)]
    assert abs(apart).max() < 4.5 / math.sqrt(300 * 400)


# bad input


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"focal_length": 0}, "focal_length"),
        ({"pixel": "-7 um"}, "pixel"),
        ({"width": 0}, "width"),
        ({"centre": (math.nan, 0)}, "centre"),
        ({"illumination_radius": 0}, "illumination_radius"),
    ],
)
def test_bad_cameras(changes, words):
    with pytest.raises(ValidationError, match=words):
        FringeCamera(**changes)


@pytest.mark.parametrize(
    "changes", [{"quantum_efficiency": 1.1}, {"read_noise": -1}, {"gain": 0}, {"bits": 0}]
)
def test_bad_ccds(changes):
    with pytest.raises(ValidationError, match=next(iter(changes))):
        CCD(**changes)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: fringe_image(SMALL, ETALON, AIR, math.nan), "v_los: nan"),
        (lambda: fringe_image(SMALL, ETALON, AIR, photons=-1), "photons: -1"),
        (lambda: fringe_image(SMALL, ETALON, AIR, counted="all"), "counted: 'all'.*detected or"),
        (lambda: fringe_image(SMALL, ETALON, AIR, subsamples=3), "subsamples: 3 .*1 or 2"),
        (lambda: expose(flat(-1), CCD(), 1), "expected: negative or not finite"),
        (lambda: expose(flat(math.nan), CCD(), 1), "expected: negative or not finite"),
        (lambda: expose(torch.ones(3), CCD(), 1), "expected: 1 dimensions"),
        (lambda: expose(flat(1), CCD(), 1, modes=0.0), "modes"),
        (lambda: expose(flat(1), CCD(), 1, background=-1.0), "background: -1"),
        (lambda: expose(flat(1), CCD(), -1), "seed: -1"),
        (lambda: expose(flat(1), CCD(), 1, images=[-1]), "images: -1"),
        (lambda: expose(flat(1).expand(2, -1, -1), CCD(), 1, images=3), "images: 3 .*each of 2"),
    ],
)
def test_bad_calls(call, words):
    with pytest.raises(InputError, match=words):
        call()


# ---------------------------------------------------------------- a real camera

COARSE = {"width": 96, "height": 78, "pixel": "74 um"}


def test_a_tilted_camera_by_rotations():
    """Pixels are points of a plane turned about its y, then its x axis, projected from the lens."""
    camera = FringeCamera(**COARSE, tilt=["60 mrad", "-40 mrad"], centre=(40.0, 30.5))
    x = (np.arange(96) - 40) * 74e-6
    y = (np.arange(78) - 30.5) * 74e-6
    plane = np.stack([*np.meshgrid(x, y), np.zeros((78, 96))], -1)
    # larger x, larger y farther away
    turned = Rotation.from_rotvec([-0.04, 0, 0]) * Rotation.from_rotvec([0, -0.06, 0])
    points = turned.apply(plane.reshape(-1, 3)) + np.array([0, 0, 0.3])
    ideal = 0.3 * points[:, :2] / points[:, 2:]
    found = camera.radius_squared().ravel()
    np.testing.assert_allclose(found, (ideal**2).sum(1), rtol=1e-12, atol=1e-18)


def test_distortion_moves_pixels_out():
    camera = FringeCamera(**COARSE, distortion=0.02)
    upright = FringeCamera(**COARSE)
    ideal = np.sqrt(camera.radius_squared())
    distorted = ideal * (1 + 0.02 * (ideal / camera.half_diagonal) ** 2)
    np.testing.assert_allclose(distorted, np.sqrt(upright.radius_squared()), rtol=1e-12)


@pytest.mark.parametrize("defect", [{"distortion": -0.03}, {"tilt": ["0.1 rad", "0 rad"]}])
def test_light_falls_on_areas_of_the_ideal_image(defect):
    """Even light per solid angle: a pixel has as much as its area there, by finite differences."""
    camera = FringeCamera(**COARSE, centre=(47.5, 39.0), **defect)
    pixel, row = 74e-6, (39, slice(60, None))
    # y is 0 along the row through the centre
    right, left = (np.sqrt(camera.radius_squared((dx, 0.0))[row]) for dx in (0.01, -0.01))
    along = (right - left) / (0.02 * pixel)
    if "tilt" in defect:
        # x does not depend on y
        off, on = (camera.radius_squared((0.0, dy))[row] for dy in (0.1, 0.0))
        across = np.sqrt(off - on) / (0.1 * pixel)
    else:
        across = np.sqrt(camera.radius_squared()[row]) / ((np.arange(60, 96) - 47.5) * pixel)
    np.testing.assert_allclose(camera.ideal_image()[1][row], along * across, rtol=1e-5)


def test_a_lens_out_of_focus_spreads_every_point_over_a_disc():
    """Mean of 400 shifted images, evenly over the disc, against the seven of the program."""
    sharp, blurred = FringeCamera(**COARSE), FringeCamera(**COARSE, defocus="60 um")
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(400)
    radius = 30 / 74 * np.sqrt((np.arange(400) + 0.5) / 400)
    middle = np.array(sharp.centre_pixel)
    mean = 0
    for x, y in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
        moved = sharp.model_copy(update={"centre": tuple((middle + np.array([x, y])).tolist())})
        mean = mean + fringe_image(moved, ETALON, AIR, 50.0, 1.0).numpy() / 400
    found = fringe_image(blurred, ETALON, AIR, 50.0, 1.0).numpy()
    change = np.abs(mean / fringe_image(sharp, ETALON, AIR, 50.0, 1.0).numpy() - 1).max()
    assert change > 0.02
    np.testing.assert_allclose(found, mean, rtol=0.05 * change)


def test_hot_and_dead_pixels():
    """Their numbers are exact, their places the chip's; hot ones have the mean 500 kHz x 10 ms."""
    ccd = CCD(hot_pixels=0.01, dead_pixels=0.02, read_noise=0.0, dark_current=0.0, bits=None)
    light = torch.full((100, 120), 50.0)
    one, other = (expose(light, ccd, 3, [number])[0] for number in (0, 1))
    hot, dead = one > 1000, one == 0
    assert (int(hot.sum()), int(dead.sum())) == (120, 240)
    assert torch.equal(hot, other > 1000) and torch.equal(dead, other == 0)
    # 240 Poisson numbers of mean 5050
    mean = float(torch.cat([one[hot], other[hot]]).mean())
    assert mean == pytest.approx(5050, abs=4 * math.sqrt(5050 / 240))
    assert not torch.equal(
        hot, expose(light, ccd.model_copy(update={"response_seed": 1}), 3)[0] > 1000
    )
    # what the others see is what they would without
    whole = ccd.model_copy(update={"hot_pixels": 0.0, "dead_pixels": 0.0})
    usual = ~(hot | dead)
    assert float(one[usual].mean()) == pytest.approx(50, abs=4 * math.sqrt(50 / usual.sum()))
    assert float(expose(light, whole, 3).max()) < 200
