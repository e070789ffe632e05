"""The simulated flights of an encounter: one flight is the trajectory under one controller.

All flights meet the same wake. Only the flight that steers by the lidar needs its images. The
autopilot is the controller of the flights with a preview, at a preview of no loads: the difference
between both is the benefit of a preview. Where the lidar has no track, the autopilot steers.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lidar_mi.aircraft.control import (
    Controller,
    Preview,
    bumpless_transfer,
    feedforward,
    no_loads,
    wings_level,
)
from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.aircraft.state import (
    AircraftModel,
    AircraftState,
    ailerons_deflected,
    deflected,
    loads_in_wind,
)
from lidar_mi.aircraft.strip_loads import StripLoads
from lidar_mi.aircraft.user_controller import name_of, user_controller
from lidar_mi.assessment.metrics.encounter import CONTROLLER, MET, flight_name
from lidar_mi.atmosphere.air.along_path import AirAlongPath
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.integrity import Integrity
from lidar_mi.encounter.lidar.scan_store import ScanStore
from lidar_mi.experiment.truth.flight_air import air_along_path
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.progress import Notice
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.experiment import Experiment

if TYPE_CHECKING:
    from lidar_mi.encounter.ahead.preview import Lidar


OFF, AUTOPILOT, FEEDFORWARD, PERFECT = "off", "autopilot", "feedforward", "perfect"
FLIGHTS = {
    OFF: (OFF,),
    PERFECT: (OFF, AUTOPILOT, PERFECT),
    FEEDFORWARD: (OFF, AUTOPILOT, PERFECT, FEEDFORWARD),
}
"""Flights of each mode of control: its own, and those that it is compared with."""

# Longest step of a flight, s: an aircraft at 150 m/s moves by half a core radius of 3 m.
_STEP = 0.01

OwnAircraft = Callable[[], AircraftModel]
OwnController = Callable[[AircraftModel], Controller]


@dataclass(frozen=True, eq=False)
class FlightData:
    """The data sets of an encounter's flights.

    series (flight, time): states, loads and commands.
    track (slab) and (source, slab): estimates, track and truth; None without a lidar.
    slabs (slab, z, y) and (slab, image_z, image_y): images and wind vectors; None without a lidar.
    """

    series: xr.Dataset
    track: xr.Dataset | None
    slabs: xr.Dataset | None


def simulate_flights(
    experiment: Experiment,
    notice: Notice,
    *,
    lidar: "Lidar | None" = None,
    aircraft: OwnAircraft | None = None,
    controller: OwnController | None = None,
    processes: int = 1,
    scans: ScanStore | None = None,
) -> FlightData:
    """All flights of an experiment's mode of control.

    notice: called with the name of the flight and its progress.
    lidar: default: `VirtualLidar` of the experiment.
    aircraft: gives an aircraft at the start; default: that of the experiment.
    controller: gives the controller of an aircraft, which steers where there is a preview; default:
        `feedforward`.
    processes, scans: as `VirtualLidar` takes them.
    """
    from lidar_mi.encounter.ahead.arrivals import arrivals_dataset
    from lidar_mi.encounter.ahead.preview import WakeTracker, preview_in
    from lidar_mi.encounter.ahead.wind_ahead import WindAhead
    from lidar_mi.encounter.series import flights_dataset, track_dataset
    from lidar_mi.encounter.slab_recorder import SlabRecorder

    encounter = encounter_of(experiment)
    wake = air_along_path(experiment)
    new = aircraft or (lambda: aircraft_of(encounter))
    name = name_of(controller) if controller else ""
    flights: dict[str, xr.Dataset] = {}
    slabs, track = None, None
    for mode in FLIGHTS[encounter.control.mode]:
        model, progress = new(), _titled(notice, flight_name(mode, name))
        fly = partial(simulate_flight, model, wake=wake, encounter=encounter, notice=progress)
        if mode == OFF:
            flights[mode] = fly(wings_level(model, encounter.control.levelling_time))
            continue
        steering = user_controller(controller, model) if controller else feedforward(model)
        if mode == AUTOPILOT:
            flights[mode] = fly(steering, preview_at=lambda state: no_loads)
        elif mode == PERFECT:
            flights[mode] = fly(steering, preview_at=partial(preview_in, wake.wind, model))
        else:
            instrument = lidar or _virtual_lidar(experiment, processes, scans)
            recorder = SlabRecorder(instrument)
            period = 1 / encounter.rate
            stride = period * encounter.path.speed
            tracker = WakeTracker(instrument, period, stride, _last_scan(encounter), recorder.add)
            if encounter.control.preview == "wind":
                span = 2 * float(np.abs(model.strips.places[:, 1]).max())
                tracker.ahead = WindAhead(stride, span)
            # of wind by vectors, the air about a wake is predicted too poorly to be tested; the
            # aircraft of JSBSim do not follow the linear roll mode
            tested = encounter.control.preview == "pair" and not isinstance(model, JSBSimAircraft)
            integrity = Integrity(model) if tested else None
            flights[mode] = fly(
                steering,
                observe=tracker.update,
                preview_at=partial(tracker.preview, model),
                integrity=integrity,
            )
            track, slabs = track_dataset(tracker.slabs, wake), recorder.dataset()
            track = track.merge(arrivals_dataset(tracker.arrivals, wake))
    # from no help to all help; simulated in another order, so that the slow one comes last
    order = [mode for mode in (OFF, AUTOPILOT, FEEDFORWARD, PERFECT) if mode in flights]
    series = flights_dataset({mode: flights[mode] for mode in order})
    about = {CONTROLLER: name} if name else {}
    if encounter.air is not None:
        about[MET] = "air"
        series = series.assign(_wake_alone(wake, new(), series["time"].values))
    return FlightData(series.assign_attrs(about), track, slabs)


def _wake_alone(
    air: WakeAlongPath, aircraft: AircraftModel, times: np.ndarray
) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
    """The rolling moment of the wake without the air about it, on the nominal path."""
    if not isinstance(air, AirAlongPath) or air.wake is None:
        return {}
    wind = replace(air, parts=()).wind
    loads = loads_in_wind(aircraft.strips, aircraft.state, wind, aircraft.density, times)
    about = {"units": "N m", "long_name": "rolling moment of the wake alone, port wing up"}
    return {"wake_roll_moment": ("time", loads.moment[:, 0], about)}


def simulate_flight(
    aircraft: AircraftModel,
    controller: Controller,
    wake: WakeAlongPath,
    encounter: Encounter,
    notice: Notice,
    *,
    observe: Callable[[AircraftState], None] = lambda state: None,
    preview_at: Callable[[AircraftState], Preview | None] = lambda state: None,
    integrity: Integrity | None = None,
) -> xr.Dataset:
    """One flight along the whole path, dims (time,).

    Wake and controls act in steps of 10 ms or less, a whole number of them from scan to scan. A
    flight that is lost (upset) keeps the state of that moment to its end: this is its result.

    aircraft: at the start.
    observe: a scan, if one is due in a state, and what was delivered since the last.
    preview_at: the preview in a state; None: there is none, and the controller gets what
        `bumpless_transfer` makes of the last one.
    integrity: withdraws a preview that the measured roll contradicts.
    """
    from lidar_mi.encounter.series import FlightRecorder

    period = 1 / encounter.rate
    a_scan = math.ceil(period / _STEP)
    dt, count = period / a_scan, round(duration(encounter) / period) * a_scan
    record, transfer = FlightRecorder(), bumpless_transfer()
    keys, withdrawn = encounter.aircraft, list[bool]()
    mass = aircraft.mass if isinstance(aircraft, JSBSimAircraft) else keys.heave.mass
    met = StripLoads(aircraft, wake.wind, keys.aerodynamics, mass)
    deflection, symmetric, limits = np.zeros(3), 0.0, aircraft.limits
    for step in range(count + 1):
        state = aircraft.state
        if step % a_scan == 0:
            notice(f"{state.time:.0f} of {count * dt:.0f} s", step / count)
        observe(state)
        preview = preview_at(state)
        loads = met(state)
        predicted = preview(state.time) if preview else None
        moments = aircraft.control_moments
        if integrity:
            preview = integrity.checked(preview, state, float(moments[0] @ deflection))
            withdrawn.append(integrity.withdrawn)
        commands = controller(transfer(preview, state), state)
        record.add(state, loads, predicted, commands, deflection, moments, symmetric)
        if step < count:
            aircraft.step(dt, loads, commands)
            # models need not tell where their controls are: the record follows them by the limits
            aileron = deflection[0]
            deflection, _ = deflected(deflection, commands, dt, limits)
            deflection[0], symmetric = ailerons_deflected(aileron, symmetric, commands, dt, limits)
    most = abs(aircraft.control_moments[0, 0]) * aircraft.limits.deflection[0]
    about = {"units": "N m", "long_name": "rolling moment of the ailerons at full deflection"}
    flight = record.dataset().assign(largest_control_roll_moment=((), most, about))
    about = {"units": "1", "long_name": "1: the measured roll contradicts the preview"}
    values = np.array(withdrawn if integrity else np.zeros(count + 1), float)
    return flight.assign(preview_withdrawn=("time", values, about))


def duration(encounter: Encounter) -> float:
    """Of a flight, s."""
    return (encounter.path.start + encounter.path.beyond) / encounter.path.speed


def _last_scan(encounter: Encounter) -> float:
    """Time after which a scan sees only slabs behind the end of the flight, s."""
    return max(0.0, duration(encounter) - encounter.look_ahead / encounter.path.speed)


def _titled(notice: Notice, title: str) -> Notice:
    return lambda text, fraction: notice(f"{title}: {text}", fraction)


def _virtual_lidar(experiment: Experiment, processes: int, scans: ScanStore | None) -> "Lidar":
    # Mitsuba takes seconds to load: flights without this lidar do not pay for it
    from lidar_mi.encounter.lidar.virtual_lidar import VirtualLidar

    return VirtualLidar(experiment, processes=processes, scans=scans)
