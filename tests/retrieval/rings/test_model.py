"""The mean image of rings, its derivatives and the bound, against Airy's formula by quadrature.

Detects: an order that loses digits (naive float32 is off by 3.5 m/s, here 0.001 m/s would show), a
wrong sign or factor of any derivative, cells that forget where their pixels lie, a bound that is
2 % off, a likelihood that leaves information unused.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.cells import annular_sectors, pixels
from lidar_mi.retrieval.rings.mean_image import SHAPE, expected, mean_and_jacobian, ring_waves
from lidar_mi.retrieval.rings.model import FRAME, PARAMETERS, PixelNoise
from tests.support import ring_reference as reference
from tests.support.ring_models import TABLE, TEMPERATURES, ring_model


@pytest.mark.parametrize(
    ("v_los", "centre", "temperature"),
    [
        pytest.param(0.0, None, 232.9, marks=pytest.mark.slow),
        pytest.param(-300.0, (300.0, 250.0), 232.9, marks=pytest.mark.slow),
        (47.0, (481.3, 391.9), 255.0),
    ],
)
def test_image_is_airy_convolved_with_the_line(v_los, centre, temperature):
    """To 3e-5 of the mean: what 0.001 m/s is (5e-7 orders, slope up to 60) and interpolation."""
    truth = reference.ring_image(v_los, 2.4e7, centre, temperature)
    found = expected(ring_model(), v_los, 2.4e7, centre=centre, temperature=temperature)
    np.testing.assert_allclose(found.numpy(), truth, atol=3e-5 * truth.mean())
    assert float(found.sum()) == pytest.approx(2.4e7, rel=1e-9)


def test_light_falls_off_about_the_centre():
    radius = 4e-3
    truth = reference.ring_image(10.0, radius=radius, background=3.0)
    half2 = (780**2 + 960**2) / 4 * reference.PIXEL**2
    found = expected(ring_model(falloff=2 * half2 / radius**2), 10.0, background=3.0)
    np.testing.assert_allclose(found.numpy(), truth, atol=5e-5 * truth.mean())


STEPS = {
    "v_los": 0.01,
    "x": 1e-3,
    "y": 1e-3,
    "level": 1e-3,
    "background": 1e-3,
    "temperature": 1e-2,
    "falloff": 1e-4,
}


def rich_model(**changes):
    """Everything that the model can have, on few pixels."""
    return ring_model(
        shape=(60, 80),
        pixel=8 * reference.PIXEL,
        aerosol_harmonics=reference.harmonics(None),
        light_degree=2,
        background_degree=4,
        blur=0.05,
        **changes,
    )


@pytest.mark.parametrize("kind", ["pixels", "sectors"])
def test_derivatives_are_differences(kind):
    model, centre = rich_model(), (30.2, 24.9)
    if kind == "pixels":
        cells = pixels(model.shape, centre, names=model.smooth)
    else:
        step = model.order_spacing / 40
        cells = annular_sectors(model.shape, centre, step, 8, names=model.smooth)
    waves = ring_waves(model, cells)
    at = model.start().repeat(2, 1)
    at[:, :8] = torch.tensor(
        [[35.0, 0.05, -0.03, 30.0, 2.0, 240.0, 0.4, 0.1], [-90, 0, 0, 5, 1, 221, 0, 0.3]]
    ).double()
    names = (*model.parameters, "damping", "roughness")
    at[0, [PARAMETERS.index(name) for name in model.smooth]] = 0.1
    jacobian = mean_and_jacobian(model, waves, at, names)[1]
    for place, name in enumerate(names):
        step = STEPS.get(name, 1e-3)
        move = torch.zeros(len(PARAMETERS), dtype=torch.float64)
        move[PARAMETERS.index(name)] = step
        up, down = (mean_and_jacobian(model, waves, at + s * move)[0] for s in (1, -1))
        difference = (up - down) / (2 * step)
        # the change of the spread with the centre is left out; pixels here are 8 times too large
        slack = {"x": 5e-2, "y": 5e-2, "falloff": 5e-3}.get(name, 1e-3)
        # of the profile's own parameters the first order of a moved centre is kept
        slack = 1e-2 if name in SHAPE else slack
        worst = (jacobian[:, place] - difference).abs().amax(1) / difference.abs().amax(1)
        assert (worst < slack).all(), (name, worst)


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("focal_length", 1e-6),
        ("tilt_x", 1e-5),
        ("tilt_y", 1e-5),
        ("distortion", 1e-6),
        ("blur", 1e-3),
    ],
)
def test_derivatives_by_the_instrument_are_differences_of_instruments(name, step):
    """Pixel by pixel, about the axis of the lens, where the centre of the rings stays."""

    def image(change):
        given = {
            "focal_length": {"focal_length": reference.FOCAL_LENGTH * (1 + change)},
            "tilt_x": {"tilt": (change, 0.0)},
            "tilt_y": {"tilt": (0.0, change)},
            "distortion": {"distortion": change},
            "blur": {},
        }[name]
        model = rich_model(**given)
        if name == "blur":
            model = replace(model, blur=model.blur + change)
        cells = pixels(model.shape, model.centre, geometry=model.geometry, names=model.smooth)
        waves = ring_waves(model, cells, derivatives=True)
        at = model.start()
        at[:, 0] = 35.0
        return mean_and_jacobian(model, waves, at, [name])

    difference = (image(step)[0] - image(-step)[0]) / (2 * step)
    jacobian = image(0.0)[1][:, 0]
    # that the pixels' own average changes, too, is left out: here they are 8 times too large
    assert (jacobian - difference).abs().max() < 1e-2 * difference.abs().max()


# --- the bound ------------------------------------------------------------------------------


@pytest.mark.parametrize("case", TABLE)
def test_bounds_of_the_default_instrument(case):
    """Numbers known beforehand, to their last digit; everything in the model is unknown."""
    bound, photons, noise, centre = TABLE[case]
    found = cramer_rao(ring_model(), photons, noise, centre=centre)["v_los"]
    assert found == pytest.approx(bound, abs=0.0011 if bound < 0.15 else 0.0051)


def test_bound_equals_differences_of_the_reference_images():
    """F from central differences of images by quadrature, no derivative of ours."""
    noise, steps = PixelNoise(5, 10), {"v_los": 1.0, "x": 0.05, "y": 0.05, "temperature": 2.0}
    shape, pixel = (195, 240), 4 * reference.PIXEL
    at = {"v_los": 20.0, "x": 110.0, "y": 99.0, "temperature": reference.TEMPERATURE}

    def image(**changes):
        p = {**at, **changes}
        return reference.ring_image(
            p["v_los"], 2.4e7, (p["x"], p["y"]), p["temperature"], shape, pixel, radius=6e-3
        )

    mean = image()
    slopes = [
        (image(**{n: at[n] + s}) - image(**{n: at[n] - s})) / (2 * s) for n, s in steps.items()
    ]
    slopes += [mean, np.ones_like(mean)]  # level and background
    jacobian = np.array([s.ravel() for s in slopes])
    variance = mean + mean**2 / 10 + 25
    fisher = (jacobian / variance.ravel()) @ jacobian.T
    truth = np.sqrt(np.linalg.inv(fisher)[0, 0])
    half2 = (shape[0] ** 2 + shape[1] ** 2) / 4 * pixel**2
    model = ring_model(shape, pixel, falloff=2 * half2 / 6e-3**2)
    free = ("v_los", "x", "y", "temperature", "level", "background")
    found = cramer_rao(model, 2.4e7, noise, v_los=20.0, centre=(110.0, 99.0), free=free)
    assert found["v_los"] == pytest.approx(truth, rel=2e-3)


def test_free_parameters_increase_the_bound():
    known = cramer_rao(ring_model(), 2.4e7, free=("v_los",))["v_los"]
    found = cramer_rao(ring_model(), 2.4e7)
    assert set(found) == set(FRAME) - {"aerosol"} and found["temperature"] < 1
    assert known < found["v_los"]


@pytest.mark.parametrize(
    ("read_noise", "modes", "lowest", "unused"),
    [(5.0, np.inf, 1, 0.02), (5.0, 10.0, 1, 0.04), (5.0, 10.0, 20, 0.013), (0.3, 10.0, 5, 0.005)],
)
def test_score_uses_the_information_there_is(read_noise, modes, lowest, unused):
    """Exact Fisher information of a pixel times variance: 1 where no score does better."""
    for mean in (1, 3, 5, 10, 20, 30, 80):
        if mean >= lowest:
            assert 0.999 < reference.information(mean, read_noise, modes) < 1 + unused


def test_variance_is_that_of_the_noise():
    """40 000 pixels: 4 sigma of a sample variance, the kurtosis taken from the sample."""
    rng = np.random.default_rng(8)
    mean = np.full((200, 200), 30.0)
    drawn = reference.noisy(mean, rng, 5.0, 10.0, background=4.0)
    variance = float(PixelNoise(5, 10).variance(torch.tensor(30.0), torch.tensor(26.0)))
    deviation = (drawn - 30) ** 2
    assert abs(deviation.mean() - variance) < 4 * deviation.std() / 200


# --- bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel": 0.0}, "pixel: 0.0 is not allowed; expected above 0"),
        ({"harmonics": np.zeros((5, 4))}, "the etalon must transmit"),
        ({"harmonics": np.ones((5, 1))}, "harmonics: shape"),
        ({"harmonics": np.outer(np.ones(5), [1, 0, 0])}, "leaves rings"),
        ({"temperatures": TEMPERATURES[::-1]}, "temperatures: "),
        ({"order_at_centre": np.nan}, "order_at_centre: nan"),
        ({"shape": (3, 900)}, "ring model: shape"),
    ],
)
def test_models_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        ring_model(**changes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"photons": 0.0}, "photons: 0.0 is not allowed"),
        ({"temperature": 900.0}, "temperature: 900.0 K is not allowed"),
        ({"free": ("x", "y")}, "expected v_los among them"),
        ({"free": ("v_los", "colour")}, "'colour' is not one of v_los"),
        ({"background": -1.0}, "background: -1.0"),
        ({"v_los": np.inf}, "v_los: inf"),
    ],
)
def test_bounds_that_cannot_be(arguments, message):
    with pytest.raises(InputError, match=message):
        cramer_rao(ring_model(), **{"photons": 2.4e7, **arguments})


def test_noise_that_cannot_be():
    with pytest.raises(InputError, match="read_noise: -1"):
        PixelNoise(-1)
    with pytest.raises(InputError, match="speckle_modes: 0"):
        PixelNoise(1, 0)
