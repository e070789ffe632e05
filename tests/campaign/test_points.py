"""Points of a campaign: order, values, random numbers.

Detects: a point with another's settings, coordinates that are not what its experiment has, members
that differ in more than their random numbers, samples that do not fill space.
"""

import numpy as np
import pytest

from lidar_mi.campaign.description import Campaign
from lidar_mi.campaign.folder import create
from lidar_mi.campaign.points import Points, member_seed
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from tests.support.experiments import small


def points(base=None, **keys):
    campaign = Campaign(name="test", base="small", **keys)
    return Points(campaign, small() | (base or {}), ".")


def test_the_order_is_that_of_the_file_with_members_fastest():
    found = points(
        sweep={
            "platform.dt": ["0.1 s", "0.2 s"],
            "case": {"a": {}, "b": {"platform.speed": "9 m/s"}},
        },
        members=3,
    )
    assert found.shape == (2, 2, 3) and len(found) == 12
    assert found.title(11) == "platform.dt 0.2 s, case b, member 2"
    last = found.experiment(11)
    assert (last.platform.dt, last.platform.speed) == (0.2, 9.0)
    first = found.experiment(0)
    assert (first.platform.dt, first.platform.speed) == (0.1, 150.0)


def test_members_have_the_same_random_numbers_at_every_point():
    found = points(sweep={"platform.dt": ["0.1 s", "0.2 s"]}, members=4, seed=7)
    seeds = np.array([found.experiment(n).seed for n in range(8)]).reshape(2, 4)
    assert (seeds[0] == seeds[1]).all() and len(set(seeds[0])) == 4
    assert seeds[0, 2] == member_seed(7, 2)
    other = points(sweep={"platform.dt": ["0.1 s"]}, members=4, seed=8)
    assert not {other.experiment(n).seed for n in range(4)} & set(seeds[0].tolist())


def test_coordinates_are_what_the_experiments_have_in_si():
    found = points(
        sweep={
            "platform.dt": ["100 ms", "200 ms"],
            "range": {"75 ft": {"scan.thickness": "1 m"}, "75 m": {"scan.thickness": "2 m"}},
            "retrieval.methods": [["cc"], ["variational"]],
        }
    )
    coordinates = found.coordinates()
    assert coordinates["platform.dt"] == ("platform.dt", [0.1, 0.2])
    np.testing.assert_allclose(coordinates["range"][1], [75 * 0.3048, 75])
    assert coordinates["retrieval.methods"][1] == ["['cc']", "['variational']"]
    assert found.units() == {"platform.dt": "s", "range": "m"}


def test_keys_that_share_their_values_are_one_dimension():
    found = points(sweep={"platform.speed, platform.dt": [0.25, 0.5]})
    second = found.experiment(1)
    assert (second.platform.speed, second.platform.dt) == (0.5, 0.5)
    assert list(found.coordinates()) == ["platform.speed"]


@pytest.mark.parametrize("method", ["sobol", "latin_hypercube"])
def test_samples_fill_space(method):
    over = {
        "platform.dt": {"log": ["0.01 s", "1 s"]},
        "platform.speed": {"linear": ["10 m/s", "50 m/s"]},
    }
    found = points(sample={"method": method, "n": 64, "over": over}, seed=3)
    coordinates = found.coordinates()
    dt = (np.log10(coordinates["platform.dt"][1]) + 2) / 2
    speed = (np.array(coordinates["platform.speed"][1]) - 10) / 40
    for unit in (dt, speed):
        # one point in each of 64 strata: both kinds of sample promise it
        assert sorted(np.floor(64 * unit).astype(int)) == list(range(64))
    again = points(sample={"method": method, "n": 64, "over": over}, seed=3)
    assert again.coordinates() == coordinates
    if method == "sobol":  # and one in each cell of a net, which a hypercube does not promise
        cells = set(zip(np.floor(8 * dt).astype(int), np.floor(8 * speed).astype(int), strict=True))
        assert len(cells) == 64


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"sweep": {"platform.dtt": ["1 s", "2 s"]}}, "platform.dtt: unknown key"),
        ({"sweep": {"platform.dt": ["1 kg", "2 kg"]}}, "platform.dt: '1 kg' is not allowed"),
        ({"sweep": {"doppler.lidar.range": ["56 m", "76 m"]}}, "has no section doppler.lidar"),
        ({"sweep": {"case": {"a": {}, "b": {}}}}, "sweep.case: changes nothing between case a"),
        ({"sweep": {"platform.dt": ["0.1 s", "0.10 s"]}}, "sweep.platform.dt: changes nothing"),
        (
            {"sweep": {"platform.dt": ["1 s", "2 s"], "case": {"a": {"platform": {"dt": "3 s"}}}}},
            "sweep.case: platform.dt is not allowed; expected no key that platform.dt changes",
        ),
    ],
)
def test_every_point_is_checked_before_anything_is_written(tmp_path, keys, message):
    with pytest.raises(InputError, match=message):
        create(points(**keys), tmp_path / "campaign", silent)
    assert not (tmp_path / "campaign").exists()
