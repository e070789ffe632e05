"""What a lidar sees of the truth. Detects a smear over the gate that goes the wrong way, is off by
5 % in width, or leaves out the pulse."""

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import norm, qmc

import lidar_mi as lm
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.instrument.lidar import BackscatterLidar


def gate_mean(image, lidar, distance, depth, photons=512):
    """The image seen by oblique beams, by brute force: photons of a Gaussian beam from all of the
    gate, as far as their place in the pulse leaves their range in it."""
    u = qmc.Sobol(4, seed=1).random(photons)
    place = depth * (u[:, 0] - 0.5)
    delay = 299792458 / 2 * lidar.pulse_duration / np.sqrt(8 * np.log(2)) * norm.ppf(u[:, 1])
    kept = np.abs(place + delay) <= depth / 2
    spread = lidar.radius_at(distance) / 2
    dy, dz = spread * norm.ppf(u[kept, 2:]).T
    y, z = image["y"].values, image["z"].values
    air = RegularGridInterpolator((z, y), image.values)
    zz, yy = np.meshgrid(z[6:-6], y[6:-6], indexing="ij")
    stretch = 1 + place[kept] / distance
    return sum(
        air((zz * k + b, yy * k + a)) for a, b, k in zip(dy, dz, stretch, strict=True)
    ) / len(dy)


@pytest.mark.parametrize("duration", [0.0, 10e-9])
def test_oblique_beams_smear_the_plane_over_the_gate(duration):
    """White structure of 0.06 rms, 40 m ahead, where a beam 7 m off the axis moves by 0.4 m in a
    gate of 2.5 m. 512 quasi-random photons average it to 1e-4 rms."""
    rng = np.random.default_rng(3)
    y, z = np.arange(40) * 0.5 - 9.75, np.arange(30) * 0.5 - 7.25
    rough = xr.DataArray(1 + 0.2 * rng.random((30, 40)), {"z": z, "y": y}, ("z", "y"))
    lidar, distance, depth = BackscatterLidar(pulse_duration=duration), 40.0, 2.5
    blurred = blur_by_beam(rough, lidar, distance, depth).values[6:-6, 6:-6]
    expected = gate_mean(rough, lidar, distance, depth)
    assert np.std(blurred - expected) < 2e-4
    # no smear, or one wider by a twentieth
    for other in (0.0, 1.05 * depth):
        wrong = blur_by_beam(rough, lidar, distance, other).values[6:-6, 6:-6]
        assert np.std(wrong - expected) > 3e-4


def test_experiment_without_a_wake_has_no_truth():
    with pytest.raises(lm.InputError, match="wake: missing in fringes"):
        lm.make_truth(lm.load_experiment("fringes"))
