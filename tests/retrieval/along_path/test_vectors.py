"""Which vectors of an estimate count, and with which errors.

Detects windows that overlap and count twice, flags that are ignored, errors of pointing that are
taken for those of single vectors, a rejected u that costs v and w.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import REJECTED, CombinedFlag, flag_attributes
from lidar_mi.retrieval.along_path.vectors import counting, slab_vectors
from lidar_mi.retrieval.common_error import with_common_error


def wind(spacing=4.0, **attributes):
    """Vectors every 4 m over windows of 8 m."""
    y, z = spacing * np.arange(-5, 6), spacing * np.arange(-3, 4)
    shape = (len(z), len(y))
    values = np.arange(np.prod(shape), dtype=float).reshape(shape)
    fields = {"v": values, "w": -values, "v_stderr": 0.3 + 0 * values, "w_stderr": 0.4 + 0 * values}
    fields["vw_correlation"] = 0 * values
    data = {name: (("z", "y"), a) for name, a in fields.items()}
    data["flag"] = (("z", "y"), np.zeros(shape, np.uint16), flag_attributes(CombinedFlag, REJECTED))
    return xr.Dataset(data, {"z": z, "y": y}, attributes or {"template": 8, "stride": 4})


def test_windows_side_by_side_count():
    found = slab_vectors(counting(wind()))
    assert found.window == 8.0
    np.testing.assert_allclose(found.y, [-16, -8, 0, 8, 16])
    np.testing.assert_allclose(found.z, [-8, 0, 8])
    # those that count alone count again
    again = counting(counting(wind()))
    xr.testing.assert_identical(again, counting(wind()))
    assert slab_vectors(counting(wind(8.0, template=8, stride=8))).y.size == 11


def test_rejected_vectors_are_not_known():
    given = wind()
    given["flag"][3, 5] = 1
    given["v"][3, 7] = np.nan
    given["w_stderr"][1, 5] = 0.0
    found = slab_vectors(counting(given))
    assert (~found.valid).sum() == 3
    assert np.isnan(found.wind[:, ~found.valid]).all()


def test_a_rejected_u_does_not_cost_v_and_w():
    given = wind(window=8.0)
    given["flag"][:] = CombinedFlag.BEYOND_LINES
    assert slab_vectors(counting(given)).valid.all()
    given["flag"][3, 5] = CombinedFlag.NO_CROSSFLOW | CombinedFlag.BEYOND_LINES
    assert (~slab_vectors(counting(given)).valid).sum() == 1


def test_common_errors_are_not_those_of_vectors():
    given = with_common_error(wind(), 0.5, rotation=0.02, centre=(1.0, 2.0))
    found = slab_vectors(counting(given))
    np.testing.assert_allclose(found.stderr[0], 0.3, rtol=1e-6)
    np.testing.assert_allclose(found.stderr[1], 0.4, rtol=1e-6)
    np.testing.assert_allclose(found.common, 0.5)
    assert (found.rotation, found.centre) == (pytest.approx(0.02), (1.0, 2.0))


def test_what_is_no_wind():
    with pytest.raises(InputError, match=r"wind\.w_stderr: missing; expected v, w, their errors"):
        counting(wind().drop_vars("w_stderr"))
    with pytest.raises(InputError, match="attributes template and stride missing"):
        counting(wind(units="m"))
