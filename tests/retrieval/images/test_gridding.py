"""Images from scattered beams on regular nodes.

Detects an error of 0.005 px in where structure lies, of 10 % in the noise stated, and a value of a
beam on its node that changes in its last bit.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array, plane_waves, texture

SPACING, SIZE = 0.5, (60, 50)
Y, Z = axes(*SIZE)
NODES = np.stack(np.meshgrid(Y, Z))
WAVES = plane_waves(3, 3.0, SPACING)


def scan(places, values, **more):
    fields = {"Y": values, "y_reported": places[0], "z_reported": places[1]} | more
    return xr.Dataset({name: data_array(field, Y, Z) for name, field in fields.items()})


def scattered(px, seed=1):
    """Places beside the nodes by a normal error of so many px in each direction."""
    return NODES + px * SPACING * np.random.default_rng(seed).standard_normal(NODES.shape)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [(0.3, 0.2), (0.5, 0.5)])
def test_displacement_of_a_known_shift(offset):
    """Beams a known part of a pixel off their nodes: what they see is where it is.

    To 0.005 px in the mean, 0.01 px rms in single windows.
    """
    places = NODES + SPACING * np.reshape(offset, (2, 1, 1))
    exact = data_array(texture(WAVES, *NODES), Y, Z)
    gridded = on_nodes(scan(places, texture(WAVES, *places)))["Y"]
    quick = {"checks": False, "standard_errors": False, "noise": 0.003}
    wind = retrieve_wind(exact, gridded, 1.0, "multipass", **quick)
    for axis in "yz":
        assert abs(float(wind[f"displacement_{axis}"].mean())) < 0.005 * SPACING
        assert float(wind[f"displacement_{axis}"].std()) < 0.01 * SPACING


def test_linear_fields_and_times_are_exact():
    places = scattered(0.3)
    field = 2 + 0.03 * places[0] - 0.02 * places[1]
    found = on_nodes(scan(places, field, beam_time=1e-3 * places[1]))
    expected = 2 + 0.03 * NODES[0] - 0.02 * NODES[1]
    inside = found["Y"].notnull().values
    np.testing.assert_allclose(found["Y"].values[inside], expected[inside], atol=1e-5)
    middle = np.s_[3:-3, 3:-3]
    np.testing.assert_allclose(
        found["beam_time"].values[middle], 1e-3 * NODES[1][middle], atol=1e-7
    )


def test_noise_follows_the_weights():
    """Of 200 draws of white noise: 4 sigma in the mean variance over the image."""
    places, sigma = scattered(0.3), 0.1 + 0.05 * np.abs(np.sin(NODES[0]))
    noise = xr.DataArray(np.ones(SIZE[::-1]), dims=("z", "y"))
    random, draws = np.random.default_rng(2), 200
    rows = sigma * random.standard_normal((draws, *sigma.shape))
    many = scan(places, sigma, Y_noise_std=sigma).assign(S0_noisy=(("draw", "z", "y"), rows))
    found = on_nodes(many)
    ratio = (found["S0_noisy"] ** 2).mean("draw") / found["Y_noise_std"] ** 2
    # neighbours correlate over some 4 px
    effective = draws * int(noise.sum()) / 4
    assert abs(float(ratio.mean()) - 1) < 4 * np.sqrt(2 / effective)
    # half way between beams half of the noise is averaged away; beams on one spot do not amplify it
    half = on_nodes(scan(NODES + SPACING / 2, sigma, Y_noise_std=np.ones_like(sigma)))
    assert 0.6 < float(half["Y_noise_std"].mean()) < 0.8


def test_beams_on_their_nodes_do_not_change():
    """Bit by bit, in single precision, whatever the neighbours do."""
    random = np.random.default_rng(4)
    values = random.standard_normal(NODES.shape[1:]).astype(np.float32)
    off = random.random(values.shape) < 0.1
    places = np.where(off, scattered(0.3), NODES + 1e-5 * SPACING)
    given = scan(places, values)
    given["Y"] = given["Y"].astype(np.float32)
    found = on_nodes(given)["Y"]
    assert found.dtype == np.float32
    assert found.values[~off].tobytes() == values[~off].tobytes()
    assert (found.values[off] != values[off]).mean() > 0.9
    assert "y_reported" not in on_nodes(given)
    everywhere = scan(NODES, values)
    xr.testing.assert_identical(
        on_nodes(everywhere), everywhere.drop_vars(["y_reported", "z_reported"])
    )


def test_film_order_does_not_matter():
    """The same beams in another order, as those of a curve."""
    places = scattered(0.2)
    values = texture(WAVES, *places)
    mixed = np.random.default_rng(5).permutation(values.size)
    shuffled = [part.ravel()[mixed].reshape(values.shape) for part in (*places, values)]
    one, other = on_nodes(scan(places, values)), on_nodes(scan(shuffled[:2], shuffled[2]))
    np.testing.assert_allclose(one["Y"], other["Y"], atol=1e-9)


def test_no_value_beyond_the_beams():
    places = NODES + np.reshape([2.2 * SPACING, 0.0], (2, 1, 1))
    found = on_nodes(scan(places, texture(WAVES, *places)))["Y"]
    assert found[:, :3].isnull().all() and found[:, 3:].notnull().all()
    hole = NODES.copy()
    hole[:, 20:30, 20:30] = NODES[:, :10, :10] + 0.01
    found = on_nodes(scan(hole, texture(WAVES, *hole)))["Y"]
    assert found[23:27, 23:27].isnull().all() and found[30:, :].notnull().all()


def test_bad_places():
    values = texture(WAVES, *NODES)
    missing = NODES.copy()
    missing[0, 3, 4] = np.nan
    with pytest.raises(InputError, match="y_reported: 1 beams are not finite"):
        on_nodes(scan(missing, values))
    line = np.stack([NODES[0], 0.5 * NODES[0]])
    with pytest.raises(InputError, match="beams in one line are not allowed"):
        on_nodes(scan(line, values))
