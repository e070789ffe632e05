"""Winds from all rings at once, on images made without the program (`ring_reference`).

Detects: a bias of 0.1 m/s, a standard deviation 1.4 times the Cramer-Rao bound or more, error bars
that are not the scatter, an order lost between -300 and +300 m/s, and images that are no rings but
give a number.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.likelihood_fit import difference, fit_rings
from lidar_mi.retrieval.rings.model import PixelNoise
from tests.support import ring_reference as reference
from tests.support.calibrations import SMALL, air_model
from tests.support.ring_models import TABLE, ring_model
from validation.fringe_reference import Defects, air_frame

# The whole camera in sixteen times fewer pixels: as many photons, the same rings.
COARSE = {"shape": (195, 240), "pixel": 4 * reference.PIXEL}


def coarse(centre):
    return None if centre is None else tuple((c - 1.5) / 4 for c in centre)


@pytest.mark.slow
@pytest.mark.parametrize("v_los", [-300.0, -130.0, 0.0, 51.0, 222.0, 300.0])
@pytest.mark.parametrize("centre", [None, (300.0, 250.0), (485.7, 380.3)])
def test_no_noise_no_error(v_los, centre):
    """Order, cells and start change the velocity by 0.003 m/s at most; no order is lost."""
    image = torch.as_tensor(reference.ring_image(v_los, centre=coarse(centre), **COARSE))
    fit = fit_rings(image, ring_model(**COARSE))
    assert abs(float(fit.v_los) - v_los) < 5e-3
    x, y = coarse(centre) or (119.5, 97.0)
    assert float(fit.of("x")) == pytest.approx(x, abs=1e-3)
    assert float(fit.of("y")) == pytest.approx(y, abs=1e-3)
    assert float(fit.chi_square) < 1e-3 and fit.rings >= 9


def exposures(case, number, seed, v_los=20.0, **size):
    _, photons, noise, centre = TABLE[case]
    centre = coarse(centre) if size else centre
    rng = np.random.default_rng(seed)
    mean = reference.ring_image(v_los, photons, centre, **size)
    drawn = [
        reference.noisy(mean, rng, noise.read_noise, noise.speckle_modes) for _ in range(number)
    ]
    return torch.as_tensor(np.array(drawn, np.float32))


def bound_of(case, v_los=20.0, **size):
    _, photons, noise, centre = TABLE[case]
    centre = coarse(centre) if size else centre
    return cramer_rao(ring_model(**size), photons, noise, v_los=v_los, centre=centre)["v_los"]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] * (case not in ("speckle", "off centre")))
        for case in TABLE
    ],
)
def test_reaches_the_bound(case):
    """64 images: std known to 9 %, mean to 12 % of it; both within 4 sigma."""
    number = 64
    images = exposures(case, number, 7, **COARSE)
    fit = fit_rings(images, ring_model(**COARSE), TABLE[case][2])
    bound = bound_of(case, **COARSE)
    assert fit.v_los.std() < bound * (1 + 4 / np.sqrt(2 * number))
    assert abs(fit.v_los.mean() - 20) < 4 * bound / np.sqrt(number)
    # error bars: the bound at what was found, 1 % of it by noise of the parameters
    torch.testing.assert_close(fit.v_los_std, torch.full_like(fit.v_los, bound), rtol=0.05, atol=0)
    cells = 1 / (fit.chi_square.std() ** 2) * 2  # what its scatter says of their number
    assert abs(fit.chi_square.mean() - 1) < 0.02 and cells > 1000
    # the 2-D fit of the same images finds the same, but for the little that the cells lose
    flat = fit_rings(images[:4], ring_model(**COARSE), TABLE[case][2], method="pixels")
    assert (abs(flat.v_los - fit.v_los[:4]) < bound).all()
    assert (flat.v_los_std / fit.v_los_std[:4] - 1).abs().max() < 0.02


def test_nuisances_do_no_harm():
    """Warmer air, weaker light at the rim, background: found, and not in the velocity."""
    rng = np.random.default_rng(12)
    radius, half2 = 4e-3, (195**2 + 240**2) / 4 * COARSE["pixel"] ** 2
    mean = reference.ring_image(
        -35.0, 2.4e7, (121.3, 95.1), 250.0, radius=radius, background=40.0, **COARSE
    )
    images = np.array([reference.noisy(mean, rng, 5.0, background=40.0) for _ in range(32)])
    fit = fit_rings(torch.as_tensor(images), ring_model(**COARSE), PixelNoise(5))
    truth = (-35.0, 121.3, 95.1, None, 40.0, 250.0, 2 * half2 / radius**2)
    for place, true in enumerate(truth):
        if true is not None:
            score = (fit.values[:, place] - true) / fit.std[:, place]
            assert abs(score.mean()) < 4 / np.sqrt(32), place
            assert abs(score.std() - 1) < 4 / np.sqrt(64), place


def test_images_are_independent_of_each_other():
    """A batch gives what its images give alone, one with another centre among them too."""
    model = ring_model(**COARSE)
    centres = [(119.5, 97.0), (119.9, 97.4), (131.0, 90.0)]
    images = torch.as_tensor(
        np.array(
            [reference.ring_image(10.0 * k, centre=c, **COARSE) for k, c in enumerate(centres)]
        )
    )
    together = fit_rings(images, model)
    for k, image in enumerate(images):
        alone = fit_rings(image, model)
        assert abs(float(together.v_los[k] - alone.v_los)) < 2e-3
        assert abs(float(together.v_los[k]) - 10 * k) < 5e-3
    np.testing.assert_allclose(together.of("x"), [c[0] for c in centres], atol=1e-3)


@pytest.mark.parametrize("method", ["annular", "pixels"])
def test_calibration_error_is_in_the_speed(method):
    """As a fit with that error in its model tells; the zero shifts all speeds."""
    image = torch.as_tensor(reference.ring_image(40.0, **COARSE))
    zero, relative = 0.2, 2e-5
    covariance = np.zeros((8, 8))
    covariance[0, 0], covariance[1, 1] = zero**2, relative**2
    known = {"centre": (119.5, 97.0), "free": ("v_los", "level", "temperature"), "method": method}
    fit = fit_rings(image, ring_model(**COARSE, systematic=covariance), **known)
    longer = ring_model(**COARSE, focal_length=(1 + relative) * reference.FOCAL_LENGTH)
    shift = float(fit_rings(image, longer, **known).v_los - fit.v_los)
    assert abs(shift) > 0.05
    assert float(fit.sensitivity[0, 0]) == -1
    assert float(fit.sensitivity[0, 1]) * relative == pytest.approx(shift, rel=0.05)
    assert float(fit.v_los_systematic) == pytest.approx(np.hypot(zero, shift), rel=0.05)


def test_known_centre_stays():
    image = torch.as_tensor(reference.ring_image(5.0, centre=(118.0, 95.0), **COARSE))
    free = ("v_los", "level", "background")
    fit = fit_rings(image, ring_model(**COARSE), centre=(118.0, 95.0), free=free)
    assert (float(fit.of("x")), float(fit.of("y"))) == (118.0, 95.0)
    assert abs(float(fit.v_los) - 5) < 5e-3
    assert (fit.std[0, [1, 2, 5, 6]] == 0).all() and fit.std[0, 0] > 0


def test_emitted_image_removes_the_instrument():
    """Etalon and laser drift by 0.03 orders: 58 m/s in both images, nothing in their difference."""
    order = reference.ORDER + 0.03
    air = ring_model(order_at_centre=order, **COARSE)
    laser = ring_model(
        order_at_centre=order, temperatures=(), harmonics=reference.harmonics(None), **COARSE
    )
    rendered = [
        torch.as_tensor(reference.ring_image(v, temperature=t, **COARSE))
        for v, t in ((33.0, reference.TEMPERATURE), (0.0, None))
    ]
    received, emitted = (fit_rings(p, m) for p, m in zip(rendered, (air, laser), strict=True))
    assert float(emitted.v_los) == pytest.approx(-0.03 * air.velocity_range, abs=0.05)
    v, std, systematic = difference(received, emitted)
    assert float(systematic) == 0
    assert abs(float(v) - 33) < 0.05
    assert float(std) == pytest.approx(
        float(received.v_los_std.square() + emitted.v_los_std.square()) ** 0.5
    )


# --- bad input ------------------------------------------------------------------------------


def refused(image, message, noise=None, **options):
    with pytest.raises(InputError, match=message) as stop:
        fit_rings(torch.as_tensor(image), ring_model(**COARSE), noise, **options)
    assert "\n" not in str(stop.value)


@pytest.mark.parametrize("method", ["annular", "pixels"])
def test_no_rings(method):
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:195, :240]
    message = "no rings detected|ring.s. detected|chi-square|centre|fit"
    for mean in (
        np.full((195, 240), 500.0),  # even light
        500 + 2.0 * x,  # a ramp
        800 * np.exp(-((x - 100) ** 2 + (y - 90) ** 2) / 2 / 50**2) + 20,  # a blob
        500 * (1.5 + np.sin(x / 9.0)),  # stripes
    ):
        refused(rng.poisson(mean).astype(float), message, method=method)
    refused(np.full((195, 240), 7.0), "no common centre")
    refused(np.zeros((195, 240)), "no common centre")


def test_one_ring():
    """The first ring on even light, as a stop in the beam would leave it."""
    y, x = np.mgrid[:195, :240]
    r = np.hypot(x - 119.5, y - 97)
    mean = np.where(r < 50, reference.ring_image(0.0, **COARSE), 300.0)
    rng = np.random.default_rng(2)
    refused(
        rng.poisson(mean).astype(float), "expected (at least 2|two rings)", max_chi_square=np.inf
    )
    # and a camera that is too small for two
    small = {"shape": (70, 70), "pixel": 4 * reference.PIXEL}
    image = torch.as_tensor(rng.poisson(reference.ring_image(0.0, 1e6, **small)).astype(float))
    with pytest.raises(InputError, match=r"images\[0\]: 1 ring\(s\) detected; expected at least 2"):
        fit_rings(image, ring_model(**small))


def test_not_finite():
    image = reference.ring_image(0.0, **COARSE)
    for value in (np.nan, np.inf):
        image[3, 4] = value
        refused(image, r"images\[0\]: 1 pixel\(s\) of NaN or infinity")


def test_saturated():
    image = reference.ring_image(0.0, **COARSE)
    refused(image, r"saturated, \d+ pixel\(s\) at or above 600", saturation=600.0)
    clipped = np.random.default_rng(3).poisson(image).clip(max=700)
    refused(clipped.astype(float), "saturated, .* share the highest value 700")
    # a smooth crest in integers is none
    fit_rings(torch.as_tensor(image.round()), ring_model(**COARSE))


def test_centre_outside():
    refused(reference.ring_image(0.0, centre=(-20.0, 97.0), **COARSE), "centre: .* expected inside")
    refused(
        reference.ring_image(0.0, **COARSE), "centre: .300.0, 0.0. px is not", centre=(300.0, 0.0)
    )


def test_another_instrument():
    """Rings of a shorter lens: they look good, and the wind would be wrong."""
    other = {**COARSE, "pixel": 1.2 * COARSE["pixel"]}
    rng = np.random.default_rng(4)
    refused(
        rng.poisson(reference.ring_image(0.0, **other)).astype(float),
        "chi-square|ring.s. seen|converge",
    )


def test_arguments():
    image = torch.ones(195, 240)
    refused(image, "method: 'magic' is not one of annular, pixels", method="magic")
    refused(image[:100], "sizes 100 x 240 and 195 x 240 px")
    refused(image[0], "shape .240,. is not allowed")
    refused(image, "'width' is not one of v_los", free=("v_los", "width"))
    refused(image, "max_chi_square: 0", max_chi_square=0)


def test_outliers_are_left_out_and_counted():
    """Cells of a bright spot: without them the speed is as before, and their fraction is told."""
    images = exposures("read noise", 8, 21, **COARSE)
    spoiled = images.clone()
    spoiled[:, 60:64, 150:154] += 1500.0
    given = ring_model(**COARSE), PixelNoise(5)
    clean, fit = fit_rings(images, *given), fit_rings(spoiled, *given)
    assert float(clean.outliers.max()) < 0.002
    assert (fit.outliers > clean.outliers).all() and float(fit.outliers.max()) < 0.05
    change = (fit.v_los - clean.v_los).double()
    # the spot has 16 of 46800 pixels
    assert float(change.abs().max()) < 0.5 * float(clean.v_los_std.mean())
    assert abs(float(fit.v_los.mean()) - 20) < 4 * float(fit.v_los_std.mean()) / np.sqrt(8)


@pytest.mark.parametrize("size, level", [(6, 20000.0), (10, 1500.0), (16, 5000.0)])
def test_bright_patches_are_left_out(size, level):
    """A reflection that keeps the fit from converging: without it the speed is as before."""
    images = exposures("read noise", 4, 21, **COARSE)
    spoiled = images.clone()
    spoiled[:, 60 : 60 + size, 150 : 150 + size] += level
    given = ring_model(**COARSE), PixelNoise(5)
    clean, fit = fit_rings(images, *given), fit_rings(spoiled, *given)
    # (16 + 4)^2 of 46800 pixels are left out
    change = (fit.v_los - clean.v_los).double()
    assert float(change.abs().max()) < 0.5 * float(clean.v_los_std.mean())
    left = (size + 4) ** 2 / images[0].numel()
    assert left - 1e-3 < float(fit.outliers.min()) <= float(fit.outliers.max()) < left + 0.02


def test_known_responses_and_a_mask():
    """Pixels that differ by 5 %, a dead block: right with their responses, not as a plain chip."""
    rng = np.random.default_rng(22)
    response = 1 + 0.05 * rng.standard_normal(COARSE["shape"])
    response[90:140, 20:80] = 0
    mean = reference.ring_image(20.0, 2.4e7, **COARSE) * response
    drawn = np.array([reference.noisy(mean, rng, 5.0) for _ in range(16)], np.float32)
    # what a pixel shows that is left out does not matter
    drawn[:, response == 0] = rng.uniform(0, 5000, (16, int((response == 0).sum())))
    images, known = torch.as_tensor(drawn), torch.as_tensor(response)
    fit = fit_rings(images, ring_model(**COARSE), PixelNoise(5), response=known)
    error = (fit.v_los - 20).double() / fit.v_los_std
    assert abs(float(error.mean())) < 4 / np.sqrt(16)
    # 0.68 .. 1.32 of 16: four standard deviations
    assert float((error**2).mean()) == pytest.approx(1, abs=4 * np.sqrt(2 / 16))
    # each frame scatters by (2 / cells)^(1/2) = 0.05, here taken from the frames
    scatter = float(fit.chi_square.std())
    assert abs(float(fit.chi_square.mean()) - 1) < 4 * scatter / np.sqrt(16) < 0.06
    assert float(fit.chi_square.max()) < 1 + 4 * scatter
    masked = (known > 0).double()
    plain = fit_rings(
        images, ring_model(**COARSE), PixelNoise(5), response=masked, max_chi_square=np.inf
    )
    assert float(plain.chi_square.mean()) > 1.3


AEROSOL = (0.0, 0.05, 0.2, 0.5)


@pytest.mark.parametrize(
    "number", [pytest.param(16, id="few"), pytest.param(400, marks=pytest.mark.slow, id="many")]
)
@pytest.mark.parametrize("aerosol", AEROSOL)
def test_aerosol_up_to_half_of_the_echo(aerosol, number):
    """Unknown fraction, temperature known to 10 K: mean within 4 of its errors, coverage within 4
    binomial standard deviations of 68 and 95 %."""
    rng = np.random.default_rng([23, int(100 * aerosol), number])
    mean = air_frame(SMALL, Defects(aerosol=aerosol), 20.0, 2.4e7).mean
    drawn = [reference.noisy(mean, rng, 5.0) for _ in range(number)]
    images = torch.as_tensor(np.array(drawn, np.float32))
    fit = fit_rings(images, air_model(), PixelNoise(5))
    error = ((fit.v_los - 20).double() / fit.v_los_std).numpy()
    assert abs(error.mean()) < 4 / np.sqrt(number)
    for limit, expected in ((1.0, 0.6827), (1.96, 0.95)):
        allowed = 4 * np.sqrt(expected * (1 - expected) / number)
        assert (np.abs(error) < limit).mean() == pytest.approx(expected, abs=allowed)
    found = fit.of("aerosol").double() - aerosol
    # pixels as large as here blur the narrow line's rings: 0.0014 too little of 0.5, without noise
    plain = fit_rings(torch.as_tensor(mean[None]), air_model(), PixelNoise(5))
    blurred = float(plain.of("aerosol")) - aerosol
    assert -0.004 * aerosol - 1e-4 < blurred < 1e-4
    known = float(fit.std_of("aerosol").mean()) / np.sqrt(number)
    assert abs(float(found.mean()) - blurred) < 4 * known
