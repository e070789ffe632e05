"""Causes of error in time and pose, switched off in turn.

Detects: a cause that stays on in the images without it, a cause that a platform does not have, one
that takes another with it.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.stages.error_budget import budgets, platforms_without
from lidar_mi.experiment.stages.ideal_images import ideal_scan, slab_images
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.experiment.truth.flows import flows_of
from lidar_mi.instrument.motion import Motion
from lidar_mi.schema import reading

RATE = 2e-3  # rad/s


def experiment(**platform):
    return reading.check(
        {
            "name": "small",
            "wake": {
                "vortex_pair": {
                    "circulation": 100, "separation": 16, "core_radius": 3,
                    "width": 30, "height": 20,
                },
                "texture": {"rms": 0.2, "outer_scale": "10 m"},
            },
            "platform": {"speed": "150 m/s", "dt": "0.1 s", **platform},
            "scan": {"air": "moving", "timing": {"pattern": "serpentine", "duration": "90 ms"}},
            "retrieval": {"methods": ["multipass"], "stride": 2, "error_budget": True},
        },
        "test",
    )  # fmt: skip


def budget_of(asked):
    """From scans that are 0.013 of what the beams see, with hardly any noise."""
    truth, flows = make_truth(asked), flows_of(asked)
    plans, scans = call(scan_plans, asked, truth=truth), []
    for air, plan in zip(
        call(slab_images, asked, truth=truth, flows=flows, plans=plans), plans, strict=True
    ):
        scan = ideal_scan(air, plan, asked.lidar, asked.scan.thickness)
        s0 = 1.3e-5 * scan["Y"].expand_dims("gate")
        scan = scan.assign(Y=0.013 * scan["Y"], S0=s0, S0_stderr=1e-6 * s0)
        scans.append(scan.assign_attrs(frozen_air=0))
    return budgets(asked, truth, scans, cores=[], flagged=True)["multipass"]


@pytest.mark.slow
def test_a_gyroscope_that_drifts_is_all_of_the_error():
    """Yaw that drifts by 2 mrad/s feigns a wind of 501.25 m x 2 mrad/s = 1.0 m/s along y."""
    found = budget_of(experiment(reported={"drift": {"yaw": f"{RATE} rad/s"}}))
    assert found["rmse_v"] == pytest.approx(501.25 * RATE, rel=0.15)
    assert found["navigation.fraction_v"] > 0.85
    # no motion, no jitter, no detector; and what does not matter
    assert {"motion.fraction", "scanner_jitter.fraction", "shear.fraction"}.isdisjoint(found)
    assert abs(found["scan_time.fraction"]) < 0.1 and abs(found["monte_carlo.fraction"]) < 0.05


@pytest.mark.slow
def test_a_telescope_that_shakes():
    """Jitter of 0.5 mrad misplaces every pixel by 0.25 m of 0.5 m, with perfect navigation."""
    found = budget_of(experiment(motion={"scanner_jitter": "0.5 mrad"}))
    assert found["scanner_jitter.fraction"] > 0.5
    assert "navigation.fraction" not in found and "motion.fraction" not in found


def test_causes_of_a_platform():
    assert platforms_without(experiment().platform) == {}
    platform = experiment(
        motion={"attitude": {"rms": "1 deg", "bandwidth": "1 Hz"}, "scanner_jitter": "20 urad"},
        reported={"latency": "1 ms"},
    ).platform
    without = platforms_without(platform)
    assert list(without) == ["motion", "scanner_jitter", "navigation"]
    assert without["motion"].motion == Motion().model_copy(
        update={"scanner_jitter": platform.motion.scanner_jitter}
    )
    assert without["motion"].reported == platform.reported
    assert without["scanner_jitter"].motion.attitude == platform.motion.attitude
    assert without["scanner_jitter"].motion.scanner_jitter == 0
    assert without["navigation"].motion == platform.motion
    assert without["navigation"].reported is None


def test_frozen_air_is_seen_as_in_a_photograph_at_any_time():
    frozen = experiment().model_copy(
        update={"scan": experiment().scan.model_copy(update={"air": "frozen"})}
    )
    truth = make_truth(frozen)
    plans = call(scan_plans, frozen, truth=truth)
    images = call(slab_images, frozen, truth=truth, flows=flows_of(frozen), plans=plans)
    assert all("time" not in image.dims for image in images)
    seen = ideal_scan(images[1], plans[1])
    xr.testing.assert_allclose(seen["Y"], images[1])
    assert np.isfinite(seen["beam_time"]).all()
