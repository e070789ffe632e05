"""Loads of the structure in a flight: load factor and bending of the wing roots, from the trim.

Largest increments to either side: a wing is sized by the limit loads of gusts to both (CS 25.341).
"""

import numpy as np
import xarray as xr

INCREMENTS = ("largest_load_increment", "largest_bending_increment")
"""Results of `load_increments`: load factor, and bending moment of a wing root (N m)."""


def load_increments(flight: xr.Dataset) -> dict[str, float]:
    """`INCREMENTS` of a flight; NaN for an aircraft that does not rise, nothing without loads.

    flight (time): a flight from its trim; the bending of the larger of both wings counts.
    """
    if "load_factor" not in flight:
        return {}
    load = flight["load_factor"] - flight["load_factor"].isel(time=0)
    bending = np.abs(np.stack([flight[f"{side}_bending"] for side in ("port", "starboard")]))
    return dict(zip(INCREMENTS, (float(np.abs(load).max()), float(bending.max())), strict=True))
