"""An aircraft of JSBSim: force over mass, moment over inertia, the derivatives of its file.

Detects 1 % in the wake's force and moment, a wrong sense of any axis or control, a trim that is
none, an upset that ends in an exception, an aircraft that does not load or is no
aeroplane and is not refused in one line, a speed named by a refusal at which the aircraft does not
trim.
"""

import math
import re
import shutil
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest

from lidar_mi import load_experiment
from lidar_mi.aircraft.control import feedforward, wings_level
from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import Commands, loads_in_wind
from lidar_mi.aircraft.strips import Loads
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.encounter.check import sections
from lidar_mi.errors import InputError
from lidar_mi.schema.encounter import Aircraft, Path

pytest.importorskip("jsbsim")

NOTHING = Loads(np.zeros(3), np.zeros(3))
# of JSBSim's file 737.xml, in m^2 and m
AREA, SPAN, CHORD = 1171 * 0.3048**2, 94.7 * 0.3048, 12.31 * 0.3048
PRESSURE = 0.5 * 1.190 * 75**2  # standard atmosphere at 300 m


def boeing(speed=75.0, **path):
    return JSBSimAircraft(Aircraft(model="737"), Path(speed=speed, **path))


def state_after(aircraft, duration, loads=NOTHING, commands=Commands(), step=1 / 120):  # noqa: B008
    for _ in range(round(duration / step)):
        aircraft.step(step, loads, commands)
    return aircraft.state


def test_trimmed_on_the_path():
    state = state_after(boeing(), 5.0)
    assert state.x == pytest.approx(375, abs=0.2) and state.time == pytest.approx(5)
    assert abs(state.y) < 0.01 and abs(state.z) < 0.3 and abs(state.roll) < 1e-3
    assert not state.departed


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_force_accelerates_the_mass(axis):
    """m times 1 m/s^2 moves by t^2 / 2: the drag of the motion changes it by 2 % in 0.1 s."""
    free, pushed = boeing(climb_angle=0.0), boeing(climb_angle=0.0)
    force = np.zeros(3)
    force[axis] = pushed.mass
    before, after = state_after(free, 0.1), state_after(pushed, 0.1, Loads(force, np.zeros(3)))
    moved = np.array([after.x - before.x, after.y - before.y, after.z - before.z])
    angle = before.pitch  # the body's axes on the path
    turn = [
        [math.cos(angle), 0, -math.sin(angle)],
        [0, 1, 0],
        [math.sin(angle), 0, math.cos(angle)],
    ]
    # 12 steps of Adams-Bashforth: 0.1^2 / 2 up to one step in 12
    np.testing.assert_allclose(
        np.transpose(turn) @ moved / (force[axis] / pushed.mass),
        0.005 * np.eye(3)[axis],
        atol=0.005 * 0.12,
    )


def test_initial_roll_acceleration_is_moment_over_inertia():
    """Between the third and the fourth step: the integrator has started, damping has not."""
    aircraft = boeing()
    loads = Loads(np.zeros(3), np.array([2e5, 0, 0]))
    before = state_after(aircraft, 3 / 120, loads).roll_rate
    after = state_after(aircraft, 1 / 120, loads).roll_rate
    damped = math.exp(-2.5 / 120 * -aircraft.roll_damping / aircraft.roll_inertia)
    assert (after - before) * 120 == pytest.approx(2e5 / aircraft.roll_inertia * damped, rel=0.01)


def test_roll_mode_of_the_published_damping():
    """C_lp = -0.4 and the inertia of the file: the time constant of the roll rate."""
    aircraft = boeing()
    damping = -0.4 * PRESSURE * AREA * SPAN**2 / (2 * 75)
    assert aircraft.roll_damping == pytest.approx(damping, rel=0.02)
    tau = -aircraft.roll_inertia / damping
    state = state_after(aircraft, 0.5, Loads(np.zeros(3), np.array([1e5, 0, 0])))
    expected = 1e5 / -damping * -np.expm1(-0.5 / tau)
    assert state.roll_rate == pytest.approx(expected, rel=0.04)


def test_roll_model_and_jsbsim_roll_alike():
    """Default keys against JSBSim's 737: -a/8 is -0.46, JSBSim's C_lp -0.4."""
    loads = Loads(np.zeros(3), np.array([2e5, 0, 0]))
    simple = state_after(RollModel(Aircraft(), Path()), 1.0, loads)
    full = state_after(boeing(), 1.0, loads)
    assert simple.roll == pytest.approx(full.roll, rel=0.1)


def test_control_moments_are_the_derivatives_of_the_file():
    moments, mach = boeing().control_moments, 75 / 339.1
    lift = PRESSURE * AREA
    roll = lift * SPAN * (0.1 - 0.067 * mach / 2)
    # the elevator's lift acts 0.36 m behind the centre of gravity
    pitch = lift * (CHORD * (1.2 - 0.9 * mach / 2) + 0.2 * 0.36)
    yaw = lift * SPAN * 0.2
    np.testing.assert_allclose(np.diag(moments), [roll, pitch, yaw], rtol=0.02)
    assert abs(moments[0, 1]) < 1e-3 * roll and abs(moments[2, 0]) < 1e-3 * yaw


@pytest.mark.parametrize(
    ("axis", "angle", "sign"), [(0, "roll", 1), (1, "pitch", -1), (2, "yaw", 1)]
)
def test_moments_and_controls_turn_the_same_way(axis, angle, sign):
    """Port wing up, nose down, nose to port."""
    moment = np.zeros(3)
    moment[axis] = 3e5
    names = ("aileron", "elevator", "rudder")
    still = state_after(boeing(), 0.3)
    turned = state_after(boeing(), 0.3, Loads(np.zeros(3), moment))
    steered = state_after(boeing(), 0.3, commands=Commands(**{names[axis]: 0.1}))
    for state in (turned, steered):
        assert sign * (getattr(state, angle) - getattr(still, angle)) > 1e-3
        assert sign * getattr(state, f"{angle}_rate") > 0


def test_strips_have_the_aircrafts_surfaces():
    strips = boeing().strips
    assert strips.areas.sum() == pytest.approx((1171 + 348 + 297) * 0.3048**2)
    assert strips.places[:, 1].max() == pytest.approx(SPAN / 2, rel=0.01)
    assert strips.places[:, 0].min() == pytest.approx(-48.04 * 0.3048)


def test_controls_keep_their_limits():
    aircraft = boeing()
    for _ in range(120):
        aircraft.step(1 / 120, NOTHING, Commands(aileron=2.0, elevator=-2.0))
        assert (np.abs(aircraft.deflection) <= aircraft.limits.deflection + 1e-12).all()
    assert aircraft.deflection[0] == pytest.approx(0.35, abs=1e-5)


def test_an_upset_is_a_result():
    aircraft = boeing()
    state = state_after(aircraft, 4.0, Loads(np.zeros(3), np.array([5e6, 0, 0])), step=0.05)
    assert state.departed and state.time == pytest.approx(4)
    assert boeing().step(0.1, Loads(np.full(3, np.nan), np.zeros(3)), Commands()).departed


def test_unknown_aircraft_names_those_that_there_are():
    with pytest.raises(InputError, match=r"'nope' is not known.*737"):
        JSBSimAircraft(Aircraft(model="nope"), Path())


def test_a_speed_at_which_it_does_not_fly():
    with pytest.raises(InputError, match="737 does not trim at 20 m/s"):
        boeing(speed=20.0)


BROKEN = "fokker100", "fokker50", "f104", "dr1", "L17", "Pterosaur", "blank"


def flies(name, **path):
    """Whether an aircraft is ready to fly; refused in one line if not."""
    try:
        JSBSimAircraft(Aircraft(model=name), Path(**path))
    except InputError as error:
        assert re.search(r"such as (737|787-8)$", str(error)), error
        assert f"{name}" in str(error)
        return False
    return True


@pytest.mark.parametrize("name", BROKEN)
def test_aircraft_that_need_flightgear(name, capfd):
    """Properties of FlightGear that JSBSim alone does not have, a file without an aircraft."""
    assert not flies(name)
    assert capfd.readouterr() == ("", "")


def test_jsbsim_writes_nothing_itself(capfd):
    """Camel's file has a product of one factor, which JSBSim remarks on."""
    flies("Camel", speed=40.0, climb_angle=0.0)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "lacks"),
    [
        ("ball", "no lift that rises with the angle of attack, no ailerons .*, no engine"),
        ("mk82", "no ailerons that roll it at 75 m/s, no engine"),
        ("J246", "no ailerons that roll it at 75 m/s"),
        ("ah1s", "no ailerons that roll it at 75 m/s"),
        ("f22", "no ailerons that roll it at 75 m/s"),
        ("F450", "no lift that rises .*, no ailerons .*"),
        ("SGS", "no engine"),
        ("ZLT-NT", r"no ailerons .*, gas cells with a buoyancy of 8\d% of its weight"),
        ("Submarine_Scout", r"gas cells with a buoyancy of 9\d% of its weight"),
    ],
)
def test_no_aeroplane(name, lacks, capfd):
    """Ball, bomb, rocket, helicopter, fighter whose ailerons stay at rest, quadrocopter, glider,
    two airships.
    """
    expected = (
        rf"encounter\.aircraft\.model: '{name}' is not allowed: it has {lacks}; "
        r"expected an aeroplane with an engine, such as 737"
    )
    with pytest.raises(InputError) as refused:
        JSBSimAircraft(Aircraft(model=name), Path())
    assert re.fullmatch(expected, str(refused.value))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("model", "message"),
    [("mk82", "aircraft.model: 'mk82' is not allowed"), ("A320", "path.speed: A320 does not trim")],
)
def test_the_check_of_a_flight_refuses_it(model, message):
    experiment = load_experiment("encounter", encounter={"aircraft": {"model": model}})
    with pytest.raises(InputError, match=rf"^encounter\.{message}"):
        next(sections(experiment))


@pytest.mark.parametrize("size", ["wingarea", "wingspan"])
def test_an_aircraft_without_a_wing(size, tmp_path, monkeypatch):
    import jsbsim

    root = FilePath(jsbsim.__file__).parent
    shutil.copytree(root / "aircraft" / "737", tmp_path / "aircraft" / "737")
    for folder in ("engine", "systems"):
        (tmp_path / folder).symlink_to(root / folder)
    file = tmp_path / "aircraft" / "737" / "737.xml"
    text, count = re.subn(rf"(<{size}.*?>)[^<]*", r"\g<1> 0 ", file.read_text())
    file.write_text(text)
    monkeypatch.setattr(jsbsim, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(InputError, match=r"'737' is not allowed: it has no wing.*such as 787-8"):
        boeing()
    assert count == 1


def test_the_speed_of_a_refusal_trims():
    """A320 has no equilibrium at 75 m/s and 300 m; lift is weight at the speed of the message."""
    with pytest.raises(InputError) as refused:
        JSBSimAircraft(Aircraft(model="A320"), Path())
    speed = re.fullmatch(
        r"encounter\.path\.speed: A320 does not trim at 75 m/s and -3 deg at 300 m; "
        r"expected another speed, such as (\d+) m/s",
        str(refused.value),
    )[1]
    aircraft = JSBSimAircraft(Aircraft(model="A320"), Path(speed=float(speed)))
    after = state_after(aircraft, 2.0)
    assert abs(after.z) < 0.3 and after.x == pytest.approx(2 * float(speed), rel=2e-3)


def test_a_path_on_which_no_speed_trims():
    expected = (
        "encounter.path.speed: 737 does not trim at 75 m/s and 20 deg at 300 m; expected another "
        r"climb_angle or altitude, or another aircraft, such as 787-8 \(it trims at none of the 6 "
        r"speeds tried from \d+ to \d+ m/s, at which its wing can carry it\)"
    )
    with pytest.raises(InputError) as refused:
        boeing(climb_angle="20 deg")
    assert re.fullmatch(expected, str(refused.value)) and len(str(refused.value)) <= 300


def test_without_jsbsim(monkeypatch):
    monkeypatch.setitem(sys.modules, "jsbsim", None)
    with pytest.raises(InputError, match="needs JSBSim, which is not installed"):
        boeing()


def test_steered_through_a_core():
    """A pair of 350 m^2/s, its port core crossed under 10 degrees, with the true wind known."""
    pair, step = vortex_pair(350.0, 47.0, 3.0), 1 / 30

    def wind(x, y, z, time):
        v, w = velocity(pair, y - (x - 250) * math.tan(math.radians(10)) + 23.5, z)
        return 0 * v, v, w

    def largest_roll(controller_of):
        aircraft = boeing()
        controller, rolls = controller_of(aircraft), []
        for _ in range(180):
            state = aircraft.state

            def preview(time, state=state):
                return loads_in_wind(aircraft.strips, state, wind, aircraft.density, time)

            aircraft.step(step, preview(state.time), controller(preview, state))
            rolls.append(abs(aircraft.state.roll))
        assert not aircraft.state.departed
        return max(rolls)

    off = largest_roll(lambda one: wings_level(one, 3.0))
    steered = largest_roll(lambda one: feedforward(one))
    assert off > math.radians(20) and steered < 0.4 * off
