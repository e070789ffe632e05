"""From air that moves during a scan to its wind. Slow.

Detects: 0.02 m/s of bias by the time of the beams, a run that takes times for those of the
reference, time along the wrong axis or of the wrong sign.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.experiment.run import complete, prepare
from tests.support.experiments import check, leave_out_figures, write_wake

DT, DURATION, HEIGHT = 0.1, 0.09, 31 / 61 * 60
V, W = 5.0, 12.0


def tracer(y, z):
    """Waves of 4 to 9 m in all directions."""
    rng = np.random.default_rng(1)
    total = 0.0
    for length in np.geomspace(4, 9, 30):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        along = np.cos(angle) * y + np.sin(angle) * z
        total = total + np.cos(2 * np.pi / length * along + phase)
    return 1 + 0.9 * np.tanh(0.25 * total)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_uniform_wind_through_a_scan_of_nearly_dt(tmp_path, monkeypatch):
    """A raster from top to bottom: air that rises is met earlier by the second scan.

    Its displacement is w (dt + dtau), dtau = -(T / H) times itself: w / (1 + w T / H) where all
    pixels are taken for simultaneous, 3.4 % less.
    """
    leave_out_figures(monkeypatch)
    name = write_wake(tmp_path / "uniform.nc", tracer, v=V, w=W)
    description = {
        "name": "uniform",
        "wake": {"file": name, "texture": {"rms": 0}, "spacing": "0.5 m"},
        "platform": {"speed": "75 m/s", "dt": DT},
        "scan": {"air": "moving", "timing": {"pattern": "raster", "duration": DURATION}},
        "lidar": {"beam_radius": "0.02 m", "beam_cut": "0.05 m", "divergence_full": "0.2 mrad"},
        "render": {"samples_per_beam": 64, "max_order": 1},
        "retrieval": {"methods": ["multipass"]},
    }
    run = complete(prepare(check(description), tmp_path))
    wind = run.results["wind"].sel(source="backscatter").isel(algorithm=0)
    # away from where air enters
    inner = wind.sel(y=slice(-14, 14), z=slice(-9, 9))
    assert float(inner["v"].mean()) == pytest.approx(V, abs=0.02)
    assert float(inner["w"].mean()) == pytest.approx(W, abs=0.02)
    assert np.ptp(inner["time"].values) > 0.5 * DURATION
    images = [scan["Y"] for scan in run.results["scans"]]
    photograph = lm.retrieve_wind(*images, DT, method="multipass")
    off = float(photograph["w"].sel(y=slice(-14, 14), z=slice(-9, 9)).mean()) - W
    assert off == pytest.approx(W / (1 + W * DURATION / HEIGHT) - W, abs=0.03)
