"""What a campaign's report says the lidar added, over many flights.

Detects the autopilot's work credited to the lidar, flights without anything to add that count, a
spread that is not that of the flights.
"""

import numpy as np
import xarray as xr

from lidar_mi.assessment.report.encounters import encounter_blocks


def told(autopilot, lidar, perfect, start, lead):
    rolls = {"off": [20.0] * 4, "autopilot": autopilot, "feedforward": lidar, "perfect": perfect}
    known = {
        f"encounter.{mode}.largest_roll": xr.DataArray(np.radians(values), dims="sample")
        for mode, values in rolls.items()
    }
    times = {"preview_from": start, "lead_time": lead}
    known |= {f"encounter.{k}": xr.DataArray(v, dims="sample") for k, v in times.items()}
    *_, block = encounter_blocks(known)
    return block.text


def test_the_verdict_over_flights():
    """Two flights with 4 and 6 degrees to remove, of which 3 and 6 are; two with nothing."""
    text = told(
        [5.0, 8.0, 1.0, 1.0], [2.0, 2.0, 0.9, 1.6], [1.0, 2.0, 0.8, 0.7], [1, 1, 1, 1], [1, 1, 1, 1]
    )
    assert "Of 4 flights 0 never had a preview and 0 had it too late" in text
    assert "1 are worse than with the autopilot by more than 0.5 degrees" in text
    assert "In 2 of them" in text and "the lidar removes 90 % in sum" in text
    # residuals of the ratio are -0.6 and 0.6: 0.849 sqrt(2) / 10
    assert "(standard error 12 %), 88 % in the median flight" in text and "75 % in the wo" in text


def test_blind_lidars_add_nothing():
    same = [5.0, 8.0, 3.0, 9.0]
    text = told(same, same, [1.0] * 4, [np.nan, np.nan, 1, 1], [np.nan, np.nan, -0.5, 0.5])
    assert "Of 4 flights 2 never had a preview and 1 had it too late" in text
    assert "Of this the lidar removes 0 % in sum (standard error 0 %)" in text


def test_nothing_to_add():
    text = told([1.0] * 4, [0.9] * 4, [0.8] * 4, [1.0] * 4, [1.0] * 4)
    assert text.endswith("there was nothing for the lidar to add.")
