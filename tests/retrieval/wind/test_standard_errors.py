"""Standard errors of vectors of other programs. Physics tier.

Detects: errors that do not hold, too small or too large, outliers that are not found, a component
in another's place, and vectors on a grid that is refused or should be.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter, map_coordinates

import lidar_mi as lm

ROWS, COLUMNS, DT = 72, 88, 0.5
CURL = 0.06  # 1/s: a solid rotation, whose wind is known everywhere


def true_wind(z, y):
    """Of a rotation about the middle, m/s; pixels of 1 m."""
    return -CURL * (z - ROWS / 2), CURL * (y - COLUMNS / 2)


@pytest.fixture(scope="module")
def pair():
    """Air that turns by 0.03 rad, with noise of 2 %."""
    random = np.random.default_rng(4)
    air = 1 + 0.1 * gaussian_filter(random.normal(size=(ROWS, COLUMNS)), 1.5) / 0.19
    z, y = np.mgrid[:ROWS, :COLUMNS].astype(float)
    turned = -CURL * DT  # back to where it came from
    dz, dy = z - ROWS / 2, y - COLUMNS / 2
    came = (
        ROWS / 2 + np.cos(turned) * dz + np.sin(turned) * dy,
        COLUMNS / 2 - np.sin(turned) * dz + np.cos(turned) * dy,
    )
    second = map_coordinates(air, came, order=5, mode="mirror")
    coords = {
        name: (name, np.arange(n, dtype=float), {"units": "m"})
        for name, n in (("z", ROWS), ("y", COLUMNS))
    }
    return [
        xr.DataArray(image + random.normal(0, 0.02, image.shape), coords, ("z", "y"))
        for image in (air, second)
    ]


def vectors(step, sigma, seed=7):
    """The true wind with independent errors of each component, on a grid of its own."""
    random = np.random.default_rng(seed)
    z, y = 10 + step * np.arange(52 // step + 1.0), 12 + step * np.arange(64 // step + 1.0)
    v, w = true_wind(*np.meshgrid(z, y, indexing="ij"))
    coords = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    return [
        xr.DataArray(one + random.normal(0, spread, one.shape), coords, ("z", "y"))
        for one, spread in zip((v, w), sigma, strict=True)
    ]


def test_the_wind_is_what_the_images_show(pair):
    """Else all that follows tests nothing: the sense of the rotation, 0.05 px."""
    found = lm.retrieve_wind(*pair, DT, windows=lm.WindowSizes(stride=4))
    v, w = true_wind(found["z"].values[:, None], found["y"].values[None, :])
    for name, true in (("v", v), ("w", w)):
        error = (found[name] - true).where(found["flag"] == 0)
        assert float(np.sqrt((error**2).mean())) < 0.05


@pytest.mark.parametrize("sigma", [(0.2, 0.2), (0.5, 0.1)])
def test_stated_errors_are_those_that_were_added(pair, sigma):
    """221 vectors, independent (windows as wide as their step); means of 35 are known to 12 %."""
    v, w = vectors(4, sigma)
    errors = lm.standard_errors(*pair, v, w, DT, window=4)
    valid = errors["flag"] == 0
    assert float(valid.mean()) > 0.95
    for name, expected in zip("vw", sigma, strict=True):
        stated = errors[f"{name}_stderr"].where(valid)
        assert float(stated.mean()) == pytest.approx(expected, rel=0.12)
    true = dict(zip("vw", true_wind(v["z"].values[:, None], v["y"].values[None, :]), strict=True))
    z = np.concatenate(
        [
            ((errors[name] - true[name]) / errors[f"{name}_stderr"]).values[valid.values]
            for name in "vw"
        ]
    )
    # 442 numbers: a variance is known to 7 %
    assert np.mean(z**2) == pytest.approx(1, abs=0.21)
    assert np.mean(np.abs(z) < 1) == pytest.approx(0.68, abs=0.08)


@pytest.mark.slow
def test_outliers_are_flagged_and_count_for_nothing(pair):
    v, w = vectors(4, (0.2, 0.2))
    clean = lm.standard_errors(*pair, v, w, DT, window=4)
    v[6, 8] += 8.0
    errors = lm.standard_errors(*pair, v, w, DT, window=4)
    assert errors["flag"].values[6, 8] & lm.Flag.MEDIAN_OUTLIER.value
    around = np.s_[4:9, 6:11]
    ratio = errors["v_stderr"].values[around] / clean["v_stderr"].values[around]
    assert np.nanmax(ratio) < 1.2


@pytest.mark.slow
def test_missing_vectors_and_too_few(pair):
    """A single known vector is no evidence; where there is none, there is no error."""
    v, w = vectors(4, (0.2, 0.2))
    v[:, :8] = np.nan
    errors = lm.standard_errors(*pair, v, w, DT, window=4)
    assert (errors["flag"][:, :3] & lm.Flag.ERROR_UNKNOWN.value).all()
    assert float((errors["flag"][:, 10:] == 0).mean()) > 0.9
    few = [one.where((one["z"] == 34) & (one["y"] == 44)) for one in (v, w)]
    assert (lm.standard_errors(*pair, *few, DT, window=4)["flag"] != 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.rename(z="x"), "expected z and y"),
        (lambda v: v.assign_coords(z=v["z"] - 100), r"v\.z: .* not within the images"),
        (lambda v: v.isel(z=[0, 1, 3, 4]), "not uniform and ascending"),
        (lambda v: v.isel(z=slice(None, None, 2)), "steps of 8 and 4 px"),
    ],
)
def test_unsuitable_grids_are_refused(pair, change, message):
    v, w = (change(one) for one in vectors(4, (0.2, 0.2)))
    with pytest.raises(lm.InputError, match=message):
        lm.standard_errors(*pair, v, w, DT, window=4)


def test_a_window_of_nothing_is_refused(pair):
    with pytest.raises(lm.InputError, match="window: 1 px"):
        lm.standard_errors(*pair, *vectors(4, (0.2, 0.2)), DT, window=1)
