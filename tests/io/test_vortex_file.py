"""Files of vortex pairs. Detects a number that is not what was written, and files that are none."""

import json

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import sections
from lidar_mi.io.vortex_file import read_vortices, write_vortices
from lidar_mi.retrieval.vortices.pair import VortexPairFit


def some_pair(profile="lamb_oseen", reasons=()):
    random = np.random.default_rng(1)
    root = 0.1 * random.standard_normal((10, 10))
    theta = np.array([400.0, 1.1, 23.0, 0.5, -390.0, 1.3, -24.0, 0.0, 0.3, -0.1])
    return VortexPairFit(theta, root @ root.T, profile, np.nan, 0.9, 0.2, 3.0, reasons)


@pytest.mark.parametrize("profile", ["lamb_oseen", "burnham_hallock"])
def test_what_is_read_is_what_was_written(tmp_path, profile):
    """The wind anywhere and its errors to the last digit."""
    fit = some_pair(profile)
    nothing = VortexPairFit(
        np.full(10, np.nan),
        np.full((10, 10), np.nan),
        profile,
        *[np.nan] * 4,
        ("no vortex signature",),
    )
    write_vortices(tmp_path / "vortex.json", {"images": fit, "vectors": nothing}, source="a test")
    read = read_vortices(tmp_path / "vortex.json")
    assert list(read) == ["images", "vectors"]
    y, z = np.linspace(-40, 40, 17)[None, :], np.linspace(-20, 20, 9)[:, None]
    for name, field in fit.wind(y, z).items():
        np.testing.assert_array_equal(read["images"].wind(y, z)[name], field)
    assert read["images"].quantities == fit.quantities and read["images"].success
    assert np.isnan(read["images"].chi2)
    assert (
        read["vectors"].reasons == ("no vortex signature",)
        and np.isnan(read["vectors"].parameters).all()
    )
    # anyone's JSON reader takes it, and finds numbers with units
    data = json.loads((tmp_path / "vortex.json").read_text(), parse_constant=pytest.fail)
    output = data["fits"]["images"]["quantities"]["port_circulation"]
    assert output["value"] == 400.0 and output["units"] == "m2 s-1" and output["stderr"] > 0
    assert data["source"] == "a test" and data["parameters"][2] == "port_y"


def changed(path, **changes):
    write_vortices(path, {"images": some_pair()})
    data = json.loads(path.read_text())
    data["fits"]["images"] |= changes
    path.write_text(json.dumps(data))


def test_a_file_without_pairs_is_named(tmp_path):
    path = tmp_path / "vortex.json"
    matrix = some_pair().covariance.tolist()
    matrix[0][1] += 1.0
    for text, message in (
        (None, "No such file"),
        ("{", "not JSON"),
        ("[]", "not a file of vortex pairs"),
        ('{"format": "lidar-mi vortex pairs 1"}', "fits: missing"),
    ):
        if text is not None:
            path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_vortices(path)
    for changes, message in (
        ({"parameters": [1.0]}, "expected 10 and 10 x 10"),
        ({"chi2": "much"}, "expected parameters"),
        ({"profile": "rankine"}, "fits.images.profile: 'rankine'"),
        ({"covariance": matrix}, "fits.images.covariance: not symmetric"),
    ):
        changed(path, **changes)
        with pytest.raises(InputError) as error:
            read_vortices(path)
        assert message in str(error.value) and "\n" not in str(error.value)


def test_info_prints_a_pair(tmp_path):
    write_vortices(tmp_path / "vortex.json", {"images": some_pair()})
    ((title, rows),) = sections(str(tmp_path / "vortex.json"))
    assert "images" in title and "lamb oseen" in title
    ((_, value, units),) = [row for row in rows if row[0] == "circulation of the port vortex"]
    assert value.startswith("400 ") and units == "m2 s-1"
