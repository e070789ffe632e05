"""Names in reports. Detects a method that would have none, and end a report in a KeyError."""

from lidar_mi.assessment.labels import METHOD_NAMES, SOURCE_NAMES, title_of
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.retrieval.method_names import ImageMethod, VolumeMethod


def test_every_method_and_source_has_a_name():
    # names of both enumerations are strings: "variational" is one key
    assert {*ImageMethod, *VolumeMethod} <= set(METHOD_NAMES)
    assert set(SOURCE_NAMES) == set(Source)


def test_headings_begin_with_the_quantity():
    for key, title in (
        (
            "backscatter_noisy.variational.all.rmse_v",
            "rms error of v, backscatter with detector noise, variational retrieval",
        ),
        ("sensor.coverage_95_w", "coverage of 95 %, w, sensor"),
        ("sensor.valid_fraction", "fraction of valid vectors, sensor"),
        ("backscatter.depolarization_stderr", "standard error of depolarization, backscatter"),
        ("encounter.perfect.largest_roll", "largest bank angle, encounter, perfect"),
    ):
        assert title_of(key) == title
