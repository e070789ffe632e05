"""Names in reports. Detects a method that would have none, and end a report in a KeyError."""

from lidar_mi.assessment.labels import METHOD_NAMES, SOURCE_NAMES
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.retrieval.method_names import ImageMethod, VolumeMethod


def test_every_method_and_source_has_a_name():
    # names of both enumerations are strings: "variational" is one key
    assert {*ImageMethod, *VolumeMethod} <= set(METHOD_NAMES)
    assert set(SOURCE_NAMES) == set(Source)
