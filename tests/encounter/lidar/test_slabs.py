"""Gates of successive scans and the air in them. Physics tier.

Detects: a slab that is not the same in both scans, air that is carried the wrong way or by 0.02 m
too far, texture whose neighbouring slabs are independent or too much alike, gates behind the
aircraft.
"""

import numpy as np
import pytest
from scipy import special
from scipy.integrate import solve_ivp

from lidar_mi.encounter.lidar.slabs import air_of, gates_of
from lidar_mi.errors import InputError
from tests.support.encounters import small_encounter
from tests.support.wake_volumes import crow_volume


@pytest.fixture(scope="module")
def oblique():
    experiment = small_encounter(path={"crossing_angle": "20 deg", "climb_angle": "-3 deg"})
    gates = gates_of(experiment)
    return gates, air_of(experiment, gates)


def test_the_last_gate_of_a_scan_is_the_first_of_the_next():
    gates = gates_of(small_encounter())
    assert gates.between == 3 and gates.depth == pytest.approx(2.5)
    for ahead in (0.0, 2.0, -3.0):
        first, second = gates.plan(), gates.plan(ahead)
        place = gates.stride + ahead
        assert place + second.gate_start == pytest.approx(first.gate_stop - 2.5)
        assert second.gate_count == 4
    assert gates.slab(3) == pytest.approx(3 * 7.5 + 150 + 1.25)


def test_beams_go_to_the_nodes_of_the_last_gate():
    """And the same beams cross the first gate at proportionally smaller places."""
    gates = gates_of(small_encounter())
    plan = gates.plan(1.5)
    direction = plan.directions().reshape(len(gates.z), len(gates.y), 3)
    for gate, middle in ((0, 142.5 - 1.5 + 1.25), (-1, 150 - 1.5 + 1.25)):
        y, z = gates.axes(plan, gate)
        met = direction * (middle / direction[..., :1])
        np.testing.assert_allclose(met[..., 1], np.broadcast_to(y[::-1], met.shape[:2]), atol=1e-9)
        np.testing.assert_allclose(met[:, 0, 2], z[::-1], atol=1e-9)
    np.testing.assert_allclose(gates.axes(plan, -1)[0], gates.y, atol=1e-9)


def test_air_is_carried_by_the_wind_from_the_first_sighting(oblique):
    """Trajectories by an integrator of scipy; texture as first seen where they start."""
    gates, air = oblique
    second = air.at_scan(6, (0.0, 0.0))
    middle = gates.look_ahead - gates.stride + gates.depth / 2
    plane = second.sel(x=middle, method="nearest")
    x = 6 * gates.stride + float(plane["x"])
    random = np.random.default_rng(1)
    for _ in range(12):
        y, z = random.choice(gates.y[5:-5]), random.choice(gates.z[5:-5])
        path = solve_ivp(
            lambda t, place: np.array(air.wake.wind(*place, t)),
            (0.6, 0.5),
            [x, y, z],
            rtol=1e-9,
            atol=1e-9,
        )
        expected = air.background * float(air.texture.at(*path.y[:, -1]))
        found = float(plane.sel(y=y, z=z, method="nearest"))
        # a contrast of 0.1 with waves of a few metres: 0.002 of the value are 0.02 m
        assert found == pytest.approx(expected, rel=5e-4)


def test_neighbouring_slabs_are_correlated_as_the_spectrum_says(oblique):
    """Von Karman's correlation; the grid lacks short waves, which adds up to 0.1 at short lags."""
    _, air = oblique
    random = np.random.default_rng(2)
    x, y, z = (random.uniform(0, period, 20_000) for period in air.texture.period)
    here = np.log(air.texture.at(x, y, z))
    for lag in (2.5, 5.0, 7.5, air.texture.period[0]):
        there = np.log(air.texture.at(x + lag, y, z))
        r = 2 * np.pi * lag / 10
        expected = 2 ** (2 / 3) / special.gamma(1 / 3) * r ** (1 / 3) * special.kv(1 / 3, r)
        if lag == air.texture.period[0]:
            expected = 1.0
        assert np.corrcoef(here, there)[0, 1] == pytest.approx(expected, abs=0.1)


def test_air_of_a_scan_depends_on_its_number_and_place_alone(oblique):
    _, air = oblique
    first = air.at_scan(4, (0.5, -0.3))
    air.at_scan(9, (0.0, 0.0))
    assert (air.at_scan(4, (0.5, -0.3)).values == first.values).all()
    moved = air.at_scan(4, (1.5, -0.3))
    np.testing.assert_allclose(moved.values[-4:, :-1], first.values[-4:, 1:], rtol=1e-9)


def test_no_texture():
    experiment = small_encounter(wake={"texture": {"rms": 0}})
    air = air_of(experiment, gates_of(experiment)).at_scan(2, (0.0, 0.0))
    assert float(air.min()) == float(air.max()) == experiment.wake.extinction.background


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scan": {"aim": "angles"}}, "scan.aim: angles is not allowed in an encounter"),
        ({"scan": {"gates": "spherical"}}, "scan.gates: spherical is not allowed"),
        ({"scan": {"timing": {"duration": "90 ms"}}}, "scan.timing: not allowed in an encounter"),
        ({"encounter": {"look_ahead": "6 m"}}, "encounter.look_ahead: 6 m is not allowed"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        gates_of(small_encounter(**changes))


def test_a_pose_in_the_slab_is_refused():
    with pytest.raises(InputError, match=r"pose\.x: 143 m ahead"):
        gates_of(small_encounter()).plan(143.0)


@pytest.fixture(scope="module")
def crow_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("wake") / "crow.nc"
    crow_volume(waves=1, amplitude=3.0).drop_vars("extinction").to_netcdf(path)
    return str(path)


def in_file(path, tracer):
    """The air of an encounter in a file's wake; its plane x = 0 where the path meets it."""
    extinction = {"aerosol": None, "tracer": tracer, "maximum": "1.8/km"}
    wake = {"vortex_pair": None, "file": path, "depth": "volume", "x": "0 m"}
    experiment = small_encounter(wake=wake | {"extinction": extinction})
    gates = gates_of(experiment)
    return gates, air_of(experiment, gates)


def test_air_in_a_volume_is_that_in_the_analytic_wake(crow_file):
    """The same texture, carried by splines of the same wind: 1 % of its contrast (rms)."""
    pair = {"circulation": "300 m^2/s", "separation": "24 m", "width": "70 m", "height": "50 m"}
    analytic = small_encounter(
        wake={"vortex_pair": pair},
        encounter={
            "path": {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"},
            "wake": {"crow": {"amplitude": "3 m"}},
        },
    )
    gates, found = in_file(crow_file, None)
    np.testing.assert_allclose(gates.y, gates_of(analytic).y)
    np.testing.assert_allclose(gates.z, gates_of(analytic).z)
    expected = air_of(analytic, gates).at_scan(3, (0.0, 0.0))
    difference = found.at_scan(3, (0.0, 0.0)) - expected
    assert float(np.sqrt((difference**2).mean())) < 0.01 * float(expected.std())


def test_exhaust_is_carried_by_the_wind_from_the_first_sighting(crow_file):
    """As the texture is: the near slab's exhaust is that of the far slab, one scan ago."""
    gates, air = in_file(crow_file, "tracer")
    second = air.at_scan(3, (0.0, 0.0))
    assert float(second.max()) > 1.5e-3 > 2e-4 > float(second.min())
    plane = second.sel(x=gates.look_ahead - gates.stride + gates.depth / 2, method="nearest")
    x, now, before = 3 * gates.stride + float(plane["x"]), 3 * gates.period, 2 * gates.period
    for y, z in ((12.0, 3.0), (-15.0, 2.0), (8.0, -4.0)):
        path = solve_ivp(
            lambda t, place: np.array(air.wake.wind(*place, t)), (now, before), (x, y, z), rtol=1e-8
        )
        start = path.y[:, -1]
        expected = air.wake.extinction(*start, before) * air.texture.at(*start) + air.molecules
        assert float(plane.sel(y=y, z=z)) == pytest.approx(float(expected), rel=0.02)
