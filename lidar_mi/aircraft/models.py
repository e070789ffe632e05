"""The models of the aircraft, by their names."""

from lidar_mi.aircraft.heave_model import HeaveModel
from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import AircraftModel
from lidar_mi.schema.encounter import Encounter


def aircraft_of(encounter: Encounter) -> AircraftModel:
    """The aircraft of an encounter at its start."""
    if encounter.aircraft.model == "roll":
        return RollModel(encounter.aircraft, encounter.path)
    if encounter.aircraft.model == "heave":
        return HeaveModel(encounter.aircraft, encounter.path)
    return JSBSimAircraft(encounter.aircraft, encounter.path)
