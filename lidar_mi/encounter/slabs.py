"""The gates of a flight's scans, and the air in them."""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from lidar_mi.atmosphere.texture import PeriodicTexture, periodic_texture
from lidar_mi.atmosphere.wake import check_nodes
from lidar_mi.atmosphere.wake_path import WakeAlongPath
from lidar_mi.atmosphere.wake_volume import VolumeAlongPath
from lidar_mi.encounter.pointing import check_reported
from lidar_mi.encounter.wake import encounter_of, wake_along_path
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.truth.flows import analytic_axes
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.backscatter import beam_reach

# Nodes of the texture: 64 MB in double precision.
_TEXTURE_NODES = 8_000_000
# Angle (rad) by which air may turn in a step of its path.
_STEP_ANGLE = 0.4


@dataclass(frozen=True, eq=False)
class Gates:
    """The gates of every scan of a flight, and the nodes of its images.

    Gates are fixed in the air: scan k records ``between`` + 1 consecutive ones, and the last one of
    scan k is the first one of scan k + 1.

    Attributes
    ----------
    period : float
        From scan to scan, s.
    stride : float
        Distance of the slabs that are looked at, m: flown in a period.
    between : int
        Gates from one slab to the next.
    look_ahead : float
        Range of the last gate's start, m, from the nominal place of the aircraft.
    y, z : arrays
        Nodes of the image of the last gate, m, about the aircraft.
    """

    period: float
    stride: float
    between: int
    look_ahead: float
    y: np.ndarray
    z: np.ndarray

    @property
    def depth(self) -> float:
        """Of one gate, m."""
        return self.stride / self.between

    def slab(self, number: int) -> float:
        """Middle along x of the slab that scan ``number`` sees in its last gate, m."""
        return number * self.stride + self.look_ahead + self.depth / 2

    def plan(self, ahead: float = 0.0) -> ScanPlan:
        """A scan by an aircraft that is ``ahead`` (m) of its nominal place.

        Raises
        ------
        InputError
            An aircraft in or behind the slab that it looks at.
        """
        start = self.look_ahead - self.stride - ahead
        if not start > 0:
            raise InputError(
                f"pose.x: {ahead:g} m ahead of the nominal place is not allowed; expected less "
                f"than the {self.look_ahead - self.stride:g} m to the nearer slab"
            )
        stop = start + (self.between + 1) * self.depth
        scale = (start + stop) / 2 / (stop - self.depth / 2)
        return ScanPlan(
            self.y * scale, self.z * scale, start, stop, "planar", self.between + 1, ahead
        )

    def axes(self, plan: ScanPlan, gate: int) -> tuple[np.ndarray, np.ndarray]:
        """y and z of a gate's image, m, about the aircraft."""
        middle = plan.gate_start + (gate % plan.gate_count + 0.5) * self.depth
        return plan.y * middle / plan.centre, plan.z * middle / plan.centre


def gates_of(experiment: Experiment) -> Gates:
    """The gates of an encounter.

    Raises
    ------
    InputError
        No encounter, a look-ahead within the distance flown in a period, beams that are not aimed
        at nodes at once, through planar gates.
    """
    encounter, scan = encounter_of(experiment), experiment.scan
    for key, given, expected in (
        ("scan.aim", scan.aim, "grid"),
        ("scan.gates", scan.gates, "planar"),
        ("scan.timing", scan.timing, None),
        ("platform.motion", experiment.platform.motion, None),
        ("retrieval.blur", experiment.retrieval.blur, 0.0),
    ):
        if given != expected:
            shown = f" {given} is" if isinstance(given, str | float) else ""
            raise InputError(f"{key}:{shown} not allowed in an encounter; expected {expected}")
    check_reported(experiment.platform.reported)
    wake = wake_along_path(experiment)
    period = 1 / encounter.rate
    stride = encounter.path.speed * period
    if encounter.look_ahead <= stride:
        raise InputError(
            f"encounter.look_ahead: {encounter.look_ahead:g} m is not allowed; expected more than "
            f"the {stride:g} m flown from scan to scan"
        )
    y, z = _image_axes(experiment, wake)
    between = max(1, round(stride / scan.thickness))
    return Gates(period, stride, between, encounter.look_ahead, y, z)


def _image_axes(experiment: Experiment, wake: WakeAlongPath) -> tuple[np.ndarray, np.ndarray]:
    """y and z of the nodes of the images, m: of an analytic pair its domain, else the volume's."""
    most = call(Footprint, experiment).most_nodes()
    if not isinstance(wake, VolumeAlongPath):
        y, z = analytic_axes(experiment.wake, "vortex_pair", most)
        return y, z
    spacing, found = experiment.wake.spacing, {}
    for name in "yz":
        cells = math.floor(float(np.ptp(wake.flow[name].values)) / spacing + 1e-6)
        found[name] = spacing * (np.arange(cells + 1) - cells / 2)
    counts = {name: len(axis) for name, axis in found.items()}
    check_nodes(spacing, counts, most)
    return found["y"], found["z"]


@dataclass(frozen=True, eq=False)
class Air:
    """Aerosol along the flight path, carried by the wake's wind.

    Every slab has its texture as it is when the farther gate sees it; until the nearer gate does,
    the wind carries it, with all three components.

    Attributes
    ----------
    wake : WakeAlongPath
    texture : PeriodicTexture
    background, molecules : float
        Extinction coefficients, m^-1: mean of the aerosol, and of the air itself.
    gates : Gates
    margin : (float, float)
        m beyond the nodes, along y and z, that beams reach.
    """

    wake: WakeAlongPath
    texture: PeriodicTexture
    background: float
    molecules: float
    gates: Gates
    margin: tuple[float, float]

    def at_scan(
        self,
        number: int,
        place: tuple[float, float],
        ahead: float = 0.0,
        turned: Rotation | None = None,
    ) -> xr.DataArray:
        """Extinction (m^-1) in all gates of a scan, about an aircraft at ``place`` (y, z in m).

        A lidar that is turned about its place looks at air elsewhere: its nodes turn with it.

        Parameters
        ----------
        number : int
            Of the scan.
        place : (float, float)
            y and z of the aircraft, m.
        ahead : float
            Of its nominal place, m.
        turned : Rotation, optional
            True attitude of the lidar from the one that its beams are aimed by.

        Returns
        -------
        xarray.DataArray, dims (x, y, z)
            x from the nominal place of the aircraft, y and z from its own; all scans on one grid.
        """
        gates = self.gates
        cells = self.planes_a_gate
        step = gates.depth / cells
        index = np.arange(-1, (gates.between + 1) * cells + 1)
        x = gates.look_ahead - gates.stride + (index + 0.5) * step
        y, z = (
            _extended(axis, margin)
            for axis, margin in zip((gates.y, gates.z), self.margin, strict=True)
        )
        places = np.meshgrid(x - ahead, y, z, indexing="ij")
        if turned is not None:
            places = np.einsum("ij,j...->i...", turned.as_matrix(), np.stack(places))
        telescope = (number * gates.stride + ahead, *place)
        places = [a + b for a, b in zip(places, telescope, strict=True)]
        # the plane behind the nearer gate is carried with it, for values between both
        carried = np.s_[: 1 + cells + (gates.between > 1)]
        now = number * gates.period
        near = tuple(axis[carried] for axis in places)
        for axis, found in zip(
            places, self._origins(near, now, step, y[1] - y[0], z[1] - z[0]), strict=True
        ):
            axis[carried] = found
        mean: np.ndarray | float = self.background
        if isinstance(self.wake, VolumeAlongPath):
            # a plane that is carried has the exhaust of where and when it comes from
            times = np.full(len(x), now)
            times[carried] -= gates.period
            mean = self.wake.extinction(*places, times[:, None, None])
        values = mean * self.texture.at(*places) + self.molecules
        field = xr.DataArray(values, {"x": x, "y": y, "z": z}, ("x", "y", "z"))
        field["x"].attrs["cell_width"] = step
        return field

    @property
    def planes_a_gate(self) -> int:
        """Planes of air in the depth of a gate: at most two spacings of the nodes apart."""
        return max(1, math.ceil(self.gates.depth / (2 * (self.gates.y[1] - self.gates.y[0]))))

    def _origins(self, places, now: float, *spacing: float):
        """Where air was one period ago: Runge-Kutta steps of fourth order back in time."""
        first = self.wake.wind(*places, now)
        steep = max(
            float(np.abs(np.gradient(component, width, axis=axis)).max())
            for component in first
            for axis, width in enumerate(spacing)
        )
        count = math.ceil(self.gates.period * steep / _STEP_ANGLE)
        h = -self.gates.period / max(1, count)
        place, time = places, now
        for _ in range(max(1, count)):
            k1 = first if time == now else self.wake.wind(*place, time)
            k2 = self.wake.wind(*_moved(place, k1, h / 2), time + h / 2)
            k3 = self.wake.wind(*_moved(place, k2, h / 2), time + h / 2)
            k4 = self.wake.wind(*_moved(place, k3, h), time + h)
            slope = [a + 2 * b + 2 * c + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
            place, time = _moved(place, slope, h / 6), time + h
        return place


def air_of(experiment: Experiment, gates: Gates) -> Air:
    """The air of an encounter: its texture has a period along the path that memory holds.

    Raises
    ------
    InputError
        A texture finer than its nodes.
    """
    wake = experiment.wake
    reach = beam_reach(experiment.lidar, gates.look_ahead + 2 * gates.depth)
    spacing = float(gates.y[1] - gates.y[0])
    margin = (reach + spacing, reach + spacing)
    air = Air(
        wake_along_path(experiment),
        PeriodicTexture(np.zeros((1, 1, 1)), (1.0, 1.0, 1.0)),
        wake.extinction.background,
        wake.extinction.molecules,
        gates,
        margin,
    )
    step = gates.depth / air.planes_a_gate
    across = [float(np.ptp(axis)) + wake.texture.outer_scale for axis in (gates.y, gates.z)]
    path = experiment.encounter.path
    flight = path.start + path.beyond + gates.look_ahead
    longest = _TEXTURE_NODES * step / math.prod(length / spacing + 1 for length in across)
    texture = periodic_texture(
        (min(flight, longest), *across),
        (step, spacing, spacing),
        wake.texture.rms,
        wake.texture.outer_scale,
        experiment.seed,
    )
    return Air(air.wake, texture, air.background, air.molecules, gates, margin)


def _extended(axis: np.ndarray, margin: float) -> np.ndarray:
    step = float(axis[1] - axis[0])
    more = math.ceil(margin / step)
    return axis[0] + step * np.arange(-more, len(axis) + more)


def _moved(place, velocity, time):
    return tuple(a + time * b for a, b in zip(place, velocity, strict=True))
