"""Whether a flow can be a wake's.

Detects: divergence or vorticity with a wrong derivative (closed forms of linear flows), a flow of a
wrong sign that passes, a pair that does not, a rising pair that is taken for a sinking one.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.flow_checks import (
    MOST_DIVERGENCE,
    relative_divergence,
    rises,
    sense_of_rotation,
)
from lidar_mi.atmosphere.vortices.cores import find_cores
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair

Y, Z = np.arange(-40.0, 41.0), np.arange(-25.0, 26.0)


def wind(v, w):
    shape = (Z.size, Y.size)
    axes = {"z": Z, "y": Y}
    fields = {"v": v, "w": w}
    return xr.Dataset({n: (("z", "y"), np.broadcast_to(f, shape)) for n, f in fields.items()}, axes)


def pair(sign=1.0):
    """The wind of a pair of vortices."""
    return wind(
        *(sign * c for c in velocity(vortex_pair(300.0, 30.0, core_radius=3.0), Y, Z[:, None]))
    )


@pytest.mark.parametrize(
    ("flow", "expected"),
    [
        (wind(-Z[:, None], Y), 0.0),  # solid rotation
        (wind(0.3 * Y - Z[:, None], 0.1 * Z[:, None]), 0.4),  # divergence 0.4, vorticity 1
        (wind(Y + 0 * Z[:, None], Z[:, None]), np.nan),  # no vorticity
    ],
)
def test_linear_flows(flow, expected):
    assert relative_divergence(flow) == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_a_pair_passes_and_one_with_a_wrong_sign_does_not():
    right = pair()
    assert relative_divergence(right) < 0.1 < MOST_DIVERGENCE
    for wrong in (
        right.assign(v=-right["v"]),
        right.assign(w=-right["w"]),
        right.assign_coords(y=-Y).sortby("y"),
    ):
        assert relative_divergence(wrong) > 1.5 * MOST_DIVERGENCE


def test_air_between_the_vortices_of_an_aircraft_sinks():
    for sign, word in ((1.0, "sinks"), (-1.0, "rises")):
        flow = pair(sign)
        cores = find_cores(flow)
        assert sign * float(flow["w"].sel(y=0, z=0)) < 0
        assert rises(cores) == (sign < 0)
        assert sense_of_rotation(flow, cores).endswith(f"the pair {word}")
    assert sense_of_rotation(flow, []) == "no vortices" and not rises(cores[:1])
    assert "rises" not in sense_of_rotation(flow, cores[:1])


def test_circulations_are_those_of_the_vortices():
    """Of 300 m^2/s by the pair's definition; rings of 5 to 15 m have 98 % of it around 3 m."""
    flow = pair()
    text = sense_of_rotation(flow, find_cores(flow))
    port, starboard = (float(part.split(" m²/s")[0]) for part in text.split(", ")[::2])
    assert port == pytest.approx(300, rel=0.05) == -starboard
    narrow = flow.sel(y=slice(-20, 20))
    assert "m²/s (core of" in sense_of_rotation(narrow, find_cores(narrow))
