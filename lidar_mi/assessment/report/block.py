"""A block of a campaign's report: panels under one heading."""

from collections.abc import Sequence
from typing import NamedTuple

import xarray as xr

from lidar_mi.assessment.metrics.units import unit_of


class Block(NamedTuple):
    """Panels under one heading, SVG."""

    title: str
    text: str
    panels: Sequence[str]


def label_of(array: xr.DataArray, key: str) -> str:
    """Axis label of a metric or a key: its long name and its unit."""
    unit = array.attrs.get("units") or unit_of(key)
    return f"{array.attrs.get('long_name') or key}{f' / {unit}' if unit not in ('', '1') else ''}"
