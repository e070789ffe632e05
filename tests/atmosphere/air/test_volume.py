"""Air of a simulation. Unit and physics tier.

Detects: a volume that is shifted, turned or keeps its mean wind, divergence that is accepted, or
refused where there is none, places outside that count as inside.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.air.volume import AirVolume, divergence_fraction
from lidar_mi.errors import InputError
from tests.support.air_volumes import sampled

FIELD = turbulence(1.5, 100.0, 3, shortest=10.0)


@pytest.fixture(scope="module")
def flow():
    """The field in a wind of 8 and -3 m/s that grows by 0.02 / s with the height."""
    return sampled(FIELD, wind=(8.0, -3.0), shear=0.02)


def test_it_is_the_field_in_its_mean_wind(flow):
    """To 2 % of the rms; the shear is relative to that at the height."""
    volume = AirVolume(flow, start=100.0, centre=0.0, height=60.0)
    random = np.random.default_rng(1)
    x, y, z = random.uniform([20, -30, 35], [100, 30, 85], (400, 3)).T
    found = np.stack(volume.velocity(x, y, z, 5.0))
    true = np.stack(FIELD.velocity(x + 100, y, z, 0.0))
    true[0] += 0.02 * (z - 60)
    # of a few long waves in the volume, the mean is not the shear's alone
    difference = found - true
    offset = difference.mean(axis=1)
    assert np.abs(difference - offset[:, None]).max() < 0.05 * 1.5
    level = flow.sel(z=60.0, method="nearest").mean(("x", "y"))
    expected = [8.0 - float(level["u"]), -3.0 - float(level["v"]), 0.0]
    np.testing.assert_allclose(offset, expected, atol=0.02)


def test_mean_wind_at_the_height(flow):
    volume = AirVolume(flow, 100.0, 0.0, 60.0)
    level = flow.sel(z=60.0).mean(("x", "y"))
    assert volume.mean_wind == pytest.approx((float(level["u"]), float(level["v"])))
    above = AirVolume(flow, 100.0, 0.0, 5000.0)
    top = flow.isel(z=-1).mean(("x", "y"))
    assert above.mean_wind == pytest.approx((float(top["u"]), float(top["v"])))


def test_divergence_of_solenoidal_air_and_of_noise(flow):
    random = np.random.default_rng(2)
    noise = flow.copy(data={n: random.normal(size=flow[n].shape) for n in "uvw"})
    assert divergence_fraction(flow) < 0.05
    assert divergence_fraction(noise) == pytest.approx(1 / np.sqrt(3), abs=0.02)
    assert divergence_fraction(0 * flow) == 0
    with pytest.raises(InputError, match=r"rms divergence is 0\.5\d times .* at most 0\.2"):
        AirVolume(noise, 0.0, 0.0, 60.0)
    # one component of another field
    wrong = flow.assign(w=flow["u"] * 1.0)
    with pytest.raises(InputError, match="expected air without divergence"):
        AirVolume(wrong, 0.0, 0.0, 60.0)


def test_what_it_covers(flow):
    volume = AirVolume(flow, start=100.0, centre=0.0, height=60.0)
    assert volume.missing([0.0, 100.0], [-40.0, 40.0], [31.0, 90.0]) == {}
    missing = volume.missing([0.0, 180.0], [0.0], [20.0])
    assert set(missing) == {"x", "z"}
    assert missing["x"] == pytest.approx((100.0, 220.0, 100.0, 280.0))


def test_a_plane_is_no_volume(flow):
    with pytest.raises(InputError, match=r"1 nodes along x are not allowed; expected 4 or more"):
        AirVolume(flow.isel(x=[0]), 0.0, 0.0, 60.0)


def passing(times, wind, x=(-40.0, 400.0)):
    """States (s) of a wave that the wind carries along x and that grows by 10 % a second."""
    axes = {
        "x": np.arange(*x, 5.0),
        "y": np.arange(-30.0, 31.0, 10.0),
        "z": np.arange(20.0, 81.0, 10.0),
    }
    states = []
    for time in times:
        along = np.meshgrid(*axes.values(), indexing="ij")[0] - wind * time
        w = (1 + 0.1 * time) * np.sin(2 * np.pi * along / 80)
        values = {"u": np.full_like(w, wind), "v": np.zeros_like(w), "w": w}
        states.append(xr.Dataset({n: (("x", "y", "z"), a) for n, a in values.items()}, coords=axes))
    return xr.concat(states, "time").assign_coords(time=np.asarray(times, float))


@pytest.mark.parametrize("wind", [-12.0, 0.0, 10.0])
def test_a_series_is_carried_by_its_mean_wind_and_changes(wind):
    """In the frame of the wind the wave stands and grows, also between the states."""
    volume = AirVolume(passing(np.arange(0.0, 6.0, 1.5), wind), 80.0, 0.0, 50.0)
    random = np.random.default_rng(4)
    x, time = random.uniform(20, 200, 200), random.uniform(0, 4.5, 200)
    u, v, w = volume.velocity(x, 3.0, 47.0, time)
    # a cubic spline of 16 nodes a wave is right to 3e-4
    np.testing.assert_allclose(w, (1 + 0.1 * time) * np.sin(2 * np.pi * (x + 80) / 80), atol=2e-3)
    np.testing.assert_allclose([u, v], 0, atol=1e-5)
    frozen = AirVolume(passing([0.0], wind).isel(time=0), 80.0, 0.0, 50.0)
    _, _, stands = frozen.velocity(x, 3.0, 47.0, time)
    np.testing.assert_allclose(stands, np.sin(2 * np.pi * (x + 80) / 80), atol=2e-3)


def test_a_series_must_hold_the_places_that_the_wind_carries():
    volume = AirVolume(passing([0.0, 2.0, 4.0], 10.0), 0.0, 0.0, 50.0)
    assert volume.missing([0.0, 350.0], [0.0], [50.0], last=2.0) == {}
    # at 4 s the air is 40 m farther on
    missing = volume.missing([0.0, 360.0], [0.0], [50.0], last=2.5)
    assert missing["x"] == pytest.approx((-40.0, 395.0, 0.0, 400.0))


def test_more_divergence_is_accepted_on_request(flow):
    random = np.random.default_rng(2)
    noise = flow.copy(data={n: random.normal(size=flow[n].shape) for n in "uvw"})
    AirVolume(noise, 0.0, 0.0, 60.0, largest_divergence=0.7)
