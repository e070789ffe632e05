"""A rendered image against an independent blur of the extinction by the beam.

Detects: an image wrong by 0.1 % of a pixel, a mirrored axis, a beam profile that is not the
laser's, standard errors of pixels that are not theirs, and planes of a volume with wrong weights in
the gate."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import norm, qmc

from lidar_mi.experiment.folder.run_folder import IMAGES
from lidar_mi.experiment.run import run
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.io.exr import read_scan
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.schema import reading as config
from tests.support.experiments import check, small, write_wake

SCENES = Path(str(files("lidar_mi.scenes")))


def footprint_mean(image, lidar, distance, count=4096):
    """The image seen by beams, by brute force: photons of the laser's profile and divergence,
    the air linear between nodes. Shares nothing with the package."""
    u = qmc.Sobol(4, seed=1).random(count)
    inside = 1 - np.exp(-2 * (lidar.beam_cut / lidar.beam_radius) ** 2)
    r = lidar.beam_radius * np.sqrt(-0.5 * np.log1p(-u[:, 0] * inside))
    # 1/e^2 half angle of a Gaussian = two standard deviations
    spread = lidar.divergence_full / 4 * distance
    dy = r * np.cos(2 * np.pi * u[:, 1]) + spread * norm.ppf(u[:, 2])
    dz = r * np.sin(2 * np.pi * u[:, 1]) + spread * norm.ppf(u[:, 3])
    y, z = image["y"].values, image["z"].values
    air = RegularGridInterpolator((z, y), image.values)
    zz, yy = np.meshgrid(z[6:-6], y[6:-6], indexing="ij")
    return sum(air((zz + b, yy + a)) for a, b in zip(dy, dz, strict=True)) / count


@pytest.fixture
def rough():
    rng = np.random.default_rng(3)
    y, z = np.arange(40) * 0.5, np.arange(30) * 0.5
    return xr.DataArray(1 + 0.2 * rng.random((30, 40)), {"z": z, "y": y}, ("z", "y"))


@pytest.mark.parametrize(
    "lidar, distance",
    [
        (BackscatterLidar(), 501.25),
        (BackscatterLidar(), 100.0),
        (BackscatterLidar(divergence_full="0.5 mrad", beam_radius=0.3, beam_cut=0.6), 300.0),
    ],
)
def test_blur_by_beam_is_the_mean_over_the_footprint(rough, lidar, distance):
    """White structure, the hardest case. 4096 quasi-random photons average it to about 2e-4; the
    aperture is no Gaussian, which costs as much where it is as wide as the cells."""
    blurred = blur_by_beam(rough, lidar, distance).values[6:-6, 6:-6]
    np.testing.assert_allclose(blurred, footprint_mean(rough, lidar, distance), atol=6e-4)
    assert np.std(blurred) < 0.9 * np.std(rough.values)


def test_blur_by_beam_keeps_even_and_linear_air(rough):
    linear = rough.copy(data=2 + 0.3 * rough["y"].values - 0.1 * rough["z"].values[:, None])
    blurred = blur_by_beam(linear, BackscatterLidar(), 501.25)
    np.testing.assert_allclose(blurred.values[6:-6, 6:-6], linear.values[6:-6, 6:-6], rtol=1e-12)


@pytest.mark.slow
def test_image_is_the_blurred_extinction_within_its_standard_errors():
    """Single scattering by the textured wake against theory, at both times, pixel by pixel.

    Y = 3/(8 pi) x extinction seen by the beam x exp(-2 (extinction - environment) x way in the
    slab). Expected deviations: the pixels' own standard errors. Those are correct on average but
    small where the value came out small (rare null collisions), so the ratio of sums is taken:
    its scatter is (2/25000)^(1/2) = 0.01. What the theory leaves out (smear of oblique beams over
    the depth, attenuation by structure) is 0.05 % of a pixel, 0.01 of the noise's square here. A
    mirrored axis gives a ratio of 1e4, blur by the bare Gaussian 20.
    """
    use_variant("llvm_ad_mono_polarized")
    plan_of, lidar, environment = Scan(), BackscatterLidar(), 1e-4
    truth = make_truth(config.load(SCENES / "wake_backscatter.yaml"), SCENES)
    axes = (truth.wind["y"].values, truth.wind["z"].values)
    plans = plan_scans(plan_of, *axes, (0.0, 15.0))
    solids = [
        extrude(field.isel(x=0).transpose("z", "y"), plans[0], lidar) for field in truth.extinction
    ]
    way = float(solids[0]["x"].attrs["cell_width"]) / 2
    seeds = range(4)
    sums, squares = [0, 0], [0, 0]
    for seed in seeds:
        settings = RenderSettings(samples_per_beam=64, max_order=1)
        phase = {"type": "rayleigh_polarized"}
        scans = render_scans(
            solids, plans, lidar, ScatteringAir(environment, phase, 1.0), settings, seed
        )
        for k, scan in enumerate(scans):
            relative = (scan["S0_stderr"] / scan["S0"]).values[0]
            sums[k] = sums[k] + scan["Y"].values / len(seeds)
            squares[k] = squares[k] + (scan["Y"].values * relative / len(seeds)) ** 2
    inner = (slice(6, -6), slice(6, -6))
    for k in (0, 1):
        air = blur_by_beam(truth.image(k), lidar, plans[k].centre).values
        theory = 3 / (8 * np.pi) * air * np.exp(-2 * (air - environment) * way)
        z_square = ((sums[k] / theory - 1) ** 2)[inner]
        noise = (squares[k] / theory**2)[inner]
        assert z_square.sum() / noise.sum() == pytest.approx(1, abs=0.05)
        # and no offset: standard error of the mean over all pixels is 2e-5
        assert (sums[k] / theory)[inner].mean() == pytest.approx(1, abs=2e-4)


@pytest.mark.slow
def test_volume_image_is_the_mean_over_the_gate(tmp_path, quick):
    """As for the plane, in three dimensions: structure that differs from plane to plane (texture
    of 20 %), gates of 2.5 m across planes of 1 m. Equal weights for the two planes inside the
    gates give a ratio of 22."""
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 8))
    render = {"samples_per_beam": 256, "max_order": 1, "random_numbers": "independent"}
    data = small() | {"render": render}
    data["wake"] = {"file": name, "depth": "volume", "texture": {"rms": 0.2, "outer_scale": "4 m"}}
    data["scattering"] = {"phase": "rayleigh"}
    run(check(data), tmp_path / "run", beside=tmp_path)
    truth = make_truth(check(data), tmp_path)
    scan = read_scan(tmp_path / "run" / IMAGES[0])
    air = blur_by_beam(truth.image(0), BackscatterLidar(), 501.25).values
    # the whole of the slab before the gates' middle, 4 m of 8
    before = truth.extinction[0].isel(x=slice(0, 4)).mean("x").transpose("z", "y").values
    theory = 3 / (8 * np.pi) * air * np.exp(-2 * (before - 1e-4) * 4)
    inner = (slice(6, -6), slice(6, -6))
    relative = (scan["S0_stderr"] / scan["S0"]).values[0][inner]
    error = (scan["Y"].values / theory - 1)[inner]
    # scatter of the ratio 0.03; oblique beams cross the planes up to 0.05 m beside their nodes
    assert (error**2).sum() / (relative**2).sum() == pytest.approx(1, abs=0.15)
    assert error.mean() == pytest.approx(0, abs=2e-3)
