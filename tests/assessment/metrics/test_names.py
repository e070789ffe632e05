"""Titles of metrics in reports."""

from lidar_mi.assessment.metrics.names import title_of


def test_headings_begin_with_the_quantity():
    for key, title in (
        ("backscatter_noisy.variational.all.rmse_v", "rms error of v, backscatter noisy, variat"),
        ("sensor.valid_fraction", "fraction of valid vectors, sensor"),
        ("backscatter.depolarization_stderr", "standard error of depolarization, backscatter"),
        ("encounter.perfect.largest_roll", "largest bank angle, encounter, perfect"),
    ):
        assert title_of(key).startswith(title)
