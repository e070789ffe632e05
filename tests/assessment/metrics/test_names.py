"""Names of metrics: those of older files are understood.

Detects a former name that is no longer known, or a name of today that is taken for one.
"""

import json

import pytest

from lidar_mi.assessment.metrics.names import current_name, title_of
from lidar_mi.experiment.folder.records import read_metrics

# as 0.9 wrote them, in a run and (with a variant's name before it) in a study
FORMER = {
    "backscatter_noisy.variational.reduced_variance_w": "normalised_error_variance_w",
    "sensor.reduced_variance_v_los": "normalised_error_variance_v_los",
    "backscatter.cc.found_fraction": "retrieved_fraction",
    "doppler.ca.centre_known.averaged_5.found_fraction": "retrieved_fraction",
    "sensor.good_fraction": "valid_fraction",
    "sensor.lines_read": "lines_retrieved",
    "error_budget.cc.shear.share": "fraction",
    "error_budget.cc.outside_cores.shear.share_v": "fraction_v",
    "sensor.error_budget.line_noise.share_u": "fraction_u",
    "vortex.images.flow_error": "model_error",
}
CURRENT = (
    "backscatter.cc.outside_cores.rmse_v",
    "backscatter.multiple_scattering_fraction",
    "error_budget.cc.shear.fraction",
    "sensor.error_budget.sampling.rmse_u",
    "share.doppler.photons",  # a variant may be called so
)


@pytest.mark.parametrize(("key", "quantity"), FORMER.items())
@pytest.mark.parametrize("variant", ["", "share."])
def test_a_former_name_is_understood(variant, key, quantity):
    assert current_name(variant + key) == f"{variant}{key.rpartition('.')[0]}.{quantity}"


def test_sampling_error_between_lines():
    found = [current_name(f"sensor.error_budget.between_lines.{q}") for q in ("rmse_u", "share_u")]
    assert found == [
        "sensor.error_budget.sampling.rmse_u",
        "sensor.error_budget.sampling.fraction_u",
    ]


@pytest.mark.parametrize("key", CURRENT)
def test_a_current_name_stays(key):
    assert current_name(key) == key


def test_metrics_of_an_older_run_are_read_by_the_names_of_today(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps({key: 0.5 for key in (*FORMER, *CURRENT)}))
    found = read_metrics(tmp_path)
    assert set(found.values()) == {0.5} and set(CURRENT) < set(found)
    assert found["sensor.valid_fraction"] == 0.5 and not set(FORMER) & set(found)


def test_headings_begin_with_the_quantity():
    for key, title in (
        ("backscatter_noisy.variational.all.rmse_v", "rms error of v, backscatter noisy, variat"),
        ("sensor.valid_fraction", "fraction of valid vectors, sensor"),
        ("backscatter.depolarization_stderr", "standard error of depolarization, backscatter"),
        ("encounter.perfect.largest_roll", "largest bank angle, encounter, perfect"),
    ):
        assert title_of(key).startswith(title)
