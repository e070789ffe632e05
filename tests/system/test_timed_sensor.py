"""Both lidars in time, from the experiment to the files: beams and lines one after the other, from
a platform that moves and reports its pose with errors.

Detects a chain in which times or poses are lost, winds beyond their stated errors, and files
without the time of each beam.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.stats import chi2

import lidar_mi as lm
from lidar_mi.schema import reading as config
from tests.support.experiments import QUICK_DOPPLER, without_figures

DT = 0.1
TEMPLATE, STRIDE = 8, 4
PAIR = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
SMALL = {
    "name": "small",
    "seed": 3,
    "wake": {
        "vortex_pair": PAIR,
        "spacing": "0.5 m",
        "texture": {"rms": 0.3, "outer_scale": "5 m"},
    },
    "platform": {
        "speed": "70 m/s",
        "dt": f"{DT} s",
        "motion": {"attitude": {"rms": "0.5 deg", "bandwidth": "0.5 Hz"}},
        "reported": {"noise": {"pitch": "20 urad", "yaw": "20 urad"}},
    },
    "lidar": {"pulse_duration": "10 ns", "divergence_full": "0.2 mrad"},
    "scan": {
        "range": "148.75 m",
        "air": "moving",
        "timing": {"pattern": "serpentine", "duration": "90 ms"},
    },
    "render": {"samples_per_beam": 64, "max_order": 1},
    "retrieval": {
        "methods": ["multipass"],
        "template": TEMPLATE,
        "stride": STRIDE,
        "sources": "measured",
        "pointing": {"stderr": "30 urad"},
    },
    "doppler": {"lidar": {"range": "150 m", "range_bin": "5 m"}} | QUICK_DOPPLER,
    "sensor": {
        "directions": {
            "columns": 5,
            "rows": 3,
            "azimuth_half": "4 deg",
            "elevation_half": "2.5 deg",
        },
        "timing": {"pattern": "serpentine", "duration": "90 ms"},
        "method": "multipass",
    },
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("timed") / "run"
    with without_figures(), pytest.MonkeyPatch.context() as patch:
        for chapter in ("doppler", "sensor", "vortices", "pointing"):
            patch.setattr(f"lidar_mi.assessment.figures.{chapter}.draw_all", lambda *_: [])
        return folder, lm.run(config.check(SMALL, "test"), folder)


def normalised(found, name):
    valid = (found["flag"] == 0).values
    return ((found[name] - found[f"{name}_true"]) / found[f"{name}_stderr"]).values[valid]


def limits(independent):
    """Of a mean square of normal errors of variance 1, both with the probability of 4 sigma."""
    return chi2.ppf([3.2e-5, 1 - 3.2e-5], independent) / independent


@pytest.mark.slow
def test_winds_within_their_stated_errors(whole):
    """Of both lidars: mean square of as many errors as windows that do not overlap."""
    found = xr.open_dataset(whole[0] / "wind3d.nc")
    assert (found["flag"] == 0).mean() > 0.25
    for name in "uvw":
        off = normalised(found, name)
        low, high = limits(off.size * (STRIDE / TEMPLATE) ** 2)
        assert low < (off**2).mean() < high, name
        assert np.abs(off).max() < 5, name
    # times of vectors and lines were brought to the middle of both images
    assert float(found["time"]) == pytest.approx(DT / 2)


def test_images_winds_within_their_stated_errors(whole):
    """Of all vectors of the images, v and w together: 0.4 to 2 with 40 independent errors.

    Photographs from an aircraft at rest have the same errors (0.90 m/s rms, mean square 1.3).
    """
    found = xr.open_dataset(whole[0] / "wind.nc").squeeze()
    off = np.concatenate([normalised(found, name) for name in "vw"])
    low, high = limits(off.size * (STRIDE / TEMPLATE) ** 2)
    assert off.size > 150 and low < (off**2).mean() < high
    error = [(found[n] - found[f"{n}_true"]).where(found["flag"] == 0) for n in "vw"]
    assert max(float((part**2).mean()) for part in error) < high * 0.9**2


def test_lines_of_sight_within_their_stated_errors(whole):
    """Of 15 lines, each of its own time and pose: 4 sigma. The platform's velocity is reported."""
    lines = xr.open_dataset(whole[0] / "lines_of_sight.nc")
    off = ((lines["v_los"] - lines["v_los_true"]) / lines["v_los_std"]).values
    low, high = limits(15)
    assert low < (off**2).mean() < high and abs(off.mean()) < 4 / 15**0.5
    assert np.ptp(lines["time"].values) == pytest.approx(0.09 * 14 / 15, rel=0.1)


def test_files_have_the_time_of_every_beam(whole):
    for number, reference in ((1, 0.0), (2, DT)):
        scan = lm.read_scan(whole[0] / f"image_t{number}.exr")
        times = scan["beam_time"].values
        assert len(np.unique(times)) == times.size
        assert times.min() == pytest.approx(-0.045, rel=0.01) and times.max() == -times.min()
        assert scan.attrs["reference_time"] == pytest.approx(reference)
    wind = xr.open_dataset(whole[0] / "wind.nc")
    apart = wind["time"].sel(source="backscatter", algorithm="multipass") - DT / 2
    assert 0.02 < float(abs(apart).max()) < 0.045
