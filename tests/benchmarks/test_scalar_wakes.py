"""The scorer of the open benchmark. Unit tier.

Detects: vectors that count where they should not, a sense or a scale of .flo files that is not the
truth's, and scores that are not those of errors that were put in.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from benchmarks.scalar_wakes import cases, programs, score
from lidar_mi.io.flo_file import write_flo


@pytest.fixture
def truth():
    z, y = np.arange(-20.0, 21), np.arange(-30.0, 31)
    v, w = 0.1 * np.meshgrid(z, y, indexing="ij")[0], np.full((41, 61), 2.0)
    on = ("z", "y")
    data = {"v": (on, v), "w": (on, w), "flag": (on, np.zeros(v.shape, int))}
    moved = {"displacement_y": (on, v * 0.1), "displacement_z": (on, w * 0.1)}
    return xr.Dataset(data | moved, {"z": z, "y": y}, {"dt": 0.1})


def test_sixty_pairs_with_names_of_their_own():
    names = [name for _, _, name in cases.names()]
    assert len(names) == len(set(names)) == 60
    assert len({case.seed for case in cases.CASES}) == len(cases.CASES)


def test_the_truth_has_no_error(truth, tmp_path):
    write_flo(tmp_path / "a.flo", truth, (1.0, 1.0))
    for found in (truth, score.read_vectors(tmp_path / "a.flo", truth)):
        result = score.score([score.errors_of(found, truth)])
        assert result.rms < 1e-6 and result.valid == 1.0 and np.isnan(result.variance)


def test_unknown_vectors_of_a_flo_file_are_not_valid(truth, tmp_path):
    truth["flag"][20:, :] = 1
    write_flo(tmp_path / "a.flo", truth, (1.0, 1.0))
    result = score.score([score.errors_of(score.read_vectors(tmp_path / "a.flo", truth), truth)])
    assert result.valid == pytest.approx(11 / 23)  # rows inside the rim of 8: -11 to 11


def test_scores_are_those_of_errors_that_were_put_in(truth):
    """23 x 43 vectors of two components: a variance is known to 3 %."""
    random = np.random.default_rng(1)
    on, shape = ("z", "y"), truth["v"].shape
    found = truth.copy()
    for name in "vw":
        found[name] = on, truth[name].values + random.normal(0, 0.3, shape)
        found[f"{name}_stderr"] = on, np.full(shape, 0.3)
    result = score.score([score.errors_of(found, truth)])
    assert result.rms == pytest.approx(0.3, rel=0.05)
    assert result.variance == pytest.approx(1, abs=0.1)
    assert result.coverage == pytest.approx((0.683, 0.95), abs=0.03)


def test_vectors_near_the_rim_and_flagged_ones_do_not_count(truth):
    found = truth.copy(deep=True)
    found["v"][:7] += 100  # z below -13
    found["v"][20, 30] += 100
    found["flag"][20, 30] = 4
    result = score.score([score.errors_of(found, truth)])
    assert result.rms == 0 and result.valid < 1


@pytest.mark.slow
def test_programs_find_a_known_motion():
    """Each that is installed, of air that moves by 2 px to port and 1 px up; FF-PIV errs to 0."""
    random = np.random.default_rng(3)
    air = 1000 * (1 + 0.3 * gaussian_filter(random.standard_normal((90, 110)), 2.0) / 0.14)
    z, y = np.arange(80.0), np.arange(100.0)
    first, second = (
        xr.DataArray(
            air[up : up + 80, port : port + 100],
            {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})},
            ("z", "y"),
        )
        for up, port in ((4, 6), (3, 4))
    )
    for name, program in programs.PROGRAMS.items():
        found = program(first, second, 0.1)
        inner = found.sel(z=slice(10, 70), y=slice(10, 90))
        low = 0.6 if name.startswith("FF-PIV") else 0.9
        for component, true in (("v", 20.0), ("w", 10.0)):
            assert low * true < float(inner[component].median()) < 1.05 * true, name
