"""Multi-pass correlation on images of exactly known flows.

Detects errors above those of the best public PIV code, a bias of 0.01 px, paths taken for straight
lines in a core, outliers that spread, and confident nonsense.
"""

import math
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks.cases import DT, vortex_pair_images
from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.multipass import multipass, travelled
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import data_array, plane_waves, texture


def wind_errors(pair, method, **options):
    """Errors of v and w at the vectors (2, z, y), m/s, their standard errors, and which are far."""
    wind = retrieve_wind(pair.first, pair.second, DT, method, noise=pair.noise or None, **options)
    z, y = np.meshgrid(wind.z, wind.y, indexing="ij")
    errors = np.stack(
        [wind[n].values - true for n, true in zip("vw", velocity(pair.vortices, y, z), strict=True)]
    )
    stderr = np.stack([wind["v_stderr"].values, wind["w_stderr"].values])
    far = np.min([np.hypot(y - o.y, z - o.z) for o in pair.vortices], axis=0) > 6
    return errors, stderr, far


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("noise", "everywhere", "beyond"),
    [
        pytest.param(0.0, 0.35, 0.12, marks=pytest.mark.slow),
        pytest.param(0.01, 0.38, 0.17, marks=pytest.mark.slow),
        (0.03, 0.50, 0.32),
        pytest.param(0.06, 0.77, 0.66, marks=pytest.mark.slow),
    ],
)
def test_errors_are_below_the_best_window_deformation(noise, everywhere, beyond):
    """Known errors (m/s) of OpenPIV's window deformation with its best settings on this case."""
    errors, _, far = wind_errors(vortex_pair_images(noise), "multipass")
    for component in errors:
        assert rms(component) < everywhere
        assert rms(component[far]) < beyond


def shifted(dz, dy, pattern=None, rows=60, columns=70, seed=3):
    z, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    pattern = pattern or partial(texture, plane_waves(seed, 3.0))
    return [torch.tensor(pattern(*at)) for at in ((y, z), (y - dy, z - dz))]


@pytest.mark.parametrize("shift", [(0.0, 0.5), (0.25, -1.3), (-3.4, 2.7)])
def test_uniform_shift_is_retrieved(shift):
    found = multipass(*shifted(*shift))
    for d, true in zip((found.dz, found.dy), shift, strict=True):
        # windows at the rim lose what leaves the image
        rim = 4 + math.ceil(max(map(abs, shift)))
        inner = d[rim:-rim, rim:-rim]
        assert abs(float(inner.mean()) - true) < 0.005
        assert float(inner.std()) < 0.02
    assert not found.flag[rim:-rim, rim:-rim].any()


def test_brightness_of_an_image_does_not_matter():
    first, second = shifted(0.6, -0.8)
    one, other = multipass(first, second), multipass(first, 0.3 * second - 7)
    assert torch.allclose(one.dz, other.dz, atol=2e-3)
    assert torch.allclose(one.dy, other.dy, atol=2e-3)


def test_paths_in_a_solid_rotation_are_arcs():
    """Wind L x with a turning and a straining part: chord 2 tanh(L / 2) x of the middle."""
    rate = np.array([[0.1, -0.7], [0.6, -0.1]])
    values, vectors = np.linalg.eig(rate.astype(complex))
    chord = (vectors @ np.diag(2 * np.tanh(values / 2)) @ np.linalg.inv(vectors)).real
    place = np.array([1.5, -2.0])
    gradient = torch.tensor(chord)[:, :, None]
    found = travelled(torch.tensor(chord @ place)[:, None], gradient)[:, 0]
    straight = np.abs(chord @ place - rate @ place).max()
    assert np.abs(found.numpy() - rate @ place).max() < 0.02 * straight < 0.02


def test_stripes_leave_one_direction_open():
    """Waves nearly along (1, 1): the covariance is large along (1, -1), as it should be."""

    def stripes(y, z):
        return 1 + 0.1 * (np.cos(0.6 * y + 0.6 * z) + np.cos(0.55 * y + 0.65 * z + 1))

    random = np.random.default_rng(5)
    pair = [
        image + 0.01 * torch.tensor(random.standard_normal(image.shape))
        for image in shifted(0.4, 0.3, stripes)
    ]
    (zz, zy), (_, yy) = multipass(*pair, noise=0.01).covariance
    assert float((zy / (zz * yy).sqrt()).median()) < -0.9


@pytest.mark.slow
def test_texture_that_is_not_advected_is_flagged():
    """Unrelated textures, and one moved beyond what the first pass can see."""
    first = shifted(0, 0, seed=6)[0]
    pairs = [(first, shifted(0, 0, seed=7)[0]), shifted(25.0, 25.0)]
    axes = np.arange(70.0), np.arange(60.0)
    for method in ("multipass", "variational"):
        for pair in pairs:
            images = [data_array(image.numpy(), *axes) for image in pair]
            wind = retrieve_wind(*images, 1.0, method, noise=0.01)
            assert float((wind.flag == 0).mean()) < 0.3


def test_hole_is_flagged_and_stays_where_it_is():
    first, second = shifted(0.5, 0.5)
    second[30, 20] = torch.nan
    found = multipass(first, second)
    holed = (found.flag & Flag.NON_FINITE_INPUT.value) > 0
    assert holed.sum() == 16 * 16
    assert found.dz[holed].isnan().all()
    good = found.flag == 0
    assert float((found.dz[good] - 0.5).abs().max()) < 0.1


def test_large_scans_are_worked_off_in_bands(monkeypatch):
    pair = shifted(0.7, -0.2)
    whole = multipass(*pair)
    monkeypatch.setattr("lidar_mi.retrieval.images.windows.TILE_BYTES", 1 << 19)
    banded = multipass(*pair)
    for one, other in zip(whole[:4], banded[:4], strict=True):
        torch.testing.assert_close(one, other, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_correlation": 2}, "min_correlation: 2"),
        ({"noise": -1.0}, "noise: -1.0 is not"),
        ({"template": 1}, "template: 1 px"),
        ({"search": 70}, "search: 70 px does not fit"),
        ({"image2": torch.ones(60, 71)}, "differ"),
    ],
)
def test_bad_input_is_named(change, message):
    pair = dict(zip(("image1", "image2"), shifted(0, 0), strict=True))
    with pytest.raises(InputError, match=message):
        multipass(**pair | change)
