"""A state at t2 that is the volume of t1, advected by its own u, v and w.

Detects: air that stays where it should move along x, or moves the wrong way, by 1e-3 of its
contrast; a loss of mass of 1e-4 in a wind without divergence; images of t1 and t2 that are not
averaged alike; air from beyond the ends of a file.
"""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.experiment.preflight.check import sections
from tests.support.experiments import check

DT = 0.1
STEP = 0.5
"""As `wake.spacing`: nothing is refined."""
X, Y, Z = (STEP * np.arange(-n, n + 1) for n in (16, 26, 22))
INNER = {"y": slice(-9, 9), "z": slice(-7, 7)}
"""Away from where air enters, m."""


def blobs(x, y, z):
    """Two of unlike sign and size on even air, one in the gates, one before them."""
    near = np.exp(-((x - 1) ** 2 + (y - 2) ** 2 + (z - 3) ** 2) / (2 * 2.0**2))
    before = np.exp(-((x + 2) ** 2 + (y + 3) ** 2 + (z + 1) ** 2) / (2 * 2.5**2))
    return 1 + 0.8 * near - 0.5 * before


def written(folder, aerosol, wind, x=X, name="volume.nc"):
    """A file of ``aerosol(x, y, z)`` in ``wind(x, y, z)``, components by name."""
    axes = {"x": x, "y": Y, "z": Z}
    grid = np.meshgrid(*axes.values(), indexing="ij")
    fields = {"aerosol": (aerosol(*grid), "1")}
    fields |= {name: (part, "m s-1") for name, part in wind(*grid).items()}
    xr.Dataset(
        {
            name: (tuple(axes), np.broadcast_to(values, grid[0].shape).copy(), {"units": unit})
            for name, (values, unit) in fields.items()
        },
        {name: (name, values, {"units": "m"}) for name, values in axes.items()},
    ).to_netcdf(folder / name, engine="h5netcdf")
    return name


def experiment(folder, file, **wake):
    """Extinction in proportion to the aerosol."""
    extinction = {"tracer": None, "background": "1 / km", "molecules": 0}
    given = {"file": file, "second": "advect_3d", "x": "0 m", "texture": {"rms": 0}}
    wake = given | {"extinction": extinction} | wake
    return check({"name": "moving", "wake": wake, "platform": {"dt": DT}}).read_from(folder)


def images(folder, file, **wake):
    truth = lm.make_truth(experiment(folder, file, **wake))
    return [truth.image(k).sel(INNER).values / 1e-3 for k in (0, 1)]


def uniform(x, y, z):
    return {"u": 8.0, "v": -5.0, "w": 7.0}


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["plane", pytest.param("volume", marks=pytest.mark.slow)])
def test_uniform_wind_displaces_the_volume(tmp_path, depth):
    """The image at t2 is that at t1 of a file whose air is displaced."""

    def displaced(x, y, z):
        wind = uniform(x, y, z)
        return blobs(x - wind["u"] * DT, y - wind["v"] * DT, z - wind["w"] * DT)

    first, second = images(tmp_path, written(tmp_path, blobs, uniform), depth=depth)
    expected, _ = images(tmp_path, written(tmp_path, displaced, uniform), depth=depth)
    # of the motion along x alone: what in-plane advection lacks
    in_plane = blobs_displaced_in_the_plane(tmp_path, depth)
    assert np.abs(second - expected).max() < 1e-3
    assert np.abs(in_plane - expected).max() > 0.1
    assert np.abs(first - expected).max() > 0.2


def blobs_displaced_in_the_plane(folder, depth):
    def displaced(x, y, z):
        wind = uniform(x, y, z)
        return blobs(x, y - wind["v"] * DT, z - wind["w"] * DT)

    return images(folder, written(folder, displaced, uniform), depth=depth)[0]


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["plane", "volume"])
def test_solid_rotation_about_an_axis_in_the_plane(tmp_path, depth):
    """Air moves from z to x and from x to -z, by 0.2 rad about the y axis."""
    omega = 2.0

    def rotating(x, y, z):
        return {"u": omega * z, "v": 0.0, "w": -omega * x}

    def rotated(x, y, z):
        cos, sin = np.cos(omega * DT), np.sin(omega * DT)
        return blobs(x * cos - z * sin, y, z * cos + x * sin)

    first, second = images(tmp_path, written(tmp_path, blobs, rotating), depth=depth)
    expected, _ = images(tmp_path, written(tmp_path, rotated, rotating), depth=depth)
    # trajectories are off by 0.3 mm at 3 m, slopes are 0.25 / m
    assert np.abs(second - expected).max() < 1e-3
    assert np.abs(first - expected).max() > 0.1


@pytest.mark.slow
def test_without_wind_along_x_it_is_in_plane_advection(tmp_path):
    """Of air that is uniform along x, without and with texture."""

    def swirling(x, y, z):
        return {"u": 0.0, "v": -1.5 * z, "w": 1.5 * y}

    def streaks(x, y, z):
        return blobs(0, y, z)

    file = written(tmp_path, streaks, swirling)
    # texture rings near edges, where smooth air and factor are interpolated apart: 3 % of its rms
    for rms, tolerance in ((0, 1e-9), (0.1, 3e-3)):
        texture = {"rms": rms, "outer_scale": "4 m"}
        along, plane = (
            images(tmp_path, file, second=second, texture=texture)
            for second in ("advect_3d", "advect")
        )
        assert np.abs(along[0] - plane[0]).max() < 1e-9
        assert (along[1] - plane[1]).std() < tolerance
        assert np.abs(along[1] - along[0]).max() > 0.1


@pytest.mark.slow
def test_texture_moves_with_the_wind_in_the_plane(tmp_path):
    """The same at all u, and the true wind is the mean over the gates."""
    file = written(tmp_path, lambda x, y, z: np.ones_like(x), uniform)
    still = written(
        tmp_path,
        lambda x, y, z: np.ones_like(x),
        lambda *grid: uniform(*grid) | {"u": 0.0},
        name="still.nc",
    )
    texture = {"rms": 0.2, "outer_scale": "4 m"}
    moved, expected = (images(tmp_path, name, texture=texture) for name in (file, still))
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert np.abs(moved[1] - moved[0]).std() > 0.05
    sheared = written(
        tmp_path, blobs, lambda x, y, z: {"u": 1.0, "v": 3 + 0.5 * x, "w": x**2}, name="sheared.nc"
    )
    wind = lm.make_truth(experiment(tmp_path, sheared)).wind
    assert float(wind["v"].mean()) == pytest.approx(3, abs=1e-9)
    # of x^2 in 2.5 m, linear between planes: the mean lies 0.5^2 / 6 higher
    assert float(wind["w"].mean()) == pytest.approx(1.25**2 / 3 + STEP**2 / 6, abs=0.002)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wake", "said"),
    [
        ({}, "air of the first, advected by u, v and w"),
        ({"second": "advect"}, "air of the first, advected by v and w"),
        ({"second": "40.1 s", "file": "wake_slab_40s.nc"}, "the state stored at 40.1 s"),
    ],
)
def test_check_says_which_air_the_second_image_shows(tmp_path, wake, said):
    asked = lm.load_experiment("wake_changing", wake={"spacing": "1 m"} | wake)
    rows = [row for _, table in sections(asked, tmp_path) for row in table]
    assert ("second image", said) in rows


def only_in_the_plane(x, y, z):
    return {"v": 1.0, "w": 0.0}


NOT_THERE = [
    (only_in_the_plane, X, {}, "advect_3d is not allowed, as volume.nc has no wind along x (u)"),
    (uniform, X[15:18], {}, "advect_3d is not allowed with 3 planes of volume.nc from x = -0.5 to"),
    # 1.25 m, 0.8 m of wind from behind, 1 m
    (
        uniform,
        X[12:],
        {},
        "planes of volume.nc from x = -2 to 8 m; expected at least 4, from -3.05",
    ),
    (uniform, X[:21], {}, "from x = -8 to 2 m; expected at least 4, from -3.05 m or less to 2.25"),
    (uniform, X, {"x": "30 m"}, "from x = -8 to 8 m; expected at least 4, from 26.95"),
]


@pytest.mark.slow
@pytest.mark.parametrize("depth", ["plane", "volume"])
@pytest.mark.parametrize(("wind", "x", "wake", "message"), NOT_THERE)
def test_a_file_without_the_air_of_the_gates(tmp_path, depth, wind, x, wake, message):
    """By a run as by its check before."""
    asked = experiment(tmp_path, written(tmp_path, blobs, wind, x), depth=depth, **wake)
    with pytest.raises(InputError) as error:
        lm.make_truth(asked)
    assert str(error.value).startswith("wake.second: ") and message in str(error.value)
    with pytest.raises(InputError) as again:
        list(sections(asked, tmp_path))
    assert str(again.value) == str(error.value)


def test_the_plane_of_a_volume_is_to_be_said(tmp_path):
    file = written(tmp_path, blobs, uniform)
    with pytest.raises(InputError, match=r"wake\.x: missing; volume\.nc has 33 planes"):
        lm.make_truth(experiment(tmp_path, file, x=None))
    lm.make_truth(experiment(tmp_path, file, x=None, depth="volume"))


@pytest.mark.slow
def test_gates_that_move_with_the_air_need_less_of_it(tmp_path):
    """At 8 m/s they see no motion along x: 2.25 m on either side are enough."""
    short = written(tmp_path, blobs, uniform, X[10:23])
    with pytest.raises(InputError, match=r"wake\.second: advect_3d"):
        lm.make_truth(experiment(tmp_path, short))
    asked = experiment(tmp_path, short)
    scan = asked.scan.model_copy(update={"follow": 8.0})
    truth = lm.make_truth(asked.model_copy(update={"scan": scan}))
    expected = blobs_displaced_in_the_plane(tmp_path, "plane")
    found = truth.image(1).sel(INNER).values / 1e-3
    assert np.abs(found - expected).max() < 1e-3


@pytest.mark.parametrize(
    ("wake", "message"),
    [
        (
            {"extinction": {"source": "speed"}},
            "second: 'advect_3d' is not allowed with depth: plane and extinction.source: speed",
        ),
        (
            {"file": None, "x": None, "vortex_pair": {}},
            "second: 'advect_3d' is not allowed with vortex_pair; expected advect",
        ),
    ],
)
def test_wakes_that_have_no_volume_of_tracers(tmp_path, wake, message):
    with pytest.raises(InputError) as error:
        experiment(tmp_path, **{"file": "volume.nc"} | wake)
    assert message in str(error.value)
