"""Texture statistics: detects 0.05 in the spectral slope, 5 % in the rms, 5 % of anisotropy."""

import math

import numpy as np
import pytest

from lidar_mi.atmosphere.texture import corrsin_obukhov, gaussian_field, periodic_texture
from lidar_mi.errors import InputError

Y, Z = np.arange(219) * 0.5, np.arange(139) * 0.5


def line_spectrum(field, axis, spacing):
    """Mean periodogram of the lines along an axis of a periodic field."""
    lines = np.moveaxis(field, axis, -1)
    power = np.abs(np.fft.rfft(lines)) ** 2
    k = 2 * np.pi * np.fft.rfftfreq(lines.shape[-1], spacing)
    return k[1:], power.reshape(-1, power.shape[-1]).mean(0)[1:]


def slope(k, power, low, high):
    use = (k > low) & (k < high)
    return np.polyfit(np.log(k[use]), np.log(power[use]), 1)[0]


def mean_line_spectra(shape, spacing, outer, seeds):
    for axis in range(len(shape)):
        pairs = [
            line_spectrum(
                gaussian_field(shape, (spacing,) * len(shape), outer, seed), axis, spacing
            )
            for seed in range(seeds)
        ]
        yield pairs[0][0], np.mean([power for _, power in pairs], axis=0)


@pytest.mark.parametrize("shape, seeds", [((256, 256), 20), ((96, 96, 96), 4)], ids=["2-D", "3-D"])
def test_line_spectra_are_the_isotropic_spectrum_summed_over_the_other_waves(shape, seeds):
    """Over the whole range, by brute-force sum of (k^2 + k0^2)^(-4/3) or ^(-11/6).

    A wrong exponent shows as twice its error in the slope of the ratio.
    """
    spacing, outer = 0.5, 12.0
    k0, nyquist = 2 * np.pi / outer, np.pi / spacing
    other = 2 * np.pi * np.fft.fftfreq(shape[0], spacing)
    others = other**2 if len(shape) == 2 else (other[:, None] ** 2 + other**2).ravel()
    exponent = -4 / 3 if len(shape) == 2 else -11 / 6
    for k, power in mean_line_spectra(shape, spacing, outer, seeds):
        law = np.array([((q**2 + k0**2 + others) ** exponent).sum() for q in k])
        assert slope(k, power / law, k0, 0.99 * nyquist) == pytest.approx(0, abs=0.02)


def test_structure_function_is_isotropic():
    """Squared differences over 2 m along y, along z and across, mean of 20 seeds."""
    sums = np.zeros(3)
    for seed in range(20):
        g = np.log(corrsin_obukhov(Y, Z, 0.2, 10.0, seed).values)
        sums += [
            np.mean((g[5:] - g[:-5]) ** 2),
            np.mean((g[:, 5:] - g[:, :-5]) ** 2),
            np.mean((g[3:, 4:] - g[:-3, :-4]) ** 2),  # 3-4-5: the same 2.5 m
        ]
    assert sums / sums.mean() == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize("rms", [0.05, 0.2, 0.5])
def test_mean_and_rms_are_those_given(rms):
    factors = np.stack([corrsin_obukhov(Y, Z, rms, 10.0, seed).values for seed in range(5)])
    assert (factors > 0).all()
    # log is normalised exactly, so the rest is the sample's skewness.
    assert np.log(factors).std(axis=(1, 2)) == pytest.approx(np.sqrt(np.log1p(rms**2)), rel=1e-9)
    assert factors.mean() == pytest.approx(1, abs=0.1 * rms**2)
    assert factors.std(axis=(1, 2)).mean() == pytest.approx(rms, rel=0.05)


def test_same_seed_same_field_other_seed_unrelated_field():
    one, again, other = (
        corrsin_obukhov(Y, Z, 0.1, 10.0, seed).values.ravel() for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    # About 110 x 70 / (pi/4 10^2) = 98 independent patches or more: 4 sigma is 0.4.
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.4


def test_opposite_edges_are_unrelated():
    """A periodic field would correlate the first with the last row by 0.6. 216 and 144 nodes are
    lengths a Fourier transform would not pad by itself."""
    y, z = np.arange(216) * 0.5, np.arange(144) * 0.5
    correlations = []
    for seed in range(30):
        g = np.log(corrsin_obukhov(y, z, 0.1, 10.0, seed).values)
        correlations += [np.corrcoef(g[0], g[-1])[0, 1], np.corrcoef(g[:, 0], g[:, -1])[0, 1]]
    sem = np.std(correlations) / np.sqrt(len(correlations))
    assert abs(np.mean(correlations)) < 4 * sem + 0.02  # the mean's removal makes -1/patches


def test_volume_and_slab_layouts():
    """Planes 1 m apart are alike, planes 7 m apart (outer scale 5 m) are not."""
    x = np.arange(8) * 1.0
    near, far = [], []
    for seed in range(6):
        volume = corrsin_obukhov(Y[:40], Z[:30], 0.1, 5.0, seed, x=x)
        assert volume.dims == ("x", "y", "z") and volume.shape == (8, 40, 30)
        g = volume.values.reshape(8, -1)
        near.append(np.corrcoef(g[0], g[1])[0, 1])
        far.append(np.corrcoef(g[0], g[7])[0, 1])
    assert 0.2 < np.mean(near) < 0.8
    assert abs(np.mean(far)) < 0.12  # 6 x 20 m x 15 m / (2 m)^2 or more independent patches
    slab = corrsin_obukhov(Y, Z, 0.1, 10.0, 3, x=[20.5])
    assert slab.shape == (1, 219, 139)
    np.testing.assert_array_equal(slab[0].values, corrsin_obukhov(Y, Z, 0.1, 10.0, 3).values)


def test_off():
    off = corrsin_obukhov(Y, Z, 0.0, 10.0, 1)
    assert (off.values == 1).all() and off.shape == (219, 139)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"rms": -0.1}, "rms"),
        ({"rms": np.nan}, "rms"),
        ({"outer_scale": 0.5}, "outer_scale.*1 m"),
        ({"outer_scale": 1e5}, "outer_scale.*nodes"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"y": [0.0, 1.0, 3.0]}, "texture.y"),
        ({"z": [1.0]}, "texture.z"),
        ({"z": [1.0, 0.5]}, "texture.z"),
    ],
)
def test_bad_input(arguments, words):
    with pytest.raises(InputError, match=words):
        corrsin_obukhov(**{"y": Y, "z": Z, "rms": 0.1, "outer_scale": 10.0, "seed": 1} | arguments)


class TestPeriodicTexture:
    """Anywhere in space: values of the nodes between them, no seam."""

    TEXTURE = periodic_texture((24.0, 40.0, 30.0), (1.0, 0.5, 0.5), 0.3, 8.0, 3)

    def test_mean_and_rms_over_the_period(self):
        nodes = [step * np.arange(n) for n, step in zip((24, 80, 60), (1, 0.5, 0.5), strict=True)]
        values = self.TEXTURE.at(*np.meshgrid(*nodes, indexing="ij"))
        logarithm = np.log(values)
        assert logarithm.std() == pytest.approx(math.sqrt(math.log1p(0.09)), rel=1e-9)
        assert values.mean() == pytest.approx(1, abs=0.03)
        assert values.std() == pytest.approx(0.3, abs=0.03)

    def test_no_seam(self):
        """Steps across the end of the period are as large as elsewhere, along each axis."""
        random = np.random.default_rng(1)
        for axis in range(3):
            places = [random.uniform(0, period, 2000) for period in self.TEXTURE.period]

            def steps(start, axis=axis, places=places):
                first = [p if k != axis else start - 0.25 for k, p in enumerate(places)]
                second = [p if k != axis else start + 0.25 for k, p in enumerate(places)]
                return np.std(self.TEXTURE.at(*second) - self.TEXTURE.at(*first))

            assert steps(self.TEXTURE.period[axis]) == pytest.approx(steps(5.5), rel=0.25)

    def test_no_texture_is_one(self):
        flat = periodic_texture((10.0, 10.0, 10.0), (1.0, 1.0, 1.0), 0.0, 5.0, 1)
        assert (flat.at(np.linspace(-50, 50, 7), 3.0, -2.0) == 1).all()

    def test_what_is_refused(self):
        with pytest.raises(InputError, match="outer_scale"):
            periodic_texture((10.0, 10.0, 10.0), (1.0, 1.0, 1.0), 0.1, 1.5, 1)
        with pytest.raises(InputError, match="period"):
            periodic_texture((1e4, 1e3, 1e3), (1.0, 1.0, 1.0), 0.1, 10.0, 1)
