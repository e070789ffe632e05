"""Pixels that are masked weigh nothing. Detects windows that one of them spoils."""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.defects.removal import CleanImages
from lidar_mi.retrieval.defects.rest import nothing_at_rest
from lidar_mi.retrieval.wind import pair as module
from lidar_mi.retrieval.wind.options import WindowSizes
from tests.support import turning

MASKED = 0.02


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["texture", "particles"])
@pytest.mark.parametrize(
    "template", [16, *(pytest.param(px, marks=pytest.mark.slow) for px in (8, 32))]
)
@pytest.mark.parametrize("method", ["cc", "multipass", "variational"])
def test_masked_pixels_change_vectors_by_less_than_their_errors(
    method, template, kind, monkeypatch
):
    """Two pixels of a hundred anywhere: every window of 16 px or more holds some.

    Weight shift is left out: it states no errors of such images.
    """
    monkeypatch.setattr(turning, "WHOLE_TURN", 0.1)
    half = 50 if template < 32 else 100
    inner = slice(turning.SIZE // 2 - half, turning.SIZE // 2 + half)
    images = [image[inner, inner] for image in turning.turning_pair(kind, 1)]
    random = np.random.default_rng(template)
    stray = torch.tensor(random.random((2, *images[0].shape)) < MASKED)

    def masked(pixels, windows):
        defects = nothing_at_rest(pixels)._replace(stray=stray)
        return CleanImages(pixels, defects, [torch.ones(1, 1)] * 2, defects.filled(pixels))

    def retrieved():
        return module.retrieve_wind(
            *images,
            1.0,
            method,
            windows=WindowSizes(template=template, search=2 * template, stride=8),
        )

    whole = retrieved()
    monkeypatch.setattr(module, "without_defects", masked)
    some = retrieved()
    valid = whole.flag == 0
    assert valid.mean() > 0.8
    for name in "vw":
        found = some[name].where(valid)
        assert np.isfinite(found).sum() > 0.95 * valid.sum()
        assert rms((found - whole[name]) / some[f"{name}_stderr"]) < 1
