"""The generator of frames with defects: that its defects are the ones named.

Detects: a sign or axis of tilt, distortion, slope or shift, a wrong part of the pupil, a blur of
another width, light lost, noise of another size, and a random place that changes.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate
from scipy.spatial.transform import Rotation

from validation import fringe_reference as reference
from validation.fringe_reference import Defects, Instrument, Light

SMALL = Instrument().binned(4)
NONE = Defects()


def test_a_pixel_by_adaptive_quadrature():
    """Airy's formula over line, roughness and area of single pixels, by scipy's own integrals."""
    instrument = Instrument(shape=(270, 470), centre=(20.0, 10.0))
    frame = reference.air_frame(instrument, NONE, 50.0, photons=1.0).signal
    sigma = math.hypot(reference.rayleigh_sigma(instrument), reference.laser_sigma(instrument))
    width = math.hypot(sigma * 2 * 13.7e-3 / 299792458, 2 * 2e-9 / 354.7e-9)
    gauss = np.linspace(-7, 7, 1401)
    weight = np.exp(-(gauss**2) / 2)

    def light(y, x):
        cosine = math.cos(math.atan(math.hypot(x, y) * 7.4e-6 / 0.3))
        m = 77248.5 * (1 + 2 * 50.0 / 299792458) * cosine
        airy = 1 / (1 + 4 * 0.7 / 0.3**2 * np.sin(np.pi * (m + width * gauss)) ** 2)
        return float((weight * airy).sum() / weight.sum())

    places = [(0, 0), (10, 20), (200, 300), (120, 460), (265, 77)]
    exact = [
        integrate.dblquad(light, c - 20.5, c - 19.5, r - 10.5, r - 9.5, epsabs=1e-7)[0]
        for r, c in places
    ]
    got = np.array([frame[place] for place in places])
    np.testing.assert_allclose(got / got[2], np.array(exact) / exact[2], rtol=2e-5)


def test_tilted_camera_by_intersection():
    """A ray found by solving for the point of the plane, for both axes at once."""
    tilt, f = (0.02, -0.03), 0.3
    axes = Rotation.from_euler("xy", tilt).as_matrix()
    for ray in ([0.01, 0.0, 1.0], [0.0, 0.012, 1.0], [-0.008, 0.009, 1.0]):
        # n.(t ray - f z) = 0
        along = f * axes[2, 2] / (axes[:, 2] @ ray)
        point = axes.T @ (along * np.array(ray) - [0, 0, f])
        assert abs(point[2]) < 1e-15
        got = reference.cosine(Instrument(), Defects(tilt=tilt), *np.longdouble(point[:2]))
        assert float(got) == pytest.approx(1 / np.linalg.norm(ray), abs=1e-15)


def test_distortion_and_focal_length():
    instrument, k = Instrument(), -2e-3
    r = 0.7 * instrument.half_diagonal
    seen = r * (1 + k * 0.7**2)
    got = reference.cosine(
        instrument, Defects(distortion=k, focal_length=1.0), np.longdouble(seen), np.longdouble(0)
    )
    assert float(got) == pytest.approx(1 / math.hypot(1, r / 0.3), abs=1e-16)
    place = np.longdouble([0, r])
    longer = reference.cosine(instrument, Defects(focal_length=1.01), *place)
    assert float(longer) == pytest.approx(1 / math.hypot(1, r / 0.303), abs=1e-15)


def moments(image):
    y, x = np.indices(image.shape)
    total = image.sum()
    x0, y0 = (x * image).sum() / total, (y * image).sum() / total
    return total, ((x - x0) ** 2 * image).sum() / total, ((y - y0) ** 2 * image).sum() / total


def test_blur_is_a_disc():
    """Light is kept, and the variance grows by that of a disc, radius^2 / 4 along each axis."""
    y, x = np.indices((61, 81))
    spot = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 2 / 2.0**2)
    blurred = reference._blurred(spot, 2.5)
    before, after = moments(spot), moments(blurred)
    assert after[0] == pytest.approx(before[0], rel=1e-12)
    assert after[1] - before[1] == pytest.approx(2.5**2 / 4, rel=1e-6)
    assert after[2] - before[2] == pytest.approx(2.5**2 / 4, rel=1e-6)
    # and its profile: light within the disc, by direct sums
    exact = [
        np.exp(-((r - 40) ** 2 + (s - 30) ** 2) / 8)
        for r, s in zip(*disc(2.5, 44.0, 30.0), strict=True)
    ]
    assert blurred[30, 44] == pytest.approx(np.mean(exact), rel=1e-4)


def disc(radius, x, y, number=400):
    u = np.linspace(-radius, radius, number, endpoint=False) + radius / number
    a, b = np.meshgrid(u, u)
    within = a**2 + b**2 < radius**2
    return x + a[within], y + b[within]


def test_defocus_is_the_mean_of_shifted_frames():
    """Over the disc of the given diameter; next to the edges too, where the margin shows."""
    instrument = Instrument(shape=(120, 150), pixel=22e-6, centre=(40.0, 30.0))
    defects = Defects(defocus=5.0)
    soft = reference.laser_frame(instrument, defects, 1e6).signal
    assert soft.sum() == pytest.approx(1e6, rel=1e-12)
    total = 0.0
    for node, weight in zip(*np.polynomial.legendre.leggauss(3), strict=True):
        for angle in 2 * np.pi * np.arange(8) / 8:
            r = 2.5 * math.sqrt((1 + node) / 2)
            centre = (40 + r * math.cos(angle), 30 + r * math.sin(angle))
            moved = replace(instrument, centre=centre)
            line = ((1.0, reference.laser_sigma(instrument)),)
            total += weight * reference._light(moved, NONE, Light(), line, 1, 2, 0)
    np.testing.assert_allclose(soft, total * 1e6 / total.sum(), rtol=0.01)


def test_pupil_of_bowed_and_wedged_plates():
    instrument, bow = Instrument(), 3e-9
    full = reference.pupil_orders(instrument, Defects(bow=bow), Light())
    assert np.average(full[0], weights=full[1]) == pytest.approx(0, abs=1e-15)
    rms = math.sqrt(np.average(full[0] ** 2, weights=full[1])) * instrument.wavelength / 2
    assert rms == pytest.approx(bow, rel=1e-12)
    half = reference.pupil_orders(instrument, Defects(bow=bow), Light(pupil=0.5))
    narrow = -3 / 8 * math.sqrt(12) * bow * 2 / instrument.wavelength
    assert np.average(half[0], weights=half[1]) == pytest.approx(narrow, rel=1e-12)
    for light, mean in (
        (Light(), 0.0),
        (Light(pupil_shift=0.05), 0.05 * 2),
        (Light(half=True), 4 / (3 * math.pi) * 2),
        (Light(half=True, pupil=0.5, pupil_shift=-0.1), (4 / (6 * math.pi) - 0.1) * 2),
    ):
        orders, weight = reference.pupil_orders(instrument, Defects(wedge=bow), light)
        assert weight.sum() == pytest.approx(1)
        found = np.average(orders, weights=weight)
        # a half disc's mean by Gauss points in rho^2: 2e-4 of it
        exact = mean * bow * 2 / instrument.wavelength
        assert found == pytest.approx(exact, rel=2e-4, abs=1e-15)
    tilted = reference.pupil_orders(instrument, Defects(wedge=bow), Light())
    rms = math.sqrt(np.average(tilted[0] ** 2, weights=tilted[1])) * instrument.wavelength / 2
    assert rms == pytest.approx(bow, rel=1e-12)


@pytest.mark.parametrize(
    ("defects", "speed"),
    [(Defects(warming=1.0), 5e-7 * 299792458 / 2), (Defects(drift=10e6), 354.7e-9 / 2 * 10e6)],
)
def test_shifts_are_speeds(defects, speed):
    shifted = reference.air_frame(SMALL, defects, 10.0).signal
    moved = reference.air_frame(SMALL, NONE, 10.0 + speed).signal
    # the product of two shifts, 1e-13 of the frequency, is 1e-8 orders
    np.testing.assert_allclose(shifted, moved, rtol=1e-7)


def test_hot_and_dead_pixels_and_bump():
    defects = Defects(
        hot_pixels=30, hot_electrons=4000.0, dead_pixels=20, bump=0.2, bump_place=(0.3, 0.2), seed=3
    )
    plain = reference.air_frame(SMALL, NONE, 0.0, 1e7, background=2.0)
    frame = reference.air_frame(SMALL, defects, 0.0, 1e7, background=2.0)
    other = reference.laser_frame(SMALL, defects, 1e7, background=2.0)
    dead = frame.mean == 0
    assert dead.sum() == 20 and (dead == (other.mean == 0)).all()
    np.testing.assert_array_equal(frame.signal[~dead], plain.signal[~dead])
    extra = frame.background - 2.0
    hot = extra > 1000
    assert hot.sum() == 30 and (hot == (other.background > 1000)).all()
    level = 1e7 / plain.signal.size
    assert extra[~hot & ~dead].max() == pytest.approx(0.2 * level, rel=1e-2)
    # most light where the bump is said to be: right of and below the middle
    y, x = np.nonzero(extra == extra[~hot & ~dead].max())
    scale = math.hypot(195, 240) / 2
    assert abs(x[0] - 119.5 - 0.3 * scale) < 1 and abs(y[0] - 97 - 0.2 * scale) < 1


def test_exposures():
    """Mean and variance of 400 frames: Poisson, speckle of the light alone, read noise."""
    instrument = Instrument().binned(30)
    frame = reference.air_frame(instrument, Defects(bump=0.3), 0.0, 166_400.0, background=30.0)
    drawn = reference.exposures(frame, 400, 5, read_noise=6.0, modes=8.0)
    error = np.sqrt(frame.mean + frame.signal**2 / 8 + 36)
    z = (drawn.mean(0) - frame.mean) / error * 20
    assert abs(z.mean()) < 4 / math.sqrt(z.size)
    assert abs((z**2).mean() - 1) < 4 * math.sqrt(2 / z.size)
    ratio = (drawn.var(0, ddof=1) / error**2).mean()
    assert abs(ratio - 1) < 4 * math.sqrt(2.8 / 400 / z.size)
    np.testing.assert_array_equal(drawn[0], reference.exposures(frame, 1, 5, 6.0, 8.0)[0])
