"""What messages call lines of sight: their files."""

import xarray as xr


def source_name(lines: xr.Dataset) -> str:
    """The file of a data set, the first of several, or "lines" where it has none."""
    first, *others = str(lines.attrs.get("source", "lines")).split(", ")
    return f"{first} and {len(others)} more" if others else first
