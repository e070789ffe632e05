"""The wake of an encounter from its keys. Unit and physics tier.

Detects: a key that does not reach the wake, an unsuitable wake that is accepted, a volume that is
met elsewhere, turned or with other loads than the analytic wake that it was sampled from.
"""

import math

import pytest

import lidar_mi as lm
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.encounter.check import geometry
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.wake_along_path import (
    described_wake,
    vortices_in_plane,
    wake_along_path,
)
from tests.support.encounters import small_encounter
from tests.support.wake_volumes import SEPARATION, crow_volume


def test_the_keys_reach_the_wake():
    experiment = small_encounter(
        path={
            "speed": "80 m/s",
            "start": "400 m",
            "crossing_angle": "20 deg",
            "climb_angle": "-2 deg",
            "miss": {"y": "3 m", "z": "-4 m"},
        }
    )
    wake = wake_along_path(experiment)
    port, starboard = wake.vortices(400.0, 5.0)
    assert (port.y + starboard.y) / 2 == pytest.approx(3.0)
    assert (port.z + starboard.z) / 2 == pytest.approx(-4.0)
    assert port.circulation == -starboard.circulation == 300
    assert math.hypot(port.y - starboard.y, 0) == pytest.approx(24 / math.cos(0.349), rel=2e-3)


def test_decay_and_deformation_reach_the_wake():
    experiment = small_encounter(
        encounter={
            "path": {"start": "300 m"},
            "wake": {"decay_time": "10 s", "crow": {"amplitude": "2 m", "wavelength": "200 m"}},
        }
    )
    wake = wake_along_path(experiment)
    assert wake.vortices(300.0, 10.0)[0].circulation == pytest.approx(300 / math.e)
    assert wake.crow_amplitude == 2 and wake.crow_wavelength == 200


def from_file(file, path=None, ends=None, **wake):
    """The small encounter in the wake of a file."""
    encounter = {"path": {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"}}
    return small_encounter(
        wake={
            "vortex_pair": None,
            "file": str(file),
            "depth": "volume",
            "extinction": {"aerosol": None},
            "texture": {"rms": 0},
        }
        | wake,
        encounter={"path": encounter["path"] | (path or {}), "wake": ends or {}},
    )


@pytest.fixture(scope="module")
def crow_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("wake") / "crow.nc"
    crow_volume(waves=1, amplitude=3.0).drop_vars("extinction").to_netcdf(path)
    return path


def test_a_volume_is_repeated_and_its_vortices_are_found(crow_file):
    """Against the analytic pair: places to 0.1 m, circulation to 2 %, descent to 3 %."""
    wake = wake_along_path(from_file(crow_file))
    pair = PairAlongPath(300.0, SEPARATION, crow_amplitude=3.0, x_c=190.0, t_c=190 / 75)
    # the middle of the file's planes is where the path meets the wake
    shift = float(wake.flow["x"].mean())
    for x in (60.0, 190.0, 300.0, 700.0):
        expected = pair.vortices(x + shift, pair.t_c)
        for found, true in zip(wake.vortices(x, pair.t_c), expected, strict=True):
            assert (found.y, found.z) == pytest.approx((true.y, true.z), abs=0.1)
            assert found.circulation == pytest.approx(true.circulation, rel=0.02)
            assert found.core_radius == pytest.approx(true.core_radius, abs=0.5)
    descent = float(pair.centre_at(pair.t_c + 1)[2])
    assert wake.drift == pytest.approx((0.0, descent), abs=0.03 * abs(descent))


def test_the_shipped_plane_can_be_flown():
    """The simulated pair of 458 m^2/s descends by 458 / (2 pi 47.1) = 1.55 m/s."""
    wake = wake_along_path(lm.load_experiment("wake_sensor", encounter={}))
    assert wake.drift[1] == pytest.approx(-1.55, abs=0.05)
    port, starboard = wake.vortices(600.0, 8.0)
    assert port.circulation == pytest.approx(440, abs=20)
    assert (port.y + starboard.y) / 2 == pytest.approx(0.0, abs=1e-6)


def test_what_is_not_known_along_the_axis_is_refused(crow_file, tmp_path):
    with pytest.raises(InputError, match=r"wake: turbine is not allowed in an encounter"):
        wake_along_path(small_encounter(wake={"vortex_pair": None, "turbine": {}}))
    with pytest.raises(InputError, match="encounter: missing in wake_sensor"):
        wake_along_path(lm.load_experiment("wake_sensor"))
    with pytest.raises(InputError, match=r"wake\.x: missing"):
        wake_along_path(from_file(crow_file, depth="plane"))
    for second, shown in (("advect_3d", "advect_3d"), ("41 s", "41 s")):
        with pytest.raises(InputError, match=rf"wake\.second: {shown} is not allowed in an enc"):
            wake_along_path(from_file(crow_file, second=second))
    part = tmp_path / "part.nc"
    crow_volume(waves=1, amplitude=3.0).isel(x=slice(0, 20)).to_netcdf(part)
    with pytest.raises(InputError, match="not periodic along x"):
        wake_along_path(from_file(part, ends={"ends": "refuse"}))
    calm = tmp_path / "calm.nc"
    flow = crow_volume(waves=1, amplitude=0.0).isel(x=slice(0, 8))
    flow.assign({n: flow[n].copy(data=0.01 * flow[n].values) for n in "uvw"}).to_netcdf(calm)
    with pytest.raises(InputError, match="has 0 vortices in the plane"):
        wake_along_path(from_file(calm))


def test_a_part_of_a_wave_is_closed_and_described(tmp_path):
    """The vortices of both vortices' planes are the file's, then those of its mirror image."""
    part = tmp_path / "part.nc"
    crow_volume(waves=1, amplitude=3.0).isel(x=slice(0, 20)).to_netcdf(part)
    step = 8.6 * SEPARATION / 52
    mirrored = from_file(part, x=f"{9.5 * step} m")
    wake = wake_along_path(mirrored)
    assert wake.period == pytest.approx(38 * step)
    pair = PairAlongPath(300.0, SEPARATION, crow_amplitude=3.0)
    for plane, image in ((4, 34), (15, 23)):
        truth = pair.vortices(plane * step, 0.0)[0]
        for place in (plane, image):
            x = 190.0 + (place - 9.5) * step
            found, _ = wake.vortices(x, 190 / 75)
            assert found.y == pytest.approx(truth.y, abs=0.15)
    rows = dict(described_wake(mirrored))
    assert rows["wake along its axis"].startswith("mirror: a period of 150.8 m")
    assert "circulation as in the file" in rows["ends of the volume"]
    blended = dict(described_wake(from_file(part, ends={"ends": "blend", "ends_length": "12 m"})))
    assert blended["wake along its axis"].startswith("blend: a period of 67.48 m")
    assert "% off that elsewhere" in blended["ends of the volume"]


def test_decay_of_a_file_is_refused(crow_file):
    experiment = from_file(crow_file)
    decaying = experiment.encounter.wake.model_copy(update={"decay_time": 10.0})
    encounter = experiment.encounter.model_copy(update={"wake": decaying})
    changed = experiment.model_copy(update={"encounter": encounter}).read_from(experiment.folder)
    with pytest.raises(InputError, match=r"encounter\.wake\.decay_time: 10 is not allowed"):
        wake_along_path(changed)


def test_a_wake_at_right_angles_has_no_vortices_in_the_plane():
    """The check and the truth of the track go on without them."""
    experiment = small_encounter(path={"crossing_angle": "90 deg"})
    wake = wake_along_path(experiment)
    assert vortices_in_plane(wake, 190.0, 2.0) is None
    assert any("both vortices in 0 slabs" in text for text in geometry(experiment))
    oblique = wake_along_path(small_encounter(path={"crossing_angle": "80 deg"}))
    assert vortices_in_plane(oblique, 190.0, 2.0) == oblique.vortices(190.0, 2.0)
