"""Checks of an encounter before it is simulated: its geometry, and what may go wrong."""

import math
from collections.abc import Iterator

import numpy as np

from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.aircraft.state import AircraftModel, RisingAircraft, loads_in_wind
from lidar_mi.encounter.flight import duration
from lidar_mi.encounter.lidar.doppler import at_the_slabs
from lidar_mi.encounter.lidar.slabs import Gates, gates_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.describe import Section
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.preflight import check as preflight
from lidar_mi.experiment.run import prepare
from lidar_mi.experiment.truth.clear_air import site_altitude
from lidar_mi.experiment.truth.flight_air import air_along_path, described
from lidar_mi.experiment.truth.wake_along_path import (
    described_wake,
    encounter_of,
    vortices_in_plane,
)
from lidar_mi.progress import Notice
from lidar_mi.schema.experiment import Experiment
from lidar_mi.units import shown

# A path misses the wake where no rolling moment reaches this fraction of the ailerons'.
_MISSED = 0.01
# Slabs with both vortices in the image that a track needs: two for its slopes, one for its test.
_LEAST_SLABS = 3
_INSTANTS = 400
_UNITS = {"speed": "m/s", "dt": "s", "range": "m"}


def geometry(experiment: Experiment, aircraft: AircraftModel | None = None) -> list[str]:
    """Check the geometry of a flight before anything is rendered; warnings, a line each.

    An aircraft may take the place of that of the experiment, which has an encounter.

    Raises InputError: a near gate behind the aircraft, a look-ahead shorter than the latency
    allows, an aircraft that JSBSim does not have, that is no aeroplane or that does not trim, a
    wake that is not known along its axis.
    """
    encounter, gates = encounter_of(experiment), gates_of(experiment)
    if encounter.control.mode == "feedforward":
        _check_latency(experiment, gates)
    remarks = _without_effect(experiment, gates)
    model = aircraft or aircraft_of(encounter)
    strength = _strongest(experiment, model)
    has_wake = encounter.air is None or encounter.air.wake
    # other air may lift an aircraft without rolling it
    if strength < _MISSED and (has_wake or not isinstance(model, RisingAircraft)):
        remarks.append(
            "encounter.path: the flight misses the wake: its largest rolling moment is "
            f"{strength:.1%} of the ailerons'; expected a smaller miss or a smaller crossing angle"
            if has_wake
            else "encounter.air: no rolling moment: its largest on the path is "
            f"{strength:.1%} of the ailerons'; expected turbulence or a wake"
        )
    slabs = _slabs_in_view(experiment, gates)
    control = encounter.control
    if control.mode == "feedforward" and not has_wake:
        if control.preview == "pair":
            remarks.append(
                "encounter.air.wake: false leaves the lidar no vortices to track: its flight is "
                "that of the autopilot; expected true, or encounter.control.preview: wind"
            )
    elif control.mode == "feedforward" and slabs < _LEAST_SLABS:
        remarks.append(
            f"encounter.look_ahead: the images hold both vortices in {slabs} slabs; a track needs "
            f"{_LEAST_SLABS} (expected a wider image, wake.vortex_pair.width and height)"
        )
    return remarks


def sections(
    experiment: Experiment, notice: Notice = silent, *, timed: bool = False
) -> Iterator[Section]:
    """Titled tables of the flight and of the lidar's first slab; nothing is written.

    notice: called with the name of the running step.
    timed: with the time of the flight, which takes a probe of about two seconds.

    Raises InputError: anything that a flight would refuse before it starts.
    """
    warnings = geometry(experiment)
    encounter, gates = encounter_of(experiment), gates_of(experiment)
    path = encounter.path
    first = _first_slab(experiment)
    yield from preflight.sections(first, experiment.folder, notice, sampled=timed)
    margin = (gates.look_ahead - gates.stride) / path.speed - encounter.usual_latency
    rows: list[tuple[str, ...]] = [
        ("aircraft", encounter.aircraft.model),
        ("flight", f"{duration(encounter):.3g} s at {shown(path.speed, 'm/s')}"),
        ("crossing and climb angle", _degrees(path.crossing_angle, path.climb_angle)),
        ("control", encounter.control.mode),
        ("slabs", f"{encounter.rate:g} a second, {gates.depth:.3g} m deep"),
        ("both vortices in the image", f"in {_slabs_in_view(experiment, gates)} slabs"),
        ("from an estimate to its slab", f"{margin:.3g} s"),
        (
            "largest rolling moment",
            f"{_strongest(experiment, aircraft_of(encounter)):.0%} of the ailerons'",
        ),
    ]
    rows += described_wake(experiment)
    if encounter.air is not None:
        rows += described(encounter.air, path)
    has_wake = encounter.air is None or encounter.air.wake
    yield f"{experiment.name}: flight into the {'wake' if has_wake else 'air'}", rows
    if timed:
        from lidar_mi.experiment.preflight.cost import flight_seconds

        notice("timing a few samples and a retrieval", None)
        steers = encounter.control.mode == "feedforward"
        scans = duration(encounter) * encounter.rate if steers else 0.0
        seconds = flight_seconds(first, prepare(first).results, scans)
        text = f"about {preflight.duration(seconds)}"
        yield "cost to a factor of 2", [("the flight, on one core", text)]
    if warnings:
        yield f"{experiment.name}: warnings of the flight", [(text,) for text in warnings]


def _without_effect(experiment: Experiment, gates: Gates) -> list[str]:
    """Keys of the file without effect on a flight, and those in their place."""
    encounter, remarks = encounter_of(experiment), []
    thickness = experiment.scan.thickness
    if "thickness" in experiment.scan.model_fields_set and not _same(thickness, gates.depth):
        near = gates.stride / thickness
        counts = sorted({max(1, math.floor(near)), math.ceil(near)})
        fitting = " or ".join(f"{gates.stride / count:.4g} m" for count in counts)
        remarks.append(
            f"scan.thickness: {thickness:g} m becomes {gates.depth:.4g} m: a whole number of gates "
            f"fills the {gates.stride:.4g} m flown from scan to scan (expected {fitting}, or "
            "another encounter.path.speed or encounter.rate)"
        )
    path = encounter.path
    for section, key, instead, effective in (
        ("platform", "speed", "path.speed", path.speed),
        ("platform", "dt", "rate", 1 / encounter.rate),
        ("scan", "range", "look_ahead", encounter.look_ahead),
    ):
        part = getattr(experiment, section)
        value = getattr(part, key)
        if key in part.model_fields_set and not _same(value, effective):
            remarks.append(
                f"{section}.{key}: {value:g} {_UNITS[key]} has no effect on a flight; "
                f"encounter.{instead} makes it {effective:g} {_UNITS[key]}"
            )
    return remarks


def _same(one: float, other: float) -> bool:
    return abs(one - other) < 1e-3 * abs(other)


def _first_slab(experiment: Experiment) -> Experiment:
    """The pair of images of one slab as an experiment without a flight."""
    encounter, gates = encounter_of(experiment), gates_of(experiment)
    platform = experiment.platform.model_copy(
        update={"speed": encounter.path.speed, "dt": 1 / encounter.rate}
    )
    scan = experiment.scan.model_copy(
        update={"range": encounter.look_ahead, "thickness": gates.depth}
    )
    site = experiment.site.model_copy(
        update={"altitude": site_altitude(experiment.site, encounter)}
    )
    # the preflight of a run then covers the instrument of the flight, too
    changes = {"encounter": None, "platform": platform, "scan": scan, "site": site}
    ranged = at_the_slabs(experiment, gates)
    return ranged.model_copy(update=changes).read_from(experiment.folder)


def _check_latency(experiment: Experiment, gates: Gates) -> None:
    encounter = encounter_of(experiment)
    speed, latency = encounter.path.speed, encounter.usual_latency
    least = gates.stride + latency * speed
    if gates.look_ahead <= least:
        raise InputError(
            f"encounter.look_ahead: {gates.look_ahead:g} m is not allowed; expected more than "
            f"{least:.3g} m, flown from the first scan of a slab to its estimate "
            f"({1 / encounter.rate:g} s to the second scan, latency {latency:g} s)"
        )


def _strongest(experiment: Experiment, aircraft: AircraftModel) -> float:
    """Largest rolling moment of the wake on the nominal path, over that of the ailerons."""
    encounter, wake = encounter_of(experiment), air_along_path(experiment)
    most = aircraft.control_moments[0, 0] * aircraft.limits.deflection[0]
    times = np.linspace(0, duration(encounter), _INSTANTS)
    loads = loads_in_wind(aircraft.strips, aircraft.state, wake.wind, aircraft.density, times)
    largest = float(np.abs(loads.moment[:, 0]).max())
    # without ailerons any wake is too strong
    return largest / most if most else float("inf")


def _slabs_in_view(experiment: Experiment, gates: Gates) -> int:
    """Slabs of the nominal path whose images hold both vortices."""
    encounter, wake = encounter_of(experiment), air_along_path(experiment)
    y, z = gates.y, gates.z
    count = 0
    for number in range(
        int((duration(encounter) * encounter.path.speed - gates.look_ahead) // gates.stride)
    ):
        pair = vortices_in_plane(wake, gates.slab(number), (number + 0.5) * gates.period)
        count += pair is not None and all(
            y[0] <= one.y <= y[-1] and z[0] <= one.z <= z[-1] for one in pair
        )
    return count


def _degrees(*angles: float) -> str:
    return ", ".join(f"{np.degrees(angle):.3g} deg" for angle in angles)
