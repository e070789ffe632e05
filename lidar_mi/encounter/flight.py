"""Flights through the wake of an experiment: without control, with the lidar, with perfect preview.

All of them meet the same wake. Only the flight that steers by the lidar needs its images: what the
others do is known without it. Between no help and a preview there is an autopilot: the controller
of the flights with a preview, told that there is no wake. What it leaves is what a preview is for.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.encounter import CONTROLLER, flight_name
from lidar_mi.atmosphere.wake_path import WakeAlongPath
from lidar_mi.encounter.aircraft import AircraftModel, AircraftState, deflected, loads_in_wind
from lidar_mi.encounter.control import Controller, Preview, feedforward, no_loads, wings_level
from lidar_mi.encounter.own_controller import name_of, own_controller
from lidar_mi.encounter.preview import Lidar, Lookout, preview_of
from lidar_mi.encounter.roll_model import RollModel
from lidar_mi.encounter.scan_store import ScanStore
from lidar_mi.encounter.seen import Seen
from lidar_mi.encounter.series import Recorder, flights_dataset, track_dataset
from lidar_mi.encounter.wake import encounter_of, wake_along_path
from lidar_mi.experiment.schema.encounter import Encounter
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.progress import Notice

OFF, AUTOPILOT, FEEDFORWARD, PERFECT = "off", "autopilot", "feedforward", "perfect"
FLOWN = {
    OFF: (OFF,),
    PERFECT: (OFF, AUTOPILOT, PERFECT),
    FEEDFORWARD: (OFF, AUTOPILOT, PERFECT, FEEDFORWARD),
}
"""Flights of each mode of control: what it is compared with is flown, too."""

# Longest step of a flight, s: below the time in which the wing crosses a core.
_STEP = 0.01

OwnAircraft = Callable[[], AircraftModel]
OwnController = Callable[[AircraftModel], Controller]


@dataclass(frozen=True, eq=False)
class Flown:
    """What flights leave.

    Attributes
    ----------
    series : xr.Dataset, dims (flight, time)
    track : xr.Dataset or None
        Slab by slab; None without a lidar.
    seen : xr.Dataset or None
        Images and vectors of the slabs.
    """

    series: xr.Dataset
    track: xr.Dataset | None
    seen: xr.Dataset | None


def aircraft_of(encounter: Encounter) -> AircraftModel:
    """The aircraft of an encounter at its start."""
    if encounter.aircraft.model == "roll":
        return RollModel(encounter.aircraft, encounter.path)
    from lidar_mi.encounter.jsbsim_aircraft import JSBSimAircraft

    return JSBSimAircraft(encounter.aircraft, encounter.path)


def fly_all(
    experiment: Experiment,
    notice: Notice,
    *,
    lidar: Lidar | None = None,
    aircraft: OwnAircraft | None = None,
    controller: OwnController | None = None,
    processes: int = 1,
    scans: ScanStore | None = None,
) -> Flown:
    """All flights of an experiment's mode of control.

    Parameters
    ----------
    experiment : Experiment
    notice : callable
        Called with what is flown and how far it is.
    lidar : Lidar, optional
        Default: `VirtualLidar` of the experiment.
    aircraft : callable, optional
        Gives an aircraft at the start; default: that of the experiment.
    controller : callable, optional
        Gives the controller of an aircraft, which steers where there is a preview; default:
        `feedforward`.
    processes, scans
        As `VirtualLidar` takes them.
    """
    encounter = encounter_of(experiment)
    wake = wake_along_path(experiment)
    levelling = encounter.control.levelling_time
    new = aircraft or (lambda: aircraft_of(encounter))
    name = name_of(controller) if controller else ""

    def steers(one: AircraftModel) -> Controller:
        return own_controller(controller, one) if controller else feedforward(one, levelling)

    found: dict[str, xr.Dataset] = {}
    slabs, track = None, None
    for mode in FLOWN[encounter.control.mode]:
        one, told = new(), _titled(notice, flight_name(mode, name))
        if mode == OFF:
            found[mode] = flown(one, wings_level(one, levelling), wake, encounter, told)
        elif mode == AUTOPILOT:
            found[mode] = flown(one, steers(one), wake, encounter, told, lambda state: no_loads)
        elif mode == PERFECT:
            found[mode] = flown(one, steers(one), wake, encounter, told, preview_of(one, wake.wind))
        else:
            instrument = lidar or _virtual_lidar(experiment, processes, scans)
            seen = Seen(instrument)
            period = 1 / encounter.rate
            stride = period * encounter.path.speed
            lookout = Lookout(instrument, period, stride, _last_scan(encounter), seen.add)
            ahead = lookout.preview(one)
            found[mode] = flown(one, steers(one), wake, encounter, told, ahead)
            track, slabs = track_dataset(lookout.slabs, wake), seen.dataset()
    order = [mode for mode in (OFF, AUTOPILOT, FEEDFORWARD, PERFECT) if mode in found]
    series = flights_dataset({mode: found[mode] for mode in order})
    return Flown(series.assign_attrs({CONTROLLER: name} if name else {}), track, slabs)


def flown(
    aircraft: AircraftModel,
    controller: Controller,
    wake: WakeAlongPath,
    encounter: Encounter,
    notice: Notice,
    ahead: Callable[[AircraftState], Preview | None] = lambda state: None,
) -> xr.Dataset:
    """One flight along the whole path, dims (time,).

    Wake and controls act in steps of 10 ms or less, a whole number of them from scan to scan. A
    flight that departs goes on with the state that it had then: this is its result.

    Parameters
    ----------
    aircraft : AircraftModel
        At the start.
    controller : callable
    wake : WakeAlongPath
    encounter : Encounter
    notice : callable
    ahead : callable
        The preview in a state; None: there is none.
    """
    period = 1 / encounter.rate
    a_scan = math.ceil(period / _STEP)
    dt, count = period / a_scan, round(duration(encounter) / period) * a_scan
    record, deflection = Recorder(), np.zeros(3)
    for step in range(count + 1):
        state = aircraft.state
        if step % a_scan == 0:
            notice(f"{state.time:.0f} of {count * dt:.0f} s", step / count)
        preview = ahead(state)
        loads = loads_in_wind(aircraft.strips, state, wake.wind, aircraft.density)
        predicted = preview(state.time) if preview else None
        commands = controller(preview, state)
        record.add(state, loads, predicted, commands, deflection, aircraft.control_moments)
        if step < count:
            aircraft.step(dt, loads, commands)
            deflection, _ = deflected(deflection, commands, dt, aircraft.limits)
    most = abs(aircraft.control_moments[0, 0]) * aircraft.limits.deflection[0]
    about = {"units": "N m", "long_name": "rolling moment of the ailerons at full deflection"}
    return record.dataset().assign(largest_control_roll_moment=((), most, about))


def duration(encounter: Encounter) -> float:
    """Of a flight, s."""
    return (encounter.path.start + encounter.path.beyond) / encounter.path.speed


def _last_scan(encounter: Encounter) -> float:
    """Time after which the slabs that are seen lie behind the end of the flight, s."""
    return max(0.0, duration(encounter) - encounter.look_ahead / encounter.path.speed)


def _titled(notice: Notice, title: str) -> Notice:
    return lambda text, fraction: notice(f"{title}: {text}", fraction)


def _virtual_lidar(experiment: Experiment, processes: int, scans: ScanStore | None) -> Lidar:
    # loads Mitsuba
    from lidar_mi.encounter.virtual_lidar import VirtualLidar

    return VirtualLidar(experiment, processes=processes, scans=scans)
