"""The method of radial velocities on slices of known vortices. Physics tier.

Detects: vortices on the wrong side or of the wrong sense, circulations that ignore the range
weighting, a second vortex on the slope of the first.
"""

import numpy as np
import pytest

from lidar_mi.atmosphere.vortex import velocity as pair_velocity
from lidar_mi.atmosphere.vortex import vortex_pair
from lidar_mi.errors import InputError
from lidar_mi.instrument.coherent.measurement import measured_lines
from lidar_mi.instrument.coherent.scans import rhi_scan
from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.line_vortices.rv_method import radial_velocity_vortices

LIDAR = CoherentLidar(first_gate=400.0, gate_step=10.0, gates=40)


def lines(separation, snr=1.0):
    vortices = vortex_pair(400.0, separation, 3.0, 600.0, 60.0, "burnham_hallock")

    def wind(x, y, z, time):
        # the slice is to the north
        v, w = pair_velocity(vortices, y, z)
        return np.zeros_like(v), v + 2.0, w

    scan = rhi_scan(0.0, (0.0, np.deg2rad(12)), np.deg2rad(2), 0.1)
    found = measured_lines(wind, scan, LIDAR, snr, seed=3)
    return found.assign_attrs(pulse_length=LIDAR.pulse_length)


@pytest.mark.parametrize("separation", [60.0, 120.0])
def test_a_pair_of_its_own_model_comes_back(separation):
    """To 3 m in place and 12 % in strength: the median that it takes for the wind has the pair."""
    found = radial_velocity_vortices(lines(separation)).isel(scan=0)
    half = separation / 2
    np.testing.assert_allclose(found["y"], [600 - half, 600 + half], atol=3.0)
    np.testing.assert_allclose(found["z"], 60, atol=2.0)
    np.testing.assert_allclose(found["circulation"], [-400, 400], rtol=0.12)
    seconds = (found["time"].values - lines(separation)["time"].values[0]) / np.timedelta64(1, "s")
    # the line at the height of 60 m passes after 5.7 degrees
    expected = np.rad2deg(np.arctan2(60, [600 - half, 600 + half])) / 2
    np.testing.assert_allclose(seconds, expected, atol=0.3)


def test_lines_of_an_unknown_pulse_are_refused():
    unknown = lines(60.0)
    del unknown.attrs["pulse_length"]
    with pytest.raises(InputError, match="the attribute pulse_length is missing"):
        radial_velocity_vortices(unknown)
