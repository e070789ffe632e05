"""Structure of the sampling of images and volumes. Physics tier.

Detects: copied blocks, repeated, interlaced or interpolated pixels, gates on a grid and borders
without a picture that give a valid wind of the sampling; samples that are used at the wrong places;
independent samples that are called structured.
"""

import re

import numpy as np
import pytest
import torch
from scipy import ndimage

import lidar_mi as lm
from lidar_mi.retrieval.defects.sampling import FALSE_ALARM, sampling
from tests.support.flows import axes, data_array
from validation.defects.families import BY_NAME

SHAPE, SPACING, DT = (96, 112), 0.5, 0.1
MOTION = np.array([-0.6, 1.4])
"""Px along z and y: 7 m/s along y, -3 m/s along z."""
NOISE = 0.01


def air(seed, factor=1, time=0.0, length=2.0):
    """Texture of 30 % and a periodic image of 160 px, of which each `factor`-th is a sample."""
    field = ndimage.gaussian_filter(
        np.random.default_rng(seed).standard_normal((160, 160)), length, mode="wrap"
    )
    k = np.fft.fftfreq(160)
    turn = np.exp(-2j * np.pi * time / factor * (k[:, None] * MOTION[0] + k * MOTION[1]))
    moved = np.fft.ifft2(np.fft.fft2(field) * turn).real / field.std()
    return 1 + 0.3 * moved[: SHAPE[0], : SHAPE[1]]


def pair(seed, factor=1, length=2.0):
    """Two images with noise, of samples `factor` px apart."""
    random = np.random.default_rng(seed)
    images = [air(seed, factor, time, length) for time in (0.0, 1.0)]
    return [image + NOISE * random.standard_normal(image.shape) for image in images]


def found(images):
    return sampling([torch.as_tensor(image) for image in images])


def wind(images, method="variational"):
    """Valid fraction, and of these the fraction beyond 4 stated errors and the mean error, m/s."""
    both = [data_array(image, *axes(*image.shape[::-1], SPACING)) for image in images]
    x = lm.retrieve_wind(*both, DT, method, windows=lm.WindowSizes(8, 16, 4))
    good = (x["flag"] == 0).values
    error = np.stack([x["v"].values - 7.0, x["w"].values + 3.0])[:, good]
    stated = np.stack([x[f"{name}_stderr"].values for name in "vw"])[:, good]
    return good.mean(), (np.abs(error) > 4 * stated).any(0).mean() if good.any() else 0.0, error, x


@pytest.mark.parametrize("levels", [None, 300, 30, 8])
def test_independent_samples_have_no_structure(levels):
    """60 pairs, of whole numbers as well: at the rate of false alarms of each test, none."""
    said = []
    for seed in range(15):
        images = pair(seed, length=1.2 + seed % 4 / 2)
        if levels is not None:
            images = [np.round(levels * image) for image in images]
        said.append(found(images).said)
    assert 15 * 10 * FALSE_ALARM < 0.02 and not any(said), said


def test_air_at_rest_in_noise_is_not_copied():
    """Noise of half a level, and air that does not move: half of the pixels are equal by chance."""
    random = np.random.default_rng(1)
    images = [np.round(30 * air(1) + 0.5 * random.standard_normal(SHAPE)) for _ in range(2)]
    assert 0.3 < np.mean(images[0] == images[1]) < 0.7
    assert not found(images).said


@pytest.mark.slow
@pytest.mark.parametrize("side, part", [(8, 0.05), (16, 0.15)])
def test_copied_blocks_are_found_and_the_others_keep_the_wind(side, part):
    one, two = (np.round(100 * image) for image in pair(5))
    copied = np.random.default_rng(side).random((SHAPE[0] // side, SHAPE[1] // side)) < part
    copied = np.kron(copied, np.ones((side, side))) > 0
    two = np.where(copied, one, two)
    hidden = found([one, two]).hidden.numpy()
    # pixels that are equal by chance next to a block belong to it
    assert hidden[:, copied].all() and hidden[:, ~copied].mean() < 0.02
    valid, far, _, x = wind([one, two])
    assert valid > 0.15 and far <= 0.03
    assert "copied from image 1" in x.attrs["sampling"]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2, 3])
def test_repeated_pixels_give_the_wind_of_their_samples(factor):
    """Half a pixel of displacement at the wrong place would be 10 standard errors in shear."""
    images = [
        np.kron(image, np.ones((factor, factor)))[: SHAPE[0], : SHAPE[1]]
        for image in pair(3, factor)
    ]
    structure = found(images)
    assert structure.steps == (factor, factor) and structure.middle == ((factor - 1) / 2,) * 2
    valid, far, error, x = wind(images)
    assert valid > 0.1 and far <= 0.01 and np.abs(error.mean(1)).max() < 0.2
    assert f"repeated every {factor} px along z" in x.attrs["sampling"]


def test_samples_lie_in_the_middle_of_the_pixels_that_repeat_them():
    structure = found([np.kron(i, np.ones((2, 2)))[1:] for i in pair(2)])
    assert (structure.steps, structure.first, structure.middle) == ((2, 2), (1, 0), (0.5, 0.5))


def test_irregular_repetition_is_flagged():
    rows = np.minimum((np.arange(SHAPE[0]) / 1.5).astype(int), SHAPE[0] - 1)
    images = [image[rows] for image in pair(4)]
    assert found(images).spoilt
    assert wind(images, "cc")[0] == 0


def test_interlaced_images_give_the_wind_of_a_field():
    fields = []
    for time, noise in ((0.0, 1), (1.0, 2)):
        image, later = (air(7, 1, time + late) for late in (0.0, 0.5))
        image[1::2] = later[1::2]
        fields.append(image + NOISE * np.random.default_rng(noise).standard_normal(SHAPE))
    assert found(fields).steps == (2, 1)
    valid, far, _, x = wind(fields)
    assert valid > 0.5 and far <= 0.01 and "period of 2 px along z" in x.attrs["sampling"]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("factor", [2.08, 2.15, 2.4])
def test_interpolated_pixels_are_flagged_with_their_period(seed, factor):
    """Linearly enlarged: second differences vanish between samples."""
    small = pair(seed, factor)
    place = [np.arange(n) / factor for n in SHAPE]
    images = []
    for image in small:
        for axis, at in enumerate(place):
            low = at.astype(int)
            part = np.expand_dims(at - low, 1 - axis)
            image = (1 - part) * image.take(low, axis) + part * image.take(low + 1, axis)
        images.append(image)
    structure = found(images)
    assert structure.spoilt
    period = float(re.search(r"a period of ([\d.]+) px along z", structure.said)[1])
    assert period == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize("seed", [6, 9])
def test_blocks_of_cosines_have_no_samples(seed):
    """Every fourth line, a harmonic of the blocks of 8 px, gives winds 2 m/s off, stated 0.5."""
    structure = found(BY_NAME["quantised"].pair(seed)[1])
    assert structure.spoilt and structure.steps == (1, 1)


@pytest.mark.parametrize("side", [3, 4])
def test_planes_of_blocks_have_no_samples(side):
    """Mean and slopes of each block remain: no line between its edges has second differences."""

    def planes(image):
        rows, columns = (side * (n // side) for n in image.shape)
        blocks = image[:rows, :columns].reshape(rows // side, side, -1, side).swapaxes(1, 2)
        off = np.arange(side) - (side - 1) / 2
        slopes = [(blocks * part).sum((2, 3)) for part in (off[:, None], off)]
        mean = blocks.mean((2, 3), keepdims=True)
        size = side * (off**2).sum()
        flat = mean + sum(
            slope[..., None, None] / size * part
            for slope, part in zip(slopes, (off[:, None], off), strict=True)
        )
        return flat.swapaxes(1, 2).reshape(rows, columns)

    x = found([planes(image) for image in pair(1, length=3.0)])
    assert x.said.count(f"a period of {side} px") == 2
    assert x.spoilt and not x.thinned


def test_gates_on_a_grid_are_flagged():
    """Each pixel has the value of the nearest gate of a scan from 40 m below."""
    off = np.indices(SHAPE) + np.reshape([80.0, -56.0], (2, 1, 1))
    gate, beam = np.rint(np.hypot(*off) / 2.3), np.rint(np.arctan2(off[1], off[0]) / 0.016)
    _, number = np.unique(np.stack([gate, beam]).reshape(2, -1), axis=1, return_inverse=True)
    number = number.reshape(SHAPE)
    first = np.unique(number, return_index=True)[1]
    images = [image.ravel()[first][number] for image in pair(8, length=3.0)]
    assert found(images).spoilt and wind(images, "multipass")[0] == 0


@pytest.mark.slow
def test_borders_without_a_picture_are_masked():
    images = pair(100)
    images[0][:12], images[0][:, :9], images[1][:9], images[1][:, :13] = 0, 0, 0, 0
    blank = [image == 0 for image in images]
    hidden = found(images).hidden.numpy()
    for one, is_blank in zip(hidden, blank, strict=True):
        assert one[is_blank].all() and one[~is_blank].mean() < 0.03
    valid, _, error, x = wind(images)
    assert valid > 0.4 and np.abs(error).max() < 0.5 and "no picture" in x.attrs["sampling"]


def test_smoke_in_empty_air_is_a_picture():
    """Constant to the bit outside of the smoke, whose rim takes pixels to rise."""
    z, y = np.indices(SHAPE)
    images = []
    for time in (0.0, 1.0):
        r = np.hypot(z - 48 - MOTION[0] * time, y - 56 - MOTION[1] * time)
        images.append(np.round(200 * np.exp(-((r / 15) ** 4)) * air(1, 1, time)))
    assert np.mean(images[0] == 0) > 0.3
    assert not found(images).hidden.any()


@pytest.mark.parametrize("levels", [20, 60, 255])
@pytest.mark.parametrize("width", [8.0, 24.0])
def test_smooth_smoke_in_few_levels_is_a_picture(levels, width):
    """Without noise: neighbours and lines are equal where it changes by less than a level."""
    z, y = np.indices(SHAPE)
    images = []
    for time in (0.0, 1.0):
        r = np.hypot(z - 40 - MOTION[0] * time, y - 60 - MOTION[1] * time)
        images.append(np.round(levels * (0.2 + 0.8 * np.exp(-0.5 * (r / width) ** 2))))
    assert np.mean(np.diff(images[0]) == 0) > 0.1
    assert not found(images).hidden.any()
