"""Where a retrieval computes, and what it does where memory is full. Unit tier.

Detects: a name that is another device, winds that change with the size of the tiles, memory that is
full and ends in a traceback.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.ndimage import gaussian_filter

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.retrieval.device import device_of, divisor, within_memory
from lidar_mi.retrieval.images.windows import TILE_BYTES, tile_bytes
from lidar_mi.retrieval.wind.methods import METHODS

FULL = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB.\nSee documentation")


def pair(shape=(32, 48), seed=1):
    air = 1 + gaussian_filter(
        np.random.default_rng(seed).normal(size=(shape[0], shape[1] + 2)), 1.5
    )
    axes = {d: (d, 0.5 * np.arange(n), {"units": "m"}) for d, n in zip("zy", shape, strict=True)}
    return [xr.DataArray(air[:, k : k + shape[1]], axes, ("z", "y")) for k in (2, 0)]


def test_names(monkeypatch):
    assert device_of("cpu") == torch.device("cpu") == device_of(torch.device("cpu"))
    assert device_of("cuda:1") == torch.device("cuda", 1)
    for there, expected in ((False, "cpu"), (True, "cuda")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert device_of("auto").type == expected
    with pytest.raises(InputError, match="device: 'gpu' cannot be used here"):
        lm.retrieve_wind(*pair(), dt=0.1, device="gpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_a_device_that_is_not_there():
    for retrieve in (lm.retrieve_wind, lm.fit_vortices):
        with pytest.raises(InputError, match=r"^device: 'cuda' cannot be used here \(.*\)$"):
            retrieve(*pair(), dt=0.1, device="cuda")
    wind, auto = (lm.retrieve_wind(*pair(), dt=0.1, device=name) for name in ("cpu", "auto"))
    assert wind.identical(auto)


def full_above(limit, found):
    """A function for which memory is full while tiles are larger."""

    def compute():
        found.append(tile_bytes())
        if tile_bytes() > limit:
            raise FULL
        return len(found)

    return compute


def test_tiles_become_smaller_until_memory_suffices():
    sizes = []
    assert within_memory(full_above(TILE_BYTES / 10, sizes)) == 2
    assert sizes == [TILE_BYTES, TILE_BYTES // 16] and tile_bytes() == TILE_BYTES
    assert divisor() == 1


def test_full_memory_is_one_line():
    with pytest.raises(InputError) as error:
        within_memory(full_above(0, []))
    assert str(error.value) == (
        "device: its memory is too small for this retrieval (CUDA out of memory. Tried to "
        "allocate 20 GiB.); expected a smaller image, a larger stride or the device cpu"
    )
    assert tile_bytes() == TILE_BYTES


def test_other_errors_stay():
    def compute():
        raise RuntimeError("singular")

    with pytest.raises(RuntimeError, match="singular"):
        within_memory(compute)


@pytest.mark.parametrize("method", ["cc", "ws", "multipass"])
def test_winds_do_not_depend_on_the_tiles(method):
    """As if memory were full in the first pass of each size but the last one."""
    expected = lm.retrieve_wind(*pair(), dt=0.1, method=method)
    usual = METHODS[method]

    def scarce(*images, **options):
        if divisor() < 256:
            raise FULL
        return usual.find(*images, **options)

    found = lm.retrieve_wind(*pair(), dt=0.1, method=replace(usual, find=scarce))
    xr.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
