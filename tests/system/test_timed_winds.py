"""A run whose scans take time: from beams with times to winds.

Detects times that are lost or used where air is frozen: 0.3 m/s of 10 m/s.
"""

import pytest

import lidar_mi as lm
from lidar_mi.schema import reading as config
from tests.support.experiments import write_wake
from tests.support.flows import plane_waves, texture

DT, DURATION, V, W = 0.1, 0.1, 3.0, 10.0


@pytest.mark.slow
@pytest.mark.parametrize("air", ["moving", "frozen"])
def test_uniform_wind_seen_by_a_raster(tmp_path, air):
    """Right to 0.03 m/s; moving air taken for photographs is 3 % too fast, as theory says."""
    waves = plane_waves(1, 3.0, 1.0)
    write_wake(tmp_path / "wake.nc", lambda y, z: texture(waves, y, z), v=V, w=W)
    extinction = {"tracer": "tracer", "aerosol": "aerosol", "maximum": "1.8 / km"}
    wake = {"file": str(tmp_path / "wake.nc"), "spacing": "0.5 m", "extinction": extinction}
    experiment = {
        "name": air,
        "wake": wake,
        "scan": {"timing": {"pattern": "raster", "duration": f"{DURATION} s"}, "air": air},
        "platform": {"dt": f"{DT} s"},
        "lidar": {"divergence_full": "0.2 mrad"},
        "render": {"samples_per_beam": 16, "max_order": 1},
        "retrieval": {"methods": ["multipass"], "sources": "measured"},
    }
    run = lm.run(config.check(experiment, "test"), tmp_path / "run")
    found = run.wind.sel(source="backscatter", algorithm="multipass")
    valid = found["flag"] == 0
    assert float(found["w"].where(valid).mean()) == pytest.approx(W, abs=0.03)
    images = [scan["Y"] for scan in run.scans]
    taken_for_photographs = lm.retrieve_wind(*images, DT, "multipass", checks=False)
    # rows from the top or from the bottom, one after the other
    times = run.scans[0]["beam_time"]
    slope = [
        float(times.isel({axis: slice(2)}).mean(other).diff(axis).item()) / 0.5
        for axis, other in (("y", "z"), ("z", "y"))
    ]
    longer = 1 / (1 - slope[0] * V - slope[1] * W) if air == "moving" else 1.0
    wrong = float(taken_for_photographs["w"].where(valid).mean())
    assert wrong == pytest.approx(W * longer, abs=0.03)
    assert abs(longer - 1) > 0.03 or air == "frozen"
