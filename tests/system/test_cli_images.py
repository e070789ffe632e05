"""The commands render and retrieve. Detects an option without effect, a slab that misses the lidar
equation by 0.1 %, and winds that are not those of a run."""

import numpy as np
import OpenEXR
import pytest
import xarray as xr
from PIL import Image

from lidar_mi.io.exr import read_scan
from tests.support.flows import axes, data_array, plane_waves, texture
from tests.support.timed import uniform_wind


def test_render_fills_in_the_scene(there, lidar_mi):
    code, out, _ = lidar_mi(
        "render",
        "slab.xml",
        "-s",
        8,
        "-D",
        "range=485",
        "-D",
        "stop=487.5",
        "--seed",
        3,
        "-m",
        "llvm_ad_mono",
        "-o",
        "near.exr",
    )
    assert code == 0 and "near.exr" in out
    scan = read_scan(there / "near.exr")
    assert scan.sizes == {"gate": 1, "z": 17, "y": 21}
    attributes = {
        "gate_start": 485.0,
        "gate_stop": 487.5,
        "samples_per_beam": 8,
        "seed": 3,
        "variant": "llvm_ad_mono",
        "max_order": 1,
        "estimator": "gated",
    }
    assert {key: scan.attrs[key] for key in attributes} == attributes
    # 6.2 and 3.9 degrees, in the middle of the gate
    assert scan["y"].values[-1] == pytest.approx(486.25 * np.tan(np.radians(6.2)), rel=1e-5)
    assert scan["z"].values[0] == pytest.approx(-486.25 * np.tan(np.radians(3.9)), rel=1e-5)


def test_rendered_slab_obeys_the_lidar_equation(there, lidar_mi):
    """Y = S0 r^2 / (A dr) = beta T^2 with beta = 3/(8 pi) 1.8 / km, there and back through 499.5 m
    of 0.1 / km and, to the middle of the gate, 1.75 m of slab, both longer where the beam is
    oblique. The mean over 357 beams of 64 photons scatters by less than 0.01 %; 0.1 % is asked."""
    assert lidar_mi("render", "slab.xml", "-s", 64)[0] == 0
    scan = read_scan(there / "slab.exr")  # beside the scene
    with Image.open(there / "slab.png") as preview:
        assert preview.size == (scan.sizes["y"], scan.sizes["z"])
    slope2 = (scan["z"] ** 2 + scan["y"] ** 2).values / 501.25**2
    oblique = np.sqrt(1 + slope2)
    depth = (1e-4 * 499.5 + 1.8e-3 * 1.75) * oblique
    theory = 3 / (8 * np.pi) * 1.8e-3 * np.exp(-2 * depth)
    assert (scan["Y"].values / theory).mean() == pytest.approx(1, abs=1e-3)


def test_number_of_samples_is_the_scene_s_by_default(there, lidar_mi):
    """And the name of the preview, given, makes both files; its black and white are said."""
    code, out, _ = lidar_mi("render", "slab.xml", "-o", "a.png")
    assert code == 0 and "black is 0.0001" in out
    with Image.open(there / "a.png") as preview:
        assert np.asarray(preview).std() > 20
    assert read_scan(there / "a.exr").attrs["samples_per_beam"] == 64


def test_retrieve_equals_the_run(demo, there, lidar_mi):
    """The same images by the two ways, with the noise that their files tell."""
    one, other = (demo.folder / f"image_t{k}.exr" for k in (1, 2))
    code, out, _ = lidar_mi("retrieve", one, other, "--dt", 0.1, "--method", "cc", "-o", "w.nc")
    assert code == 0 and "204 x 124 vectors" in out
    with xr.open_dataset("w.nc") as wind, xr.open_dataset(demo.folder / "wind.nc") as run:
        same = run.sel(source="backscatter", algorithm="cc")
        for name in ("v", "w", "y_vector"):
            np.testing.assert_array_equal(wind[name].values, same[name].values)
        # the noise comes with the images, so that flags agree too
        np.testing.assert_array_equal(wind["flag"].values, same["flag"].values)
        assert f"{float((wind['flag'] == 0).mean()):.1%} valid" in out


def test_retrieve_accepts_any_image_with_a_spacing(there, lidar_mi):
    """A random image moved by 2 px to the left (+y) and 1 px down, 0.25 m a pixel, 0.5 s."""
    noise = np.random.default_rng(5).random((60, 70)).astype(np.float32)
    noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + 1).astype(np.float32)
    for name, image in (("a", noise[5:45, 5:55]), ("b", noise[4:44, 7:57])):
        OpenEXR.File({}, {"G": np.ascontiguousarray(image)}).write(f"{name}.exr")
    code, *_ = lidar_mi(
        "retrieve",
        "a.exr",
        "b.exr",
        "--dt",
        0.5,
        "--layer",
        "G",
        "--spacing",
        0.25,
        "--stride",
        3,
        "--method",
        "cc",
        "-o",
        "w.nc",
    )
    assert code == 0
    with xr.open_dataset("w.nc") as wind:
        valid = (wind["flag"] == 0).values
        assert valid.mean() > 0.9
        assert np.median(wind["v"].values[valid]) == pytest.approx(1.0, abs=0.05)
        assert np.median(wind["w"].values[valid]) == pytest.approx(-0.5, abs=0.05)


def test_retrieve_resamples_scans_by_angles_to_one_grid(there, lidar_mi):
    assert lidar_mi("render", "slab.xml", "-s", 4, "-o", "far.exr")[0] == 0
    assert (
        lidar_mi(
            "render", "slab.xml", "-s", 4, "-D", "range=485", "-D", "stop=487.5", "-o", "near.exr"
        )[0]
        == 0
    )
    code, *_ = lidar_mi(
        "retrieve", "far.exr", "near.exr", "--dt", 0.1, "--template", 4, "--search", 8, "-o", "w.nc"
    )
    # a homogeneous slab: nothing but noise to follow
    assert code in (0, 1)
    with xr.open_dataset("w.nc") as wind:
        steps = np.diff(wind["y"].values)
        assert np.ptp(steps) < 1e-3 * steps.mean()
        # a homogeneous slab: nothing but noise to follow
        assert float((wind["flag"] == 0).mean()) < 0.02


def write_timed(path, image, time, places=None, **header):
    """An image with the times and places of its beams, as a run's, in the pilot's view."""
    layers = {"Y": image.values, "beam_time": time.values}
    if places is not None:
        layers |= {"y_reported": places[0], "z_reported": places[1]}
    layers = {n: np.ascontiguousarray(v[::-1, ::-1], dtype="f4") for n, v in layers.items()}
    axes = {axis: image[axis].values.astype("f4") for axis in ("y", "z")}
    OpenEXR.File(axes | header, layers).write(str(path))


@pytest.mark.slow
def test_retrieve_uses_the_times_of_scans(there, lidar_mi):
    """Of air that moves during the scan; not where the file says that it was frozen."""
    images, times = uniform_wind("raster", 6.0, 12.0, (60, 50))
    for number in (0, 1):
        write_timed(there / f"moving{number}.exr", images[number], times[number])
        write_timed(there / f"frozen{number}.exr", images[number], times[number], frozen_air=1)
    found = {}
    for name in ("moving", "frozen"):
        files = [f"{name}{number}.exr" for number in (0, 1)]
        options = ["--dt", 0.1, "--method", "multipass", "-o", f"{name}.nc"]
        assert lidar_mi("retrieve", *files, *options)[0] == 0
        found[name] = xr.load_dataset(there / f"{name}.nc")
    assert float(found["moving"]["w"].mean()) == pytest.approx(12.0, abs=0.05)
    # 1 / (1 - g . v), as in tests/retrieval/images/test_beam_times.py: 5 %
    assert float(found["frozen"]["w"].mean()) == pytest.approx(12.61, abs=0.05)
    assert np.ptp(found["moving"]["time"].values) > 0.05


def test_retrieve_puts_beams_on_the_nodes(there, lidar_mi):
    """Beams 0.6 px further to port in scan 2: not a wind of 3 m/s."""
    y, z = axes(50, 44)
    nodes = np.stack(np.meshgrid(y, z))
    waves = plane_waves(5, 4.0, 0.5)
    for number, offset in enumerate((0.0, 0.3)):
        places = nodes + np.reshape([offset, 0.0], (2, 1, 1))
        image = data_array(texture(waves, *places), y, z)
        write_timed(there / f"beside{number}.exr", image, 0 * image, places)
    options = ["--dt", 0.1, "--method", "multipass", "-o", "beside.nc"]
    assert lidar_mi("retrieve", "beside0.exr", "beside1.exr", *options)[0] == 0
    wind = xr.load_dataset(there / "beside.nc")
    assert abs(float(wind["v"].where(wind["flag"] == 0).mean())) < 0.03
