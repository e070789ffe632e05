"""The air of an encounter from its keys. Unit and physics tier.

Detects: a key that does not reach the air, air that loads the wing but does not carry what the
lidars see (or the reverse), design speeds of another altitude, air that is taken silently where it
has no meaning.
"""

import math

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.aircraft.state import loads_in_wind
from lidar_mi.atmosphere.air.along_path import AirAlongPath
from lidar_mi.atmosphere.air.microburst import Microburst
from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.encounter.check import geometry, sections
from lidar_mi.encounter.flight import simulate_flights
from lidar_mi.encounter.lidar.doppler import Midway, doppler_scans
from lidar_mi.encounter.lidar.slabs import air_of, gates_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.run_folder import new_record
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.flight_air import air_along_path, described, moving_air
from lidar_mi.experiment.truth.wake_along_path import vortices_in_plane
from tests.support.air_volumes import sampled
from tests.support.encounters import both_lidars, small_encounter

LEVEL = {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"}


def in_air(path=None, aircraft=None, control=None, **air):
    """The small encounter in air."""
    encounter = {"path": LEVEL | (path or {}), "air": air, "control": control or {"mode": "off"}}
    return small_encounter(encounter=encounter | ({"aircraft": aircraft} if aircraft else {}))


def test_without_air_there_is_the_wake():
    assert isinstance(air_along_path(small_encounter()), PairAlongPath)


def test_keys_reach_the_parts():
    experiment = in_air(
        path={"altitude": "200 m"},
        turbulence={"level": "severe", "shortest": "4 m", "evolution": "sweeping", "seed": 7},
        gusts=[
            {"direction": "down", "gradient": "30 m", "start": "250 m", "speed": "8 m/s"},
            {"gradient": "107 m"},
        ],
        linear_shear={"du_dz": "0.05 / s", "dv_dz": "0.01 / s"},
        logarithmic_shear={"speed": "12 m/s", "towards": "90 deg"},
        microburst={"outflow": "20 m/s", "radius": "500 m", "x": "300 m", "y": "40 m"},
    )
    waves, first, second, linear, layer, burst = moving_air(
        experiment.encounter.air, experiment.encounter.path, experiment.seed
    )
    expected = turbulence(2.315, 200.0, 7, shortest=4.0, evolution="sweeping")
    np.testing.assert_allclose(waves.waves, expected.waves)
    np.testing.assert_allclose(waves.amplitudes, expected.amplitudes, rtol=2e-4)
    assert (first.direction, first.gradient, first.start, first.speed) == ("down", 30, 250, 8)
    # U_ref = 17.07 - (17.07 - 13.41) 200/4572, true airspeed at the density of 200 m, 0.981
    assert second.speed == pytest.approx(16.91 / math.sqrt(0.981), rel=1e-3)
    assert (linear.du_dz, linear.dv_dz, linear.height) == (0.05, 0.01, 200)
    assert (layer.speed, layer.height) == (12, 200) and layer.towards == pytest.approx(math.pi / 2)
    assert burst == Microburst(20.0, 500.0, 60.0, 300.0, 40.0)


def test_check_describes_the_air():
    experiment = in_air(
        path={"altitude": "300 m"},
        turbulence={"level": "severe"},
        gusts=[{"gradient": "50 m", "start": "400 m"}],
        linear_shear={"du_dz": "0.05 / s"},
    )
    found = dict(described(experiment.encounter.air, experiment.encounter.path))
    assert found["turbulence"] == "2.32 m/s rms, length 300 m, von karman, frozen"
    assert found["gust"] == "15 m/s up, 100 m long, from 400 m on"
    assert found["linear shear"].startswith("du_dz 0.05 / s, dv_dz 0.0")
    titles = dict(sections(experiment))
    rows = dict(titles[f"{experiment.name}: flight into the wake"])
    assert rows["gust"] == found["gust"]


def test_alleviation_of_the_design_speed():
    weights = {"maximum_altitude": "12192 m", "landing_weight": 0.85, "zero_fuel_weight": 0.8}
    full, given, computed = (
        in_air(path={"altitude": "1 m"}, gusts=[keys]).encounter
        for keys in ({}, {"alleviation": 0.5}, weights)
    )
    speeds = [moving_air(e.air, e.path, 1)[0].speed for e in (full, given, computed)]
    assert speeds[1] / speeds[0] == pytest.approx(0.5)
    assert speeds[2] / speeds[0] == pytest.approx(0.8171, abs=1e-3)


def test_length_of_cs_25_and_own_values():
    for keys, sigma, length in (
        ({"standard": "cs_25", "sigma": "2 m/s"}, 2.0, 762.0),
        ({"sigma": "3 m/s", "length": "90 m"}, 3.0, 90.0),
    ):
        encounter = in_air(turbulence=keys).encounter
        (found,) = moving_air(encounter.air, encounter.path, 5)
        expected = turbulence(sigma, length, 5)
        np.testing.assert_allclose(found.waves, expected.waves, rtol=1e-9)
        np.testing.assert_allclose(found.amplitudes, expected.amplitudes, rtol=1e-9)


def test_a_gust_in_place_of_the_wake_lifts_the_wing():
    """F_z = q S a w/V with the finite-span slope, at the gust's largest speed."""
    experiment = in_air(wake=False, gusts=[{"gradient": "40 m", "start": "100 m", "speed": 9}])
    air, aircraft = air_along_path(experiment), aircraft_of(experiment.encounter)
    time = np.array([50.0, 140.0, 240.0]) / 75
    loads = loads_in_wind(aircraft.strips, aircraft.state, air.wind, aircraft.density, time)
    slope = 5.3 / (1 + 5.3 / (math.pi * 28.9**2 / 108.8))
    largest = 0.5 * aircraft.density * 75 * 108.8 * slope * 9
    np.testing.assert_allclose(loads.force[:, 2], [0, largest, 0], atol=1e-6 * largest)
    np.testing.assert_allclose(loads.moment[:, 0], 0, atol=1e-6 * largest)
    assert vortices_in_plane(air, 100.0, 1.0) is None
    flights = simulate_flights(experiment, silent)
    found = float(flights.series["force_z"].max())
    assert found == pytest.approx(largest, rel=1e-3)


@pytest.fixture(scope="module")
def air_file(tmp_path_factory):
    """Waves of 20 m and more, x of 50 to 290 m, heights of 270 to 330 m."""
    path = tmp_path_factory.mktemp("air") / "air.nc"
    field = turbulence(1.5, 200.0, 3, shortest=20.0)
    volume = sampled(field, (6.0, 1.0), x=(50.0, 290.0), y=(-40.0, 40.0), z=(270.0, 330.0))
    volume.to_netcdf(path)
    return path, field


SHORT = {"start": "150 m", "beyond": "85 m"}


def test_air_from_a_file(air_file):
    """Its wind on the path, in the frame of its mean; a height is one above the ground."""
    path, field = air_file
    air = air_along_path(in_air(SHORT, wake=False, volume={"file": str(path)}))
    x = np.linspace(10, 220, 50)
    found = np.stack(air.wind(x, 5.0, -4.0, 1.0))
    true = np.stack(field.velocity(x + 50, 5.0, 296.0, 0.0))
    difference = found - true
    assert np.abs(difference - difference.mean(axis=1, keepdims=True)).max() < 0.03
    assert np.abs(difference[2]).max() < 0.03


@pytest.mark.parametrize(
    ("path", "air", "control", "message"),
    [
        (
            {"start": "190 m", "beyond": "300 m"},
            {},
            "off",
            r"air\.nc covers x = 50 to 290 m; the flight needs 50 to 540 m \(a larger volume",
        ),
        (SHORT | {"altitude": "100 m"}, {}, "off", r"covers z = 270 to 330 m; .* 100 to 100 m"),
        (SHORT, {"centre": "35 m"}, "off", r"covers y = -40 to 40 m; .* 20\.55 to 49\.45 m"),
        (SHORT | {"altitude": "315 m"}, {}, "feedforward", r"covers z .* 295 to 335 m"),
        (SHORT, {"names": {"u": "U"}}, "off", r"variable 'U' \(u\) is missing"),
        (SHORT, {"file": "none.nc"}, "off", r"encounter\.air\.volume\.file: none\.nc not found"),
    ],
)
def test_volumes_that_are_refused(air_file, path, air, control, message):
    volume = {"file": str(air_file[0])} | air
    with pytest.raises(InputError, match=message):
        air_along_path(in_air(path, control={"mode": control}, volume=volume))


def test_boxes_and_series(tmp_path, air_file):
    """A Mann box of the same field, and two states of which the second is twice as strong."""
    flow = xr.open_dataset(air_file[0])
    for name in "uvw":
        raw = (flow[name] - flow[name].mean()).astype("<f4").transpose("x", "y", "z")
        (tmp_path / f"box_{name}.bin").write_bytes(raw.values.tobytes())
    nodes = [flow.sizes[name] for name in "xyz"]
    mann = {"nodes": nodes, "spacing": ["2 m"] * 3, "base": "270 m"}
    box = {"file": str(tmp_path / "box_u.bin"), "mann": mann}
    stored = {"file": str(air_file[0])}
    x = np.linspace(10, 220, 50)
    expected, found = (
        np.stack(air_along_path(in_air(SHORT, wake=False, volume=one)).wind(x, 5.0, -4.0, 1.0))
        for one in (stored, box)
    )
    # the mean over the volume is not that at the height
    difference = found - expected
    assert np.abs(difference - difference.mean(axis=1, keepdims=True)).max() < 1e-4
    record = new_record(in_air(SHORT, volume=box), tmp_path)["files"]
    assert sum(key.startswith("encounter.air.volume.file") for key in record) == 3

    states = xr.concat([flow, 2 * flow], "time").assign_coords(
        time=("time", [3.0, 7.0], {"units": "s"})
    )
    for name in "uvw":
        states[name].attrs["units"] = "m s-1"
    states.to_netcdf(tmp_path / "series.nc")
    series = {"file": str(tmp_path / "series.nc"), "time": "3 s", "series": True}
    # the air of the second state has gone on with its mean wind
    air = air_along_path(in_air(SHORT | {"start": "90 m"}, wake=False, volume=series))
    calm = in_air(SHORT, wake=False, volume={"file": str(air_file[0])})
    frozen = air_along_path(calm).wind(x, 5.0, -4.0, 0.0)[2]
    np.testing.assert_allclose(air.wind(x, 5.0, -4.0, 0.0)[2], frozen, atol=1e-4)
    with pytest.raises(InputError, match="goes on for 4 s; the flight takes "):
        air_along_path(in_air({"start": "90 m", "beyond": "300 m"}, wake=False, volume=series))


@pytest.mark.parametrize(
    ("volume", "message"),
    [
        ({"file": "a.bts", "series": True}, "not allowed with a field of TurbSim, which has one"),
        ({"file": "a_u.bin"}, r"volume\.mann: expected with a Mann box"),
        ({"series": True}, "needs a file of several times and `time`, one of them; .* has none"),
    ],
)
def test_boxes_and_series_that_are_refused(tmp_path, air_file, volume, message):
    for name in ("a.bts", "a_u.bin"):
        (tmp_path / name).write_bytes(b"")
    file = tmp_path / volume["file"] if "file" in volume else air_file[0]
    with pytest.raises(InputError, match=message):
        air_along_path(in_air(SHORT, wake=False, volume=volume | {"file": str(file)}))


def test_the_content_of_the_file_belongs_to_the_experiment(air_file, tmp_path):
    copy = tmp_path / "air.nc"
    copy.write_bytes(air_file[0].read_bytes())
    experiment = in_air(SHORT, volume={"file": str(copy)})
    first = new_record(experiment, experiment.folder)["files"]["encounter.air.volume.file"]
    sampled(air_file[1], (5.0, 1.0), x=(50.0, 290.0), z=(270.0, 330.0)).to_netcdf(copy)
    assert new_record(experiment, experiment.folder)["files"] != {
        "encounter.air.volume.file": first
    }


def test_the_moment_of_the_wake_alone_is_recorded():
    """That of the flight in calm air but for its bank, whatever the turbulence."""
    path = {"crossing_angle": "20 deg"}
    rough = simulate_flights(in_air(path, turbulence={"level": "severe"}), silent).series
    calm = simulate_flights(in_air(path, linear_shear={}), silent).series
    assert rough.attrs["met"] == "air"
    true = calm["roll_moment"].sel(flight="off").values
    largest = np.abs(true).max()
    assert np.abs(calm["wake_roll_moment"].values - true).max() < 0.15 * largest
    # the wake drifts by a metre or two until it is met
    assert np.abs(rough["wake_roll_moment"].values).max() == pytest.approx(largest, rel=0.1)
    added = rough["roll_moment"].sel(flight="off") - rough["wake_roll_moment"]
    assert np.abs(added).max() > 0.1 * largest
    without = simulate_flights(in_air(wake=False, linear_shear={}), silent).series
    assert "wake_roll_moment" not in without


def test_the_wake_drifts_with_the_air_about_it():
    """Here in a shear, 2 m/s to the left at the wake's height; a gust does not move all of it."""
    shear = {"dv_dz": "0.04 / s"}
    air = air_along_path(in_air(path={"miss": {"z": "50 m"}}, linear_shear=shear, gusts=[{}]))
    assert isinstance(air, AirAlongPath)
    assert air.drift == pytest.approx((0, 2, 0), abs=1e-9)
    met = 190 / 75
    still = PairAlongPath(300.0, 24.0, x_c=190.0, t_c=met, miss=(0.0, 50.0))
    for time in (met, met + 1.5):
        port, starboard = air.vortices(190.0, time)
        expected = still.vortices(190.0, time)
        assert port.y - expected[0].y == pytest.approx(2 * (time - met), abs=0.02)
        assert port.z == pytest.approx(expected[0].z) and starboard.circulation == -300


@pytest.fixture(scope="module")
def all_air():
    return {
        "turbulence": {"sigma": "2 m/s", "length": "60 m", "shortest": "4 m"},
        "gusts": [{"gradient": "50 m", "start": "150 m", "speed": 8}],
        "linear_shear": {"du_dz": "0.1 / s", "dv_dz": "0.1 / s"},
    }


def test_texture_moves_with_all_of_the_air(all_air):
    """Trajectories by an integrator of scipy; texture as first seen where they start."""
    experiment = in_air(**all_air)
    gates = gates_of(experiment)
    air = air_of(experiment, gates)
    second = air.at_scan(6, (0.0, 0.0))
    middle = gates.look_ahead - gates.stride + gates.depth / 2
    plane = second.sel(x=middle, method="nearest")
    x = 6 * gates.stride + float(plane["x"])
    wind = air_along_path(experiment).wind
    random = np.random.default_rng(1)
    moved = []
    for _ in range(8):
        y, z = random.choice(gates.y[5:-5]), random.choice(gates.z[5:-5])
        path = solve_ivp(
            lambda t, place: np.array(wind(*place, t)), (0.6, 0.5), [x, y, z], rtol=1e-6, atol=1e-6
        )
        expected = air.background * float(air.texture.at(*path.y[:, -1]))
        assert float(plane.sel(y=y, z=z, method="nearest")) == pytest.approx(expected, rel=5e-4)
        own = path.y[:, -1] - [x, y, z] + 0.1 * np.array(air.wake.wake.wind(x, y, z, 0.55))
        moved.append(np.linalg.norm(own))
    # the other air carries it by some decimetres
    assert np.mean(moved) > 0.2


def test_lines_of_sight_see_all_of_the_air(all_air):
    experiment = both_lidars(
        encounter={"path": {"start": "190 m"}, "air": all_air | {"turbulence": None, "wake": False}}
    )
    scans = doppler_scans(experiment, gates_of(experiment))
    midway = Midway(np.array([10.0, 2.0, -3.0]), np.array([75.0, 0.0, 0.0]))
    air = air_along_path(experiment)
    found = scans.frames(air, 3, 160.0, 1.5, midway).lines["v_los_true"].values
    going = scans.experiment.sensor.directions.directions()
    place = midway.place + 150.0 / going[:, :1] * going
    wind = np.stack(air.wind(*place.T, 1.5), -1)
    np.testing.assert_allclose(found, ((midway.velocity - wind) * going).sum(1), atol=0.02)
    # in calm air all would be the aircraft's
    assert np.abs((wind * going).sum(1)).max() > 0.5


def test_warnings_name_the_air():
    calm = in_air(wake=False, linear_shear={"du_dz": "0.01 / s"})
    expected = "encounter.air: no rolling moment: its largest on the path is 0.0% of the ailerons'"
    assert [expected in text for text in geometry(calm) if "encounter." in text][-1]
    seeing = in_air(wake=False, turbulence={}, control={"mode": "feedforward"})
    assert any(text.startswith("encounter.air.wake: false leaves") for text in geometry(seeing))
    assert not any("misses the wake" in text for text in geometry(calm) + geometry(seeing))
    # a gust lifts an aircraft that rises
    lifting = in_air(wake=False, gusts=[{}], aircraft={"model": "heave"})
    assert not any("rolling moment" in text for text in geometry(lifting))


@pytest.mark.parametrize(
    ("air", "message"),
    [
        ({"turbulence": {"sigma": "90 m/s"}}, r"encounter\.air\.turbulence\.sigma: .*0 to 30"),
        ({"turbulence": {"length": "5 cm"}}, r"encounter\.air\.turbulence\.length: .*1 to 10000"),
        ({"turbulence": {"standard": "cs_25"}}, r"turbulence.*sigma: missing; CS 25\.341"),
        (
            {"turbulence": {"length": "15 m"}},
            r"shortest: 2 m is not allowed; expected at most a tenth of the length, 1\.5 m",
        ),
        ({"gusts": [{"gradient": "5 m"}]}, r"gradient: 5 m is not allowed without a speed"),
        ({"gusts": [{"speed": 3, "alleviation": 0.5}]}, r"alleviation: has no effect beside speed"),
        ({"gusts": [{"direction": "north"}]}, r"gusts.*direction"),
        ({"logarithmic_shear": {"roughness": "7 m"}}, r"roughness: 7 m is not allowed"),
        ({"microburst": {"radius": "1 m"}}, r"microburst\.radius: .*10 to 10000"),
        ({"storm": {}}, r"encounter\.air\.storm"),
    ],
)
def test_what_is_refused(air, message):
    with pytest.raises(InputError, match=message):
        in_air(**air)


def test_waves_too_long_for_the_height():
    experiment = in_air(path={"altitude": "15 m"}, turbulence={})
    with pytest.raises(InputError, match=r"turbulence\.shortest: 2 m .* length of 15 m at 15 m"):
        air_along_path(experiment)
