"""What stays of a point: its metrics, its estimates too, or a whole run folder.

Detects: results that are lost though they were asked for, images of shared points that a run folder
lacks, a run folder that cannot be resumed, a torn file that ends the campaign or is believed.
"""

from types import SimpleNamespace

import pytest

from lidar_mi.campaign import worker
from lidar_mi.campaign.collect import collect, open_campaign
from lidar_mi.campaign.engine import prepare_campaign
from lidar_mi.campaign.status import campaign_status
from lidar_mi.campaign.worker import carry_out
from lidar_mi.experiment.folder.records import read_metrics
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.run import run
from lidar_mi.io.netcdf import read_netcdf
from tests.support.campaigns import described
from tests.support.experiments import leave_out_figures


@pytest.mark.slow
@pytest.mark.parametrize(
    "keep", ["metrics", pytest.param("estimates", marks=pytest.mark.slow), "everything"]
)
def test_what_stays_of_a_point(tmp_path, monkeypatch, keep):
    leave_out_figures(monkeypatch)
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]}, keep=keep)
    ready = prepare_campaign(path, tmp_path / "out")
    outcomes = [carry_out(str(ready.path), number, "once") for number in range(2)]
    assert [one.rendered for one in outcomes] == [2, 0]
    assert [one.reused for one in outcomes] == [0, 2]
    place = ready.place(1)
    metrics = collect(ready).isel({"retrieval.template": 1})
    assert metrics["backscatter.cc.valid_fraction"] > 0
    names = {entry.name for entry in place.iterdir()}
    always = {"metrics.json", "outcome.json"}
    if keep == "metrics":
        assert names == always | {"experiment.yaml", "log.txt"}
    elif keep == "estimates":
        assert names == always | {"experiment.yaml", "log.txt", "wind.nc"}
        assert read_netcdf(place / "wind.nc").sizes["algorithm"] == 1
    else:
        assert names == always | {"run"}
        folder = place / "run"
        assert {"image_t1.exr", "wind.nc", "report.html"} <= {e.name for e in folder.iterdir()}
        # it is a run folder like any other
        again = run(ready.points.experiment(1), folder)
        assert read_metrics(folder).keys() == again.metrics.keys()
        assert "using 2 of 2 images" in (folder / "log.txt").read_text()


def test_a_torn_point_is_computed_again(tmp_path, monkeypatch):
    """Files of a machine that lost power: half of the text, none, or another kind of it."""

    def computed(experiment, *_):
        size = experiment.retrieval.template
        return SimpleNamespace(log=Log(), seconds={}, metrics={"backscatter.cc.rmse_v": size / 10})

    monkeypatch.setattr(worker, "_prepared", computed)
    monkeypatch.setattr(worker, "_compute", lambda *_: None)
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]})
    ready = prepare_campaign(path, tmp_path / "out")
    for number in range(2):
        carry_out(str(ready.path), number, "once")
    whole = collect(ready)
    metrics, outcome = (ready.place(0) / name for name in ("metrics.json", "outcome.json"))
    text = metrics.read_text()
    outcome.write_text(outcome.read_text()[:20])
    for torn in ("", "[]", text[: len(text) // 2]):
        metrics.write_text(torn)
        assert not ready.is_done(0) and ready.is_done(1)
        assert collect(ready)["status"].values.tolist() == [2, 0]  # missing
        assert campaign_status(ready.path).done == 1
    assert carry_out(str(ready.path), 0, "again").status == "done"
    assert collect(ready).identical(whole)
    data = ready.path / "campaign.nc"
    data.write_bytes(data.read_bytes()[:200])
    assert open_campaign(ready.path).identical(whole)
