"""Aircraft of JSBSim at the start of a path: loaded, known to be aeroplanes, trimmed."""

import math
import tempfile
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path as FilePath
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.constants import foot

from lidar_mi.errors import InputError
from lidar_mi.io.jsbsim_files import shipped_aircraft, write_aircraft_in_wake
from lidar_mi.schema.encounter import Path

if TYPE_CHECKING:
    from jsbsim import FGFDMExec, FGLogger

STEP = 1 / 120
"""Largest step of JSBSim, s."""

FLAPS = (0.0, 0.25, 0.5, 0.75, 1.0)
LARGEST_INCIDENCE = math.radians(6)
"""The least flaps are set with which the aircraft trims at this angle of attack or a smaller one;
with flaps the gear is down."""

_LARGE = ("737", "787-8", "B747", "MD11")  # named in place of one that does not work
_RAISED = math.radians(4)  # at which lift is linear in the angle of attack
_HIGHEST = math.radians(11)  # angle of attack of flight without flaps; near most stalls
_SPEEDS = 10.0, 350.0  # allowed for encounter.path.speed, m/s
_TRIALS = 6  # speeds tried for a message
_NOTHING = 1e-6  # of a coefficient of lift or moment: rounding


def such_as(name: str) -> str:
    """Words that name another large aircraft."""
    return f"such as {next(other for other in _LARGE if other != name)}"


def check_aeroplane(name: str, path: Path) -> None:
    """Refuse aircraft without wings, ailerons or an engine.

    JSBSim computes its aerodynamic forces at the speed and altitude of the path, at angles of
    attack of 0 and 4 degrees, and at the latter with the ailerons deflected.

    Raises
    ------
    InputError
        It has no wing area or span, its lift does not rise with the angle of attack, its ailerons
        give no aerodynamic rolling moment, it has no engine, or gas cells carry it. Or there is no
        JSBSim, or it has no such aircraft.
    RuntimeError
        From JSBSim, of an aircraft that it cannot load.
    """
    level, raised = _in_flow(name, path, 0.0), _in_flow(name, path, _RAISED)
    rolled = _in_flow(name, path, _RAISED, aileron=0.5)
    area, span = raised["metrics/Sw-sqft"], raised["metrics/bw-ft"]
    force = raised["aero/qbar-psf"] * area
    lacks = []
    if not force * span > 0:
        lacks.append("no wing")
    elif not (_lift(raised) - _lift(level)) / force > _NOTHING:
        lacks.append("no lift that rises with the angle of attack")
    moment = rolled["moments/l-aero-lbsft"] - raised["moments/l-aero-lbsft"]
    if not abs(moment) > _NOTHING * force * span:
        lacks.append(f"no ailerons that roll it at {path.speed:g} m/s")
    if raised.get_propulsion().get_num_engines() == 0:
        lacks.append("no engine")
    carried = _buoyancy(raised) / raised["inertia/weight-lbs"]
    if carried > 0:
        lacks.append(f"gas cells with a buoyancy of {carried:.0%} of its weight")
    if lacks:
        raise InputError(
            f"encounter.aircraft.model: {name!r} is not allowed: it has {', '.join(lacks)}; "
            f"expected an aeroplane with an engine, {such_as(name)}"
        )


def trimmed(name: str, path: Path, flap_settings: Sequence[float]) -> "FGFDMExec":
    """JSBSim on the path, in equilibrium.

    name: of an aircraft of JSBSim.
    flap_settings: 0 to 1, in the order in which they are tried; see `LARGEST_INCIDENCE`.

    Raises
    ------
    InputError
        No equilibrium, no JSBSim, or no such aircraft.
    RuntimeError
        From JSBSim, of an aircraft that it cannot load or start.
    """
    fdm = _trimmed(name, path, flap_settings)
    if fdm is None:
        raise InputError(
            f"encounter.path.speed: {name} does not trim at {path.speed:g} m/s and "
            f"{math.degrees(path.climb_angle):.3g} deg at {path.altitude:g} m; "
            f"expected {_where_it_trims(name, path)}"
        )
    return fdm


def _trimmed(name: str, path: Path, flap_settings: Sequence[float]) -> "FGFDMExec | None":
    best = None
    for flaps in flap_settings:
        fdm = _at_the_start(name, path)
        fdm["ic/gamma-rad"] = path.climb_angle
        for part, value in (("gear/gear", float(flaps > 0)), ("fcs/flap", flaps)):
            fdm[f"{part}-cmd-norm"] = value
            fdm[f"{part}-pos-norm"] = value
        # all engines
        fdm["propulsion/set-running"] = -1
        if not fdm.run_ic():
            continue
        try:
            fdm["simulation/do_simple_trim"] = 1
        except RuntimeError as error:
            # no equilibrium with these flaps: with more there may be one
            if type(error).__name__ != "TrimFailureError":
                raise
            continue
        best = fdm
        if fdm["aero/alpha-rad"] <= LARGEST_INCIDENCE:
            break
    return best


def _where_it_trims(name: str, path: Path) -> str:
    """Advice: a speed at which it trims, or else another path or aircraft."""
    level, raised = (_lift(_in_flow(name, path, incidence)) for incidence in (0.0, _RAISED))
    weight = _in_flow(name, path, 0.0)["inertia/weight-lbs"]
    highest = level + (raised - level) * _HIGHEST / _RAISED
    # lift grows with the square of the speed
    slow, fast = sorted(
        np.clip(path.speed * math.sqrt(weight / lift) if lift > 0 else np.inf, *_SPEEDS)
        for lift in (level, highest)
    )
    speeds = np.unique(np.geomspace(slow, fast, _TRIALS).round())
    for speed in sorted(speeds, key=lambda v: abs(v - path.speed)):
        if _trimmed(name, path.model_copy(update={"speed": float(speed)}), FLAPS[:1]) is not None:
            return f"another speed, such as {speed:g} m/s"
    return (
        "another climb_angle or altitude, or another aircraft, "
        f"{such_as(name)} (it trims at none of the {len(speeds)} speeds tried from {slow:.0f} to "
        f"{fast:.0f} m/s, at which its wing can carry it)"
    )


def _in_flow(name: str, path: Path, incidence: float, aileron: float = 0.0) -> "FGFDMExec":
    """JSBSim at an angle of attack (rad), with a command of the ailerons, in no equilibrium."""
    fdm = _at_the_start(name, path)
    fdm["ic/alpha-rad"] = incidence
    fdm["fcs/aileron-cmd-norm"] = aileron
    if not fdm.run_ic():
        raise RuntimeError("it does not start")
    return fdm


def _lift(fdm: "FGFDMExec") -> float:
    """Aerodynamic lift, lbf."""
    return fdm["forces/fwz-aero-lbs"]


def _buoyancy(fdm: "FGFDMExec") -> float:
    """Upward force of gas cells on the level aircraft, lbf."""
    name = "forces/fbz-buoyancy-lbs"  # which aircraft without gas cells do not have; z is down
    return -fdm[name] if fdm.get_property_manager().hasNode(name) else 0.0


def _at_the_start(name: str, path: Path) -> "FGFDMExec":
    fdm = loaded(name)
    fdm["ic/h-sl-ft"] = path.altitude / foot
    fdm["ic/vt-fps"] = path.speed / foot
    return fdm


def loaded(name: str) -> "FGFDMExec":
    """JSBSim with an aircraft on which forces and moments can act, before initial conditions.

    Raises
    ------
    InputError
        There is no JSBSim, or it has no such aircraft.
    RuntimeError
        From JSBSim, of an aircraft that it cannot load.
    """
    try:
        import jsbsim
    except ImportError:
        raise InputError(
            f"encounter.aircraft.model: {name!r} needs JSBSim, which is not installed "
            "(pip install 'lidar-mi[flight]'); roll needs nothing"
        ) from None
    root = FilePath(jsbsim.__file__).parent
    names = shipped_aircraft(root)
    if name not in names:
        similar = get_close_matches(name, names, n=4, cutoff=0.5)
        raise InputError(
            f"encounter.aircraft.model: {name!r} is not known; expected roll or one of the "
            f"{len(names)} aircraft of JSBSim, such as {', '.join(similar or _LARGE)}"
        )
    jsbsim.set_logger(_silent_logger(jsbsim))
    fdm = jsbsim.FGFDMExec(str(root))
    fdm.set_debug_level(0)
    # JSBSim has read the files when the model is loaded: the folder can go
    with tempfile.TemporaryDirectory() as folder:
        write_aircraft_in_wake(root, name, FilePath(folder))
        fdm.set_aircraft_path(folder)
        fdm.set_engine_path(str(root / "engine"))
        fdm.set_systems_path(str(root / "systems"))
        if not fdm.load_model(name):
            raise RuntimeError("it does not load")
    fdm.set_dt(STEP)
    return fdm


@cache
def _silent_logger(jsbsim: ModuleType) -> "FGLogger":
    """Logger that writes nothing: JSBSim also raises what it writes to the terminal."""

    def ignore(self: object, *arguments: Any) -> None:
        pass

    names = ("set_level", "file_location", "message", "format", "flush")
    return type("Silent", (jsbsim.FGLogger,), dict.fromkeys(names, ignore))()
