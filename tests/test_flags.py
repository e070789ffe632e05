"""Flags as CF attributes: detects bits that are read back under another name, and words alone."""

import enum

import pytest

from lidar_mi import flags
from lidar_mi.flags import flag_attributes, masks_of

ENUMERATIONS = [
    kind
    for kind in vars(flags).values()
    if isinstance(kind, type) and issubclass(kind, enum.IntFlag)
]


@pytest.mark.parametrize("kind", ENUMERATIONS)
def test_flags_are_read_as_they_were_written(kind):
    attributes = flag_attributes(kind, "reasons")
    assert attributes["long_name"] == "reasons, 0 = valid"
    assert masks_of(attributes) == {bit.name.lower(): bit.value for bit in kind}


def test_without_bits_there_is_no_flag():
    """Values that are enumerated have meanings and no masks."""
    assert masks_of({}) == masks_of({"flag_meanings": "done failed"}) == {}
