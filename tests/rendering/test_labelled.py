"""Rendered tensors as data sets. Unit tier.

Detects: axes that are mirrored or belong to other beams, a gate or a quantity in another's place, a
backscatter that is not the lidar equation's, and an image of another scene that is accepted.
"""

import numpy as np
import pytest

import lidar_mi as lm

FRINGES = lm.scene_file("fringes")
AIR = {
    "type": "homogeneous",
    "sigma_t": 1e-4,
    "albedo": 1.0,
    "phase": {"type": "rayleigh_polarized"},
}


def lidar(rows, columns, **changes):
    film = {"type": "hdrfilm", "width": columns, "height": rows, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "gated_volpath", "max_order": 1},
        "lidar": {
            "type": "scanning_lidar",
            "aperture_radius": 0.5,
            "fov_half_mrad": 10,
            "gate_start": 100.0,
            "gate_stop": 104.0,
            "gate_count": 2,
            "azimuth_min_deg": -2.0,
            "azimuth_max_deg": 4.0,
            "elevation_min_deg": -1.0,
            "elevation_max_deg": 1.0,
            "laser": {"type": "laser"},
            "film": film,
            "air": AIR,
        }
        | changes,
    }


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_axes_are_the_places_of_the_beams():
    """In the middle of the gates, 102 m ahead: 102 tan(angle), port (+4 degrees) first."""
    import mitsuba as mi

    scene = mi.load_dict(lidar(3, 4))
    image = mi.render(scene, spp=64, seed=1)
    scan = lm.to_xarray(image, scene)
    assert scan["y"].values == pytest.approx(102 * np.tan(np.radians([-2, 0, 2, 4])), rel=1e-5)
    assert scan["z"].values == pytest.approx(102 * np.tan(np.radians([-1, 0, 1])), abs=1e-4)
    rows = np.array(image)  # from the top, from port; five numbers of each gate
    for gate in (0, 1):
        for k, name in enumerate(("S0", "S1", "S2", "S3", "S0_stderr")):
            layer = scan[name].sel(gate=gate).values[::-1, ::-1]
            assert np.array_equal(layer, rows[..., 5 * gate + k]), name


@pytest.mark.usefixtures("variant")
def test_backscatter_is_that_of_the_air():
    """beta exp(-2 sigma r), r the middle of the first gate; beta is 1.5 sigma / (4 pi)."""
    import mitsuba as mi

    scene = mi.load_dict(lidar(1, 1, azimuth_min_deg=0.0, azimuth_max_deg=0.0))
    scan = lm.to_xarray(mi.render(scene, spp=4096, seed=2), scene)
    expected = 1.5 * 1e-4 / (4 * np.pi) * np.exp(-2 * 1e-4 * 101)
    stderr = float((scan["S0_stderr"] / scan["S0"])[0, 0, 0])
    assert stderr < 0.01
    assert float(scan["Y"][0, 0]) == pytest.approx(expected, rel=4 * stderr + 1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_rings_of_a_camera():
    import mitsuba as mi

    scene = mi.load_file(str(FRINGES))
    image = mi.render(scene, spp=2)
    frame = lm.to_xarray(image, scene)
    assert frame["S0"].dims == ("y", "x") and float(frame["S0"].max()) > 0
    assert np.array_equal(frame["S0"].values, np.array(image)[..., 0])
    assert frame.attrs["wavelength"] == pytest.approx(354.7e-9)


@pytest.mark.usefixtures("variant")
def test_other_images_and_other_cameras_are_refused():
    import mitsuba as mi

    scene = mi.load_dict(lidar(3, 4))
    with pytest.raises(lm.InputError, match=r"shape \(4, 3, 10\).*expected \(3, 4, 10\)"):
        lm.to_xarray(np.zeros((4, 3, 10)), scene)
    other = mi.load_dict({"type": "scene", "integrator": {"type": "path"}})
    with pytest.raises(lm.InputError, match="no 'scanning_lidar'"):
        lm.to_xarray(np.zeros((4, 3, 10)), other)
