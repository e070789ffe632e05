"""Campaigns of encounters: points are flown, their numbers collected and shown as distributions.

Detects: points that are run instead of flown, images taken for shared ones, a distribution that is
not that of the flights.
"""

import json
import math
import re

import numpy as np
import pytest
import yaml

from lidar_mi.assessment.report.campaign import page
from lidar_mi.campaign.collect import collect
from lidar_mi.campaign.engine import prepare_campaign
from lidar_mi.campaign.worker import carry_out
from lidar_mi.encounter.fly import fly
from lidar_mi.experiment.folder.records import METRICS

CIRCULATION = {"wake.vortex_pair.circulation": {"linear": ["10 m^2/s", "300 m^2/s"]}}


def carried_out(folder, keep, mode, count, over=CIRCULATION):
    """A campaign of flights without a lidar, in the mode of control off or perfect."""
    base = {
        "name": "base",
        "wake": {"vortex_pair": {"circulation": "350 m^2/s"}, "spacing": "1 m"},
        "encounter": {
            # along the core of the port vortex
            "path": {
                "crossing_angle": "0 deg",
                "climb_angle": "0 deg",
                "miss": {"y": "-23.55 m"},
                "start": "60 m",
                "beyond": "40 m",
            },
            "control": {"mode": mode},
        },
    }
    (folder / "base.yaml").write_text(yaml.safe_dump(base))
    described = {
        "name": "encounters",
        "base": "base.yaml",
        "seed": 1,
        "keep": keep,
        "sample": {"method": "latin_hypercube", "n": count, "over": over},
    }
    path = folder / "encounters.yaml"
    path.write_text(yaml.safe_dump(described))
    ready = prepare_campaign(path, folder / "out")
    outcomes = [carry_out(str(ready.path), number, "once") for number in range(count)]
    assert [one.status for one in outcomes] == ["done"] * count
    assert {(one.rendered, one.reused) for one in outcomes} == {(0, 0)}
    return ready


@pytest.mark.slow
def test_points_are_flown_and_their_bank_angles_shown(tmp_path):
    ready = carried_out(tmp_path, "metrics", "perfect", 4)
    data = collect(ready)
    off = data["encounter.off.largest_roll"]
    alone = fly(ready.points.experiment(3), notice=lambda text, fraction: None)
    assert float(off[3]) == alone.metrics["encounter.off.largest_roll"]
    # a stronger wake rolls the aircraft further
    order = np.argsort(data["wake.vortex_pair.circulation"].values)
    assert (np.diff(off.values[order]) > 0).all() and off.attrs["units"] == "rad"
    html = page(data, "name: encounters")
    limit = math.radians(7)
    within = 25 * int((off <= limit).sum())
    assert 0 < within < 100  # the test sees both
    found = re.search(r"without control ([\d.]+)\s±\s[\d.]+ %", html)
    assert found and float(found[1]) == within
    assert "fraction of flights" in html and "No requirement was judged" not in html


def test_everything_of_a_flight_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("lidar_mi.encounter.fly.write_report", lambda *args, **keys: None)
    ready = carried_out(tmp_path, "everything", "off", 2)
    names = {entry.name for entry in (ready.place(0) / "run").iterdir()}
    assert {"experiment.yaml", "flight.nc"} <= names


def test_a_metric_may_have_the_name_of_a_swept_key(tmp_path):
    """The time ahead and the distance ahead are both `encounter.look_ahead`."""
    key = "encounter.look_ahead"
    ready = carried_out(tmp_path, "metrics", "off", 2, {key: {"linear": ["100 m", "200 m"]}})
    for number, seconds in enumerate((1.5, 2.5)):
        path = ready.place(number) / METRICS
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: seconds}))
    data = collect(ready)
    assert data[f"{key}.metric"].values.tolist() == [1.5, 2.5]
    assert (data[key] >= 100).all() and data[key].attrs["units"] == "m"
