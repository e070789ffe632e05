"""From etalon, camera and line to a rendered image and its file.

Detects: a parameter of a description that does not reach the scene, another velocity than asked
for, an image turned over, a layer or header entry lost on the way to the file, a scene file that
does not render. That the rings are right is tested with the plugins.
"""

import math
from importlib.resources import files
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from lidar_mi.atmosphere.scattering.line import Line, backscatter_line
from lidar_mi.errors import InputError
from lidar_mi.instrument.etalon import Etalon, coated_transmission
from lidar_mi.instrument.fringe_camera import FringeCamera, fringe_image
from lidar_mi.io.exr import read_fringes, read_layers, write_fringes
from lidar_mi.rendering.fringes import render_fringes, scene_dict
from lidar_mi.rendering.scene import render_file
from lidar_mi.rendering.settings import FringeSettings

pytestmark = pytest.mark.usefixtures("variant")

WAVELENGTH = 354.7e-9
# the usual field on 10 % of the pixels
CAMERA = {"width": 96, "height": 78, "pixel": 74e-6}
LINE = backscatter_line(WAVELENGTH, 232.9, 33_154.0, aerosol_fraction=0.1)
SCENE = Path(str(files("lidar_mi.scenes"))) / "fringes.xml"


def render(etalon=None, camera=None, line=LINE, v_los=(0.0,), seed=1, **settings):
    return list(
        render_fringes(
            etalon or Etalon(),
            FringeCamera(**CAMERA | (camera or {})),
            line,
            v_los,
            FringeSettings(**{"samples_per_pixel": 64} | settings),
            seed,
        )
    )


def z_scores(rendered, expected):
    """Of the fractions of the light, in blocks of 3 x 3 pixels; 3e-4 are left to the reference."""

    def blocks(values):
        rows, columns = values.shape
        return values.reshape(rows // 3, 3, columns // 3, 3).sum((1, 3))

    found = rendered["S0"].values.astype(float)
    error = np.sqrt(blocks(rendered["S0_stderr"].values.astype(float) ** 2)) / found.sum()
    expected = blocks(expected) / expected.sum()
    z = (blocks(found) / found.sum() - expected) / np.hypot(error, 3e-4 * expected)
    return z[expected > 0.02 * expected.max()]


def cosine_fourth(camera):
    """What evenly bright light loses towards the rim, which `fringe_image` leaves out."""
    return camera.cosine(camera.radius_squared()) ** 4


def fine_image(camera, etalon, line, v_los):
    """`fringe_image` averaged over pixels by 8 x 8 points."""
    x, y = camera.centre_pixel
    size = {"width": 4 * camera.width, "height": 4 * camera.height, "pixel": camera.pixel / 4}
    fine = camera.model_copy(update=size | {"centre": (4 * x + 1.5, 4 * y + 1.5)})
    image = fringe_image(fine, etalon, line, v_los).numpy()
    return image.reshape(camera.height, 4, camera.width, 4).sum((1, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("etalon", "camera"),
    [
        ({}, {}),
        ({"gap": 11e-3, "order_fraction": 0.2, "reflectivity": 0.6, "absorption": 0.05}, {}),
        ({"order_fraction": None, "index": 1.0003, "surface_rms": 9e-9, "bow": 30e-9}, {}),
        ({}, {"centre": (30.0, 60.5), "focal_length": 0.25, "illumination_radius": 4e-3}),
        ({}, {"tilt": ("20 mrad", "-30 mrad"), "distortion": 0.02, "centre": (40.0, 45.0)}),
        ({}, {"defocus": 150e-6, "distortion": -0.02}),
    ],
)
@pytest.mark.parametrize(
    "settings",
    [{}, {"estimator": "forward", "line_shape": "sampled", "lens": "singlet"}],
    ids=["camera", "forward"],
)
def test_every_description_reaches_the_scene(etalon, camera, settings):
    (rendered,) = render(Etalon(**etalon), camera, v_los=[90.0], samples_per_pixel=256, **settings)
    described = FringeCamera(**CAMERA | camera)
    expected = fine_image(described, Etalon(**etalon), LINE, 90.0)
    z = z_scores(rendered, expected * cosine_fourth(described))
    assert abs(z.mean()) < 4 / math.sqrt(z.size)
    assert z.var() < 1 + 5 * math.sqrt(2 / z.size)


def test_coatings_reach_the_scene():
    """Against transfer matrices in double precision, s and p, for a sharp line."""
    coatings = ((2.1, "42.2 nm"), (1.48, "61 nm", 1e-3), (2.1, "50 nm"))
    etalon = Etalon(coatings=coatings, plate_index=1.5, surface_rms=0)
    sharp = Line(WAVELENGTH, [1.0], [0.0], [0.0])
    camera = FringeCamera(width=30, height=30, pixel=74e-6)
    (rendered,) = render(etalon, camera.model_dump(), sharp, samples_per_pixel=256)
    nodes = (np.arange(12) + 0.5) / 12 - 0.5
    expected = np.mean(
        [
            coated_transmission(
                etalon, WAVELENGTH, camera.cosine(camera.radius_squared((x, y))), 0.0, which
            )
            for x in nodes
            for y in nodes
            for which in "sp"
        ],
        axis=0,
    )
    z = z_scores(rendered, expected * cosine_fourth(camera))
    assert abs(z.mean()) < 4 / math.sqrt(z.size)
    assert z.var() < 1 + 5 * math.sqrt(2 / z.size)


def test_velocities_are_rendered_in_turn_and_reported():
    speeds = [-250.0, 0.0, 33.3]
    images = render(v_los=speeds)
    camera = FringeCamera(**CAMERA)
    for rendered, speed in zip(images, speeds, strict=True):
        assert rendered.attrs["v_los"] == speed
        misfit = {
            v: np.abs(z_scores(rendered, fringe_image(camera, Etalon(), LINE, v).numpy())).mean()
            for v in speeds
        }
        assert min(misfit, key=misfit.get) == speed
    alone = render(v_los=[-250.0])[0]
    assert np.array_equal(alone["S0"], images[0]["S0"])
    assert images[1].attrs["seed"] == 1 + 2**16
    assert images[0].attrs["units"] and images[0]["S0"].attrs["units"] == "1"


def test_image_and_header_survive_the_file(tmp_path):
    (rendered,) = render(Etalon(bow=3e-9), v_los=[12.5])
    path = tmp_path / "fringes.exr"
    write_fringes(path, rendered)
    back = read_fringes(path)
    assert list(tmp_path.iterdir()) == [path]
    for name in ("S0", "S1", "S2", "S3", "S0_stderr"):
        assert np.array_equal(back[name], rendered[name]) and back[name].dims == ("y", "x")
    assert set(back.attrs) == set(rendered.attrs)
    for key, value in rendered.attrs.items():
        if isinstance(value, str | int):
            assert back.attrs[key] == value
        else:
            np.testing.assert_allclose(back.attrs[key], value, rtol=1e-6)
    # the order in two parts, so that float32 holds it
    assert back.attrs["order_whole"] == 77248
    assert back.attrs["order_fraction"] == pytest.approx(0.5, abs=1e-6)
    _, layers = read_layers(path)
    assert np.array_equal(layers["Y"], rendered["S0"])
    with pytest.raises(InputError, match="are not an image of a fringe camera; expected S0, S1"):
        write_only = tmp_path / "other.exr"
        OpenEXR.File({}, {"RGB": np.zeros((4, 4, 3), np.float32)}).write(str(write_only))
        read_fringes(write_only)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["camera", "analog"])
def test_scene_file_that_ships_renders(tmp_path, estimator):
    """Whole chain of `lidar-mi render`: four rings and the radii that the description has."""
    out = tmp_path / "fringes.exr"
    fractions = []
    rendered = render_file(
        SCENE,
        out,
        "llvm_ad_mono",
        4,
        3,
        {"estimator": estimator, "v_los": "40", "lens": "fringes_lens.txt"},
        fractions.append,
    )
    assert fractions[-1] == 1
    back = read_fringes(out)
    assert back["S0"].shape == (780, 960) and np.array_equal(back["S0"], rendered["S0"])
    assert back.attrs["scene"] == "fringes.xml" and back.attrs["lens"] == "surfaces"
    assert back.attrs["v_los"] == 40 and back.attrs["samples_per_pixel"] == 4
    assert read_layers(out)[1]["S0"].shape == (780, 960)
    # annular averages, equal steps of r^2: rings are evenly spaced there
    y, x = np.mgrid[:780, :960]
    r2 = (x - 479.5) ** 2 + (y - 389.5) ** 2
    ring = np.floor(r2 / 1000).astype(int).ravel()
    profile = np.bincount(ring, rendered["S0"].values.ravel()) / np.bincount(ring)
    profile = np.convolve(profile[:170], np.ones(9) / 9, "valid")  # radii up to 412 pixels
    peaks = np.flatnonzero((profile[1:-1] > profile[:-2]) & (profile[1:-1] > profile[2:])) + 1
    peaks = peaks[profile[peaks] > 0.5 * profile.max()]
    radii = np.sqrt((peaks + 4.5) * 1000)
    orders = np.array([0.5, 1.5, 2.5, 3.5]) + 2 * 40 / WAVELENGTH / 10.9413e9
    expected = 0.3 / 7.4e-6 * np.sqrt(2 * orders / 77248.5)
    strongest = [radii[np.argmin(abs(radii - e))] for e in expected]
    np.testing.assert_allclose(np.square(strongest), expected**2, atol=5000)


def test_lens_and_field_fit_any_camera():
    """The light of a real lens covers the corners of a CCD off the axis."""
    camera = FringeCamera(**CAMERA | {"centre": (10.0, 5.0), "focal_length": 0.5})
    scene = mi.load_dict(scene_dict(Etalon(), camera, LINE, FringeSettings(lens="singlet")))
    sensor, source = scene.sensors()[0], scene.environment()
    corner = math.hypot(85.5, 72.5) * 74e-6
    assert source.field_half > math.atan(corner / 0.5)
    assert sensor.lens.shape == (3, 4) and sensor.lens[-1, 2] == pytest.approx(0.494, abs=1e-3)
    sample = [mi.Float(np.float32(np.random.default_rng(k).random(1000))) for k in range(2)]
    _, direction, weight = sensor.sample_towards_scene(mi.Point2f(95.5, 77.5), mi.Point2f(*sample))
    assert np.mean(np.array(weight) > 0) > 0.8
    assert np.all(np.array(source.radiance(-direction)) == 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: render(v_los=[0.0, math.nan]), "v_los: nan m/s is not allowed; expected finite"),
        (lambda: render(lens="singlet", stop_radius=0.05), "stop_radius: 0.05 is not allowed"),
        (lambda: render(camera={"centre": (-500.0, 0.0)}, lens="singlet"), "field: .*up to 0.05"),
    ],
)
def test_impossible_renderings_are_reported(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_scene_needs_our_integrator(tmp_path):
    path = tmp_path / "scene.xml"
    text = SCENE.read_text().replace('integrator type="fringes"', 'integrator type="path"')
    path.write_text(text.replace('<string name="estimator" value="$estimator"/>', ""))
    with pytest.raises(InputError, match="its integrator is no 'fringes'; expected one"):
        render_file(path, tmp_path / "x.exr", "llvm_ad_mono")
    path.write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    with pytest.raises(InputError, match="is no 'scanning_lidar' and no 'ccd'; expected one"):
        render_file(path, tmp_path / "x.exr", "llvm_ad_mono")
