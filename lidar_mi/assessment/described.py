"""What assessments read of an experiment, which describes itself in a room above this one."""

# ruff: noqa: D102 -- a line for each attribute would repeat the schema that declares it

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
import xarray as xr

from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan


class Methods(Protocol):
    """Methods of retrieval, by name."""

    @property
    def methods(self) -> Sequence[str]: ...


class RingMethods(Methods, Protocol):
    """Analysis of rings: with which centres, and of averages of how many images."""

    @property
    def centre(self) -> Sequence[str]: ...
    @property
    def averaged(self) -> Sequence[int]: ...


class DopplerDescription(Protocol):
    """The Doppler lidar of an experiment; speeds in m/s."""

    @property
    def v_los(self) -> Sequence[float]: ...
    @property
    def lidar(self) -> DopplerLidar: ...
    @property
    def etalon(self) -> Etalon: ...
    @property
    def camera(self) -> FringeCamera: ...
    @property
    def ccd(self) -> CCD: ...
    @property
    def retrieval(self) -> RingMethods: ...


class CoherentLaser(Protocol):
    """Pulses and gates of a coherent lidar; m."""

    @property
    def wavelength(self) -> float: ...
    @property
    def pulse_length(self) -> float: ...
    @property
    def gate_length(self) -> float: ...
    @property
    def gate_spacing(self) -> float: ...
    @property
    def first_gate(self) -> float: ...


class CoherentScan(Protocol):
    """How a coherent lidar scans; accumulation of a line in s."""

    @property
    def kind(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def accumulation(self) -> float: ...


class CoherentSignal(Protocol):
    """Carrier-to-noise ratio in dB at a range in m."""

    @property
    def cnr(self) -> float: ...
    @property
    def range(self) -> float: ...


class Passage(Protocol):
    """Height of a wake that passes a lidar on the ground, m."""

    @property
    def height(self) -> float: ...


class CoherentDescription(Protocol):
    """A coherent lidar on the ground, its place in m."""

    @property
    def laser(self) -> CoherentLaser: ...
    @property
    def scan(self) -> CoherentScan: ...
    @property
    def signal(self) -> CoherentSignal: ...
    @property
    def position(self) -> Sequence[float]: ...
    @property
    def passage(self) -> Passage: ...


class Platform(Protocol):
    """Speed in m/s, time between both images in s."""

    @property
    def speed(self) -> float: ...
    @property
    def dt(self) -> float: ...


class Render(Protocol):
    """Settings of the simulation of light."""

    @property
    def variant(self) -> str: ...
    @property
    def max_order(self) -> int: ...
    @property
    def samples_per_beam(self) -> int | Literal["auto"]: ...
    @property
    def monte_carlo_fraction(self) -> float: ...


class Scattering(Protocol):
    """Names of what the light is scattered by."""

    @property
    def aerosol(self) -> str | None: ...
    @property
    def table(self) -> str | None: ...
    @property
    def phase(self) -> str: ...


class SensorDescription(Protocol):
    """Both lidars as one sensor."""

    @property
    def directions(self) -> DopplerScan: ...
    @property
    def pulses(self) -> int: ...
    @property
    def method(self) -> str: ...
    @property
    def errors(self) -> PlatformErrors: ...


class Pair(Protocol):
    """A vortex pair; m^2/s and m."""

    @property
    def model(self) -> str: ...
    @property
    def circulation(self) -> float: ...
    @property
    def separation(self) -> float: ...
    @property
    def core_radius(self) -> float: ...


class Rotor(Protocol):
    """A wind turbine; m and m/s."""

    @property
    def diameter(self) -> float: ...
    @property
    def thrust(self) -> float: ...
    @property
    def wind_speed(self) -> float: ...
    @property
    def turbulence(self) -> float: ...


class Texture(Protocol):
    """Sub-grid texture: relative rms, and its outer scale in m."""

    @property
    def rms(self) -> float: ...
    @property
    def outer_scale(self) -> float: ...


class Wake(Protocol):
    """The observed air: a pair, a turbine or a file, whose time is in s and spacing in m."""

    @property
    def vortex_pair(self) -> Pair | None: ...
    @property
    def turbine(self) -> Rotor | None: ...
    @property
    def file(self) -> str | None: ...
    @property
    def time(self) -> float | None: ...
    @property
    def spacing(self) -> float: ...
    @property
    def texture(self) -> Texture: ...


class FlightPath(Protocol):
    """Speed in m/s, angles in rad."""

    @property
    def speed(self) -> float: ...
    @property
    def crossing_angle(self) -> float: ...
    @property
    def climb_angle(self) -> float: ...


class Aircraft(Protocol):
    """The name of its model."""

    @property
    def model(self) -> str: ...


class Air(Protocol):
    """The air of a flight: with a wake, or without."""

    @property
    def wake(self) -> bool: ...


class Encounter(Protocol):
    """A flight into the wake or other air: slabs per s, look-ahead distance in m."""

    @property
    def path(self) -> FlightPath: ...
    @property
    def aircraft(self) -> Aircraft: ...
    @property
    def air(self) -> Air | None: ...
    @property
    def rate(self) -> float: ...
    @property
    def look_ahead(self) -> float: ...


class ExperimentDescription(Protocol):
    """An experiment, None for the sections that it lacks."""

    @property
    def name(self) -> str: ...
    @property
    def seed(self) -> int: ...
    @property
    def wake(self) -> Wake | None: ...
    @property
    def imaged_wake(self) -> Wake | None: ...
    @property
    def fringes(self) -> DopplerDescription | None: ...
    @property
    def coherent(self) -> CoherentDescription | None: ...
    @property
    def platform(self) -> Platform: ...
    @property
    def lidar(self) -> BackscatterLidar: ...
    @property
    def detector(self) -> Detector | None: ...
    @property
    def scan(self) -> Scan: ...
    @property
    def scattering(self) -> Scattering: ...
    @property
    def render(self) -> Render: ...
    @property
    def retrieval(self) -> Methods: ...
    @property
    def sensor(self) -> SensorDescription | None: ...
    @property
    def volume(self) -> Methods | None: ...
    @property
    def encounter(self) -> Encounter | None: ...


class ObservedAir(Protocol):
    """The true wind, on (z, y), and extinction of the observed air."""

    @property
    def wind(self) -> xr.Dataset: ...
    def image(self, which: int, smooth: bool = False) -> xr.DataArray: ...


class RingImages(Protocol):
    """Images (height, width) of rings, photoelectrons per pixel of one pulse."""

    @property
    def emitted(self) -> np.ndarray: ...
    @property
    def received(self) -> np.ndarray: ...
    @property
    def noisy(self) -> np.ndarray: ...


class Progress(Protocol):
    """Takes the progress of the figures that are drawn."""

    def bar(self, text: str, fraction: float | None) -> None: ...
