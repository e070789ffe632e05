"""A JSBSim script of one's own, flown through the wake and the air of an experiment."""

from typing import TYPE_CHECKING

import numpy as np

from lidar_mi.aircraft.jsbsim_aircraft import air_density, neu_place, state_in_path, strips_of
from lidar_mi.aircraft.jsbsim_derivatives import set_loads
from lidar_mi.aircraft.jsbsim_trim import loaded
from lidar_mi.aircraft.state import AircraftState, loads_in_wind
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.flight_air import air_along_path
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import load_experiment

if TYPE_CHECKING:
    from jsbsim import FGFDMExec


class JSBSimInAir:
    """An aircraft of JSBSim for a script of your own, on which the wind of an experiment acts.

    The script has all of JSBSim by `fdm`: it sets the initial conditions, trims, steers, reads
    properties. It calls `run` instead of ``fdm.run``. The path starts where the first `run` finds
    the aircraft, and goes north; its climb angle is that of ``encounter.path``. The wind acts as
    force and moment of strips (wing, tail, fin) at the centre of gravity; the aerodynamics of
    JSBSim see air at rest.

    Parameters
    ----------
    experiment : Experiment or str
        With the section ``encounter``; or the name of a shipped one.
    model : str
        An aircraft that JSBSim ships.

    Attributes
    ----------
    fdm : jsbsim.FGFDMExec
        With the aircraft loaded, before its initial conditions.
    state : AircraftState or None
        In the path frame, SI, as of the last `run`.

    Raises
    ------
    InputError
        No section ``encounter``; no JSBSim, no such aircraft, or one that does not load.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> flight = lm.JSBSimInAir("encounter", "737")
    >>> flight.fdm["ic/vt-kts"], flight.fdm["ic/h-sl-ft"] = 150.0, 1000.0
    >>> flight.fdm.run_ic()
    True
    >>> flight.run()
    True
    """

    def __init__(self, experiment: Experiment | str, model: str) -> None:
        if isinstance(experiment, str):
            experiment = load_experiment(experiment)
        encounter = encounter_of(experiment)
        self._wind, self._climb = air_along_path(experiment).wind, encounter.path.climb_angle
        try:
            self.fdm: FGFDMExec = loaded(model)
        except RuntimeError as error:
            raise InputError(f"model: JSBSim does not load {model!r} ({error})") from None
        self._slope = encounter.aircraft.lift_slope
        self._start: tuple[float, ...] | None = None
        self.state: AircraftState | None = None

    def run(self) -> bool:
        """Set the loads of the wind where the aircraft is, and let JSBSim take a step.

        Returns
        -------
        bool
            As of ``fdm.run``: whether the simulation goes on.
        """
        fdm = self.fdm
        if self._start is None:
            self._start = (*neu_place(fdm), fdm.get_sim_time())
            # the centre of gravity, to which the arms refer, is known by now
            self._strips = strips_of(fdm, self._slope)
        *origin, begun = self._start
        self.state = state_in_path(fdm, np.array(origin), self._climb, fdm.get_sim_time() - begun)
        if self.state is None:
            return False
        loads = loads_in_wind(self._strips, self.state, self._wind, air_density(fdm))
        set_loads(fdm, loads.force, loads.moment)
        return bool(fdm.run())
