"""Cross-correlation against a direct sum and against exactly known motion.

Detects an error of 1e-5 in a coefficient, of 0.03 px in the mean displacement, a wrong sign or
swapped axes, and a normalisation that is not made shift by shift.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.cross_correlation import correlate, cross_correlation
from tests.support.flows import plane_waves, texture


def direct(image1, image2, template, search, stride):
    """The definition, one window and one shift after the other."""
    lead, shifts = (search - template) // 2, search - template + 1
    rows, columns = ((size - search) // stride + 1 for size in image1.shape)
    out = np.empty((shifts, shifts, rows, columns))
    for i in range(rows):
        for j in range(columns):
            z, y = i * stride, j * stride
            f = image1[z + lead : z + lead + template, y + lead : y + lead + template]
            f = f - f.mean()
            for p in range(shifts):
                for q in range(shifts):
                    g = image2[z + p : z + p + template, y + q : y + q + template]
                    g = g - g.mean()
                    out[p, q, i, j] = (f * g).sum() / np.sqrt((f**2).sum() * (g**2).sum())
    return out


SIZES = [
    (8, 16, 1),
    (8, 16, 5),
    (7, 16, 3),
    (8, 15, 2),
    (5, 9, 1),
    (4, 7, 4),
    (2, 4, 1),
    (3, 20, 2),
]


@pytest.mark.parametrize("algorithm", ["dense", "fft", "auto"])
@pytest.mark.parametrize("template, search, stride", SIZES)
def test_equals_the_direct_sum(template, search, stride, algorithm):
    rng = np.random.default_rng(template)
    first, second = rng.random((2, 23, 27))
    expected = direct(first, second, template, search, stride)
    found = correlate(
        torch.as_tensor(first),
        torch.as_tensor(second),
        template,
        search,
        stride,
        algorithm=algorithm,
    )
    np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("algorithm", ["dense", "fft"])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_low_contrast_at_any_scale(algorithm, scale, dtype):
    """Contrast of 1e-3 of the mean, brightness varying by half over the image."""
    rng = np.random.default_rng(3)
    ramp = 1 + 0.5 * np.linspace(-1, 1, 26)
    first, second = (
        torch.as_tensor(scale * (ramp + 1e-3 * rng.standard_normal((22, 26)))).to(dtype)
        for _ in range(2)
    )
    expected = direct(first.double().numpy(), second.double().numpy(), 6, 11, 2)
    found = correlate(first, second, 6, 11, 2, algorithm=algorithm)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_does_not_depend_on_gain_and_offset_of_either_image():
    rng = np.random.default_rng(4)
    first, second = (torch.as_tensor(rng.random((20, 24))) for _ in range(2))
    plain = correlate(first, second, 5, 10)
    np.testing.assert_allclose(correlate(3e-6 * first + 0.02, 7 - second, 5, 10), -plain, atol=1e-7)


def test_bright_neighbourhood_does_not_draw_the_peak():
    """Brightness doubles across a template, texture is 20 %: a plain product goes to the rim."""
    y, z = np.meshgrid(np.arange(64.0), np.arange(48.0))
    gain = np.exp(y / 12)
    first = gain * texture(plane_waves(1, 3.0), y, z)
    second = gain * texture(plane_waves(1, 3.0), y - 2, z + 1)
    found = cross_correlation(torch.as_tensor(first), torch.as_tensor(second))
    assert abs(float(found.dy.nanmedian()) - 2) < 0.15
    assert abs(float(found.dz.nanmedian()) + 1) < 0.15


def test_tiles_change_nothing(monkeypatch):
    rng = np.random.default_rng(5)
    first, second = (torch.as_tensor(rng.random((40, 50))) for _ in range(2))
    whole = {a: cross_correlation(first, second, stride=2, algorithm=a) for a in ("dense", "fft")}
    monkeypatch.setattr("lidar_mi.retrieval.images.windows.TILE_BYTES", 60_000)
    for algorithm, expected in whole.items():
        for one, other in zip(
            cross_correlation(first, second, stride=2, algorithm=algorithm), expected, strict=True
        ):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("shift_z, shift_y", [(0, 0), (1, -2), (-3, 3), (2, 0)])
def test_whole_pixels_are_retrieved_everywhere(shift_z, shift_y):
    y, z = np.meshgrid(np.arange(60.0), np.arange(50.0))
    first = torch.as_tensor(texture(plane_waves(2, 3.0), y, z))
    second = torch.as_tensor(texture(plane_waves(2, 3.0), y - shift_y, z - shift_z))
    found = cross_correlation(first, second)
    assert (found.flag & ~Flag.NO_SUBPIXEL_FIT == 0).all()
    np.testing.assert_allclose(found.score, 1, atol=1e-9)
    # the fit may move the peak by less than half a pixel
    assert (found.dz - shift_z).abs().max() < 0.5
    assert (found.dy - shift_y).abs().max() < 0.5


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.5, 0.7])
@pytest.mark.parametrize("axis", ["y", "z"])
def test_subpixel_shift_has_little_bias(fraction, axis):
    """Mean over some 300 independent windows, single errors below 0.15 px: 0.03 px is 3.5 sigma.

    Single errors: texture of 3 px correlation length makes peaks that are elongated and tilted,
    so that a cut through the integer peak half a pixel beside the true one is worst across the
    shift. In a sheared flow at all fractions 0.13 px were measured elsewhere.
    """
    y, z = np.meshgrid(np.arange(219.0), np.arange(139.0))
    shift = {"y": 0.0, "z": 0.0} | {axis: 1 + fraction}
    first = texture(plane_waves(3, 3.0), y, z)
    second = texture(plane_waves(3, 3.0), y - shift["y"], z - shift["z"])
    found = cross_correlation(torch.as_tensor(first), torch.as_tensor(second), stride=2)
    for displacement, name in ((found.dz, "z"), (found.dy, "y")):
        error = displacement[torch.isfinite(displacement)] - shift[name]
        assert error.numel() > 0.999 * displacement.numel()
        assert abs(float(error.mean())) < 0.03
        assert float(error.std()) < (0.1 if name == axis else 0.2)


def test_beyond_the_search_range_is_flagged_not_clipped():
    y, z = np.meshgrid(np.arange(80.0), np.arange(60.0))
    first = torch.as_tensor(texture(plane_waves(4, 6.0), y, z))
    second = torch.as_tensor(texture(plane_waves(4, 6.0), y - 4.4, z))
    found = cross_correlation(first, second)
    rim = (found.flag & Flag.PEAK_ON_RIM.value) > 0
    assert rim.double().mean() > 0.9
    assert torch.isnan(found.dy[rim]).all() and torch.isnan(found.dz[rim]).all()
    assert (found.dy[~rim].abs() < 3.5).all()


def test_image_without_contrast_has_no_match():
    for value, dtype in ((0.1, torch.float32), (0.1, torch.float64), (0.0, torch.float64)):
        flat = torch.full((40, 40), value, dtype=dtype)
        noise = torch.rand(40, 40, dtype=dtype, generator=torch.Generator().manual_seed(0))
        for first, second in ((flat, flat), (flat, noise), (noise, flat)):
            for algorithm in ("dense", "fft"):
                found = cross_correlation(first, second, algorithm=algorithm)
                assert (found.flag & Flag.NO_MATCH.value > 0).all()
                assert torch.isnan(found.dy).all() and torch.isnan(found.dz).all()
                assert (found.score == 0).all()


def test_nan_spoils_only_its_own_regions():
    rng = np.random.default_rng(6)
    first, second = (torch.as_tensor(rng.random((40, 44))) for _ in range(2))
    clean = cross_correlation(first, second)
    holed = second.clone()
    holed[20, 30] = torch.nan
    found = cross_correlation(first, holed)
    bad = (found.flag & Flag.NON_FINITE_INPUT.value) > 0
    expected = torch.zeros_like(bad)
    expected[5:21, 15:29] = True  # regions [i, i + 16) x [j, j + 16) that hold the pixel
    assert torch.equal(bad, expected)
    assert torch.isnan(found.dy[bad]).all()
    torch.testing.assert_close(found.dy[~bad], clean.dy[~bad], equal_nan=True)


def test_bad_input_is_named():
    image = torch.rand(30, 30)
    for call, start in (
        (lambda: cross_correlation(image, image, algorithm="slow"), "algorithm: 'slow'"),
        (lambda: cross_correlation(image, image, min_correlation=2), "min_correlation: 2"),
        (lambda: cross_correlation(image, image[1:]), "image2: sizes 30 x 30 and 29 x 30"),
        (lambda: cross_correlation(image[None], image), "image1: shape (1, 30, 30)"),
        (lambda: cross_correlation(image.numpy(), image), "image1: ndarray"),
        (lambda: correlate(image, image.to(torch.complex64)), "image2: values of"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value).startswith(start) and "\n" not in str(error.value)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_gives_the_same_numbers():
    rng = np.random.default_rng(7)
    first, second = (torch.as_tensor(rng.random((60, 70))) for _ in range(2))
    for algorithm in ("dense", "fft"):
        expected = cross_correlation(first, second, algorithm=algorithm)
        found = cross_correlation(first.cuda(), second.cuda(), algorithm=algorithm)
        assert found.dy.is_cuda
        torch.testing.assert_close(found.dy.cpu(), expected.dy, equal_nan=True)
