"""The vortex fit as a method among others: detects a vector that differs from the fit's own wind,
and a failed fit that leaves valid vectors."""

import numpy as np
import pytest
import xarray as xr

from benchmarks.cases import vortex_pair_images
from lidar_mi.flags import Flag
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.vortex_pairs import uneven

DT = 0.1

SMALL = {"columns": 130, "rows": 90}


@pytest.mark.slow
def test_vectors_and_numbers_in_one_data_set(tmp_path):
    pair = vortex_pair_images(0.02, seed=11, vortices=uneven(), **SMALL)
    found = retrieve_wind(
        pair.first, pair.second, DT, "vortex_fit", windows=WindowSizes(stride=2), noise=0.02
    )
    fit = fit_vortices(pair.first, pair.second, DT, noise=0.02)
    assert (found.flag == 0).all() and found.attrs["fit"] == "accepted"
    assert found.attrs["profile"] == "lamb_oseen"
    for name, quantity in fit.quantities.items():
        assert float(found[name]) == pytest.approx(quantity.value)
        assert float(found[f"{name}_stderr"]) == pytest.approx(quantity.stderr)
        assert found[name].attrs["units"] == quantity.units
    model = fit.wind(found.y.values[None, :], found.z.values[:, None])
    for name in ("v", "w", "v_stderr", "w_stderr", "vw_correlation"):
        np.testing.assert_allclose(found[name], model[name], rtol=1e-5, atol=1e-5)
    found.to_netcdf(tmp_path / "wind.nc", engine="h5netcdf")
    # beside a method that knows no such numbers
    other = retrieve_wind(pair.first, pair.second, DT, "cc", windows=WindowSizes(stride=2))
    both = xr.concat([other, found], "method", combine_attrs="drop_conflicts")
    assert np.isnan(both.separation[0]) and both.separation[1] == found.separation


@pytest.mark.slow
def test_a_failed_fit_leaves_no_good_vector():
    random = np.random.default_rng(5)
    pair = vortex_pair_images(0.0, columns=60, rows=50)
    images = [pair.first.copy(data=1 + random.standard_normal(pair.first.shape)) for _ in range(2)]
    found = retrieve_wind(*images, DT, "vortex_fit", noise=1.0)
    assert (found.flag & Flag.NO_MATCH.value > 0).all() and found.attrs["fit"] != "accepted"
