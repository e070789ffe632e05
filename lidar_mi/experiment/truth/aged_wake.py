"""An analytic wake of an encounter, as old as it is met: decayed, bent by waves, or linked."""

from functools import lru_cache

from lidar_mi.atmosphere.vortices.crow import grown, linking_age
from lidar_mi.atmosphere.vortices.filament_path import FilamentsAlongPath
from lidar_mi.atmosphere.vortices.wake_decay import sarpkaya_decay_time
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.errors import InputError
from lidar_mi.schema.encounter import Encounter, WakeInTime
from lidar_mi.schema.wake import VortexPair


def analytic_wake(pair: VortexPair, encounter: Encounter) -> PairAlongPath | FilamentsAlongPath:
    """The wake of an analytic pair along the flight path.

    Raises InputError: a deformation of more than half of the separation, of filaments that are
    linked at age 0.
    """
    path, wake = encounter.path, encounter.wake
    arrival = path.start / path.speed
    decay_time, crow = _decay_time(pair, wake), wake.crow
    bent = crow.model == "filaments"
    aged = PairAlongPath(
        pair.circulation,
        pair.separation,
        pair.core_radius,
        pair.model,
        crossing_angle=path.crossing_angle,
        climb_angle=path.climb_angle,
        x_c=path.start,
        t_c=arrival,
        miss=(path.miss.y, path.miss.z),
        decay_time=decay_time,
        crow_amplitude=0.0 if bent else crow.amplitude,
        crow_wavelength=crow.wavelength,
        crow_phase=crow.phase,
        age=wake.age,
    )
    if not bent:
        return aged
    if crow.amplitude >= pair.separation / 2:
        raise InputError(
            f"encounter.wake.crow.amplitude: {crow.amplitude:g} m at age 0 is not allowed; "
            f"expected below half of the separation, {pair.separation / 2:.4g} m"
        )
    # growth is that of the vortices at age 0, which decay little before they link
    amplitude = grown(crow.amplitude, wake.age + arrival, pair.circulation, pair.separation)
    return _filaments(aged, amplitude)


# check, flight and lidar need it again: its table takes seconds
@lru_cache(maxsize=2)
def _filaments(pair: PairAlongPath, amplitude: float) -> FilamentsAlongPath:
    return FilamentsAlongPath(pair, amplitude)


def _decay_time(pair: VortexPair, wake: WakeInTime) -> float | None:
    if wake.dissipation_rate is None:
        return wake.decay_time
    return sarpkaya_decay_time(pair.circulation, pair.separation, wake.dissipation_rate)


def described_pair(pair: VortexPair, encounter: Encounter) -> list[tuple[str, str]]:
    """The analytic wake in words: a name and a line for each of its properties."""
    wake, analytic = encounter.wake, analytic_wake(pair, encounter)
    aged = analytic.pair if isinstance(analytic, FilamentsAlongPath) else analytic
    left_by = "" if pair.aircraft is None else f"of an {pair.aircraft}, "
    rows = [
        (
            "vortices when met",
            f"{left_by}{float(aged.circulation_at(aged.t_c)):.4g} m^2/s, {aged.separation:.3g} m "
            f"apart, cores of {aged.core_radius:.2g} m, {wake.age + aged.t_c:.3g} s old",
        )
    ]
    if aged.decay_time is not None:
        rows.append(("decay of the vortices", f"to 1/e in {aged.decay_time:.3g} s"))
    if isinstance(analytic, FilamentsAlongPath) and wake.crow.amplitude:
        age = linking_age(wake.crow.amplitude, pair.circulation, pair.separation)
        since = wake.age + aged.t_c - age
        text = (
            f"rings since {since:.3g} s"
            if analytic.rings
            else f"waves of {analytic.amplitude:.3g} m, linking in {-since:.3g} s"
        )
        rows.append(("Crow instability", f"{text}, {analytic.wavelength:.3g} m long"))
    return rows
