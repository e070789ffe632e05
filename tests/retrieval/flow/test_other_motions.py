"""Rigid windows that explain images better than the fitted flow. Physics tier.

Detects: a flow that is a period off in a lattice of dots and stays valid, vectors of other air
that are lost by the test of it.
"""

import numpy as np
import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.other_motions import better_elsewhere
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.windows import Windows

SHAPE = 64, 72
SHIFT = -0.6, 1.4
WINDOWS = Windows(SHAPE, 8, 16, 4)
NOISE = 0.01


def dots(seed, period=8):
    """A lattice of which a tenth of the dots are missing, in white noise, moved by `SHIFT`."""
    random = np.random.default_rng(seed)
    z, y = np.mgrid[: SHAPE[0], : SHAPE[1]]
    images = NOISE * random.standard_normal((2, *SHAPE))
    for i in np.arange(-2, 11) * period:
        for j in np.arange(-2, 12) * period:
            if random.random() < 0.1:
                continue
            for t in (0, 1):
                off = (z - i - t * SHIFT[0]) ** 2 + (y - j - t * SHIFT[1]) ** 2
                images[t] += np.exp(-off / 2 / 1.3**2)
    return [torch.as_tensor(image) for image in images]


def texture(seed):
    """Of 2 px and 30 %, moved exactly by its Fourier transform, in white noise."""
    random = np.random.default_rng(seed)
    k = np.fft.fftfreq(128)
    wave = np.fft.fft2(random.standard_normal((128, 128)))
    wave = wave * np.exp(-2 * np.pi**2 * 4 * (k[:, None] ** 2 + k**2))
    phase = np.exp(-2j * np.pi * (k[:, None] * SHIFT[0] + k * SHIFT[1]))
    parts = [np.fft.ifft2(part).real for part in (wave, wave * phase)]
    cut = slice(30, 30 + SHAPE[0]), slice(30, 30 + SHAPE[1])
    return [
        torch.as_tensor(
            1 + 0.3 * part[cut] / parts[0].std() + NOISE * random.standard_normal(SHAPE)
        )
        for part in parts
    ]


def found(stack, displacement):
    """Windows that are better explained than by a uniform displacement."""
    settings = VariationalSettings()
    images = prepared(stack, NOISE, 0.0, settings)
    pixels = [torch.arange(n, dtype=torch.float64) for n in SHAPE]
    mesh = Mesh([Axis(n, 8.0) for n in SHAPE], pixels)
    d = torch.tensor(displacement, dtype=torch.float64)[:, None, None]
    coefficients = mesh.fitted(d.expand(2, *SHAPE).contiguous())
    linear = linearised(images, mesh, coefficients, settings)
    return better_elsewhere(images, linear, d.expand(2, *WINDOWS.count), WINDOWS)


def test_a_lattice_that_is_a_period_off_is_flagged():
    """At its own motion only places around which no dot is missing, whose motion nothing tells.

    A window has 6 dots, each of which is compared with two others: of those a tenth is missing
    from one at least in 1 - 0.9^12 = 72 % of the windows; a window counts as far as it reaches.
    """
    right, wrong = (
        [found(dots(seed), (SHIFT[0], SHIFT[1] - off)).double().mean() for seed in range(4)]
        for off in (0, 8)
    )
    assert np.mean(right) < 0.5 and min(right) == 0
    assert min(wrong) == 1


def test_air_that_moves_as_fitted_is_not_flagged():
    """Nor does it matter that the flow is off by half a pixel: that is the same maximum."""
    for seed in range(2):
        stack = texture(seed)
        assert not found(stack, SHIFT).any()
        assert not found(stack, (SHIFT[0] + 0.5, SHIFT[1])).any()


def test_a_flow_that_is_far_off_is_flagged():
    assert found(texture(1), (SHIFT[0] + 5, SHIFT[1] - 4)).double().mean() > 0.9


def test_a_pattern_that_repeats_has_no_motion_that_is_sure():
    """Waves along both axes, at their motion and at one a period off, with and without noise."""
    z, y = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for period, noise in ((5, 0.0), (5, 0.02), (7, 0.02)):
        random = np.random.default_rng(period)

        def wave(t, period=period, noise=noise, random=random):
            moved = (z - t * SHIFT[0], y - t * SHIFT[1])
            air = 1 + 0.3 * sum(np.sin(2 * np.pi * one / period) for one in moved)
            return torch.as_tensor(air + noise * random.standard_normal(SHAPE))

        stack = [wave(0), wave(1)]
        for off in (0, period):
            assert found(stack, (SHIFT[0], SHIFT[1] - off)).double().mean() > 0.98, (period, off)
