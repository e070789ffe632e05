"""The gates of a flight's scans, and the air in them."""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from lidar_mi.atmosphere.texture import PeriodicTexture, periodic_texture
from lidar_mi.atmosphere.vortices.wake import check_nodes
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.encounter.lidar.pointing import check_reported
from lidar_mi.encounter.lidar.scan_window import window_reach
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.truth.clear_air import clear_air
from lidar_mi.experiment.truth.flight_air import air_along_path
from lidar_mi.experiment.truth.flows import analytic_axes
from lidar_mi.experiment.truth.wake_along_path import encounter_of, wake_along_path
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.backscatter import beam_reach
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.wake import Wake

# Nodes of the texture: 64 MB in double precision.
_TEXTURE_NODES = 8_000_000
# Angle (rad) by which air may turn in a step of its path.
_STEP_ANGLE = 0.4


@dataclass(frozen=True, eq=False)
class Gates:
    """The gates of every scan of a flight, and the nodes of its images.

    Gates are fixed in the air: scan k records ``between`` + 1 consecutive ones, and the last one of
    scan k is the first one of scan k + 1.

    period: from scan to scan, s.
    stride: distance from slab to slab, m: flown in a period.
    between: gates from one slab to the next.
    look_ahead: range of the last gate's start, m, from the nominal place of the aircraft.
    y, z: nodes of the image of the last gate, m, about the aircraft.
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

    @property
    def planes(self) -> int:
        """Planes of air in the depth of a gate: at most two spacings of the nodes apart."""
        return max(1, math.ceil(self.depth / (2 * (self.y[1] - self.y[0]))))

    def slab(self, number: int) -> float:
        """Middle along x of the slab in the last gate of scan ``number``, m."""
        return number * self.stride + self.look_ahead + self.depth / 2

    def plan(self, ahead: float = 0.0, window: tuple[float, float] = (0.0, 0.0)) -> ScanPlan:
        """A scan by an aircraft that is ``ahead`` (m) of its nominal place.

        The middle of the last gate's image is at ``window``: y and z about the aircraft, m.

        Raises InputError: an aircraft in or behind the nearer slab.
        """
        start = self.look_ahead - self.stride - ahead
        if not start > 0:
            raise InputError(
                f"pose.x: {ahead:g} m ahead of the nominal place is not allowed; expected less "
                f"than the {self.look_ahead - self.stride:g} m to the nearer slab"
            )
        stop = start + (self.between + 1) * self.depth
        # beams are aimed at the middle of all gates, where the last gate's image is smaller
        scale = (start + stop) / 2 / (stop - self.depth / 2)
        y, z = (
            (axis + offset) * scale - offset
            for axis, offset in zip((self.y, self.z), window, strict=True)
        )
        aside = -window[0], -window[1]
        return ScanPlan(y, z, start, stop, "planar", self.between + 1, ahead, aside=aside)

    def axes(self, plan: ScanPlan, gate: int) -> tuple[np.ndarray, np.ndarray]:
        """y and z of a gate's image, m, about the aircraft."""
        middle = plan.gate_start + (gate % plan.gate_count + 0.5) * self.depth
        y, z = plan.y - plan.aside[0], plan.z - plan.aside[1]
        return y * middle / plan.centre, z * middle / plan.centre


def gates_of(experiment: Experiment) -> Gates:
    """The gates of an encounter.

    Raises InputError: no encounter, a look-ahead within the distance flown in a period, beams that
    are not aimed at nodes at once, through planar gates.
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
    assert experiment.wake is not None  # `wake_along_path` refuses its absence
    y, z = _image_axes(experiment.wake, wake, call(Footprint, experiment).most_nodes())
    between = max(1, round(stride / scan.thickness))
    return Gates(period, stride, between, encounter.look_ahead, y, z)


def _image_axes(settings: Wake, wake: WakeAlongPath, most: int) -> tuple[np.ndarray, np.ndarray]:
    """y and z of the nodes of the images, m: of an analytic pair its domain, else the volume's."""
    if not isinstance(wake, VolumeAlongPath):
        y, z = analytic_axes(settings, "vortex_pair", most)
        return y, z
    spacing, axes = settings.spacing, {}
    for name in "yz":
        # rounding must not cost a cell of an extent that is a whole number of them
        cells = math.floor(float(np.ptp(wake.flow[name].values)) / spacing + 1e-6)
        axes[name] = spacing * (np.arange(cells + 1) - cells / 2)
    counts = {name: len(axis) for name, axis in axes.items()}
    check_nodes(spacing, counts, most)
    return axes["y"], axes["z"]


Places = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Along x, y and z: places (m) or velocities (m/s)."""


@dataclass(frozen=True, eq=False)
class Air:
    """Aerosol along the flight path, advected by the wind of all air.

    The texture of a slab is that of the scan that has it in the farther gate. Until the scan that
    has it in the nearer gate, it is advected by all three components of the wind.

    background, molecules: extinction coefficients, m^-1: mean of the aerosol, and of the air
        itself.
    margin: reach of the beams beyond the nodes, along y and z, m.
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
        misalignment: Rotation | None = None,
        window: tuple[float, float] = (0.0, 0.0),
    ) -> xr.DataArray:
        """Extinction (m^-1) in all gates of a scan, about an aircraft at ``place`` (y, z in m).

        The nodes turn with a misaligned lidar, about its place.

        number: of the scan.
        place: y and z of the aircraft, m.
        ahead: of its nominal place, m.
        misalignment: true attitude of the lidar relative to the one by which its beams are aimed.
        window: middle of the scan about the aircraft, y and z in m.

        Returns
        -------
        xarray.DataArray, dims (x, y, z)
            x from the nominal place of the aircraft, y and z from the middle of the scan; all scans
            on one grid.
        """
        gates = self.gates
        cells = gates.planes
        step = gates.depth / cells
        # a plane before and one behind the gates, for values between planes
        index = np.arange(-1, (gates.between + 1) * cells + 1)
        x = gates.look_ahead - gates.stride + (index + 0.5) * step
        y, z = (
            _extended(axis, margin)
            for axis, margin in zip((gates.y, gates.z), self.margin, strict=True)
        )
        at_x, at_y, at_z = np.meshgrid(x - ahead, y + window[0], z + window[1], indexing="ij")
        if misalignment is not None:
            at_x, at_y, at_z = np.einsum(
                "ij,j...->i...", misalignment.as_matrix(), np.stack([at_x, at_y, at_z])
            )
        at_x = at_x + (number * gates.stride + ahead)
        at_y, at_z = at_y + place[0], at_z + place[1]
        # the plane behind the nearer gate is advected with it, for values between both
        advected = np.s_[: 1 + cells + (gates.between > 1)]
        now = number * gates.period
        at_x[advected], at_y[advected], at_z[advected] = self._origins(
            (at_x[advected], at_y[advected], at_z[advected]), now, step, y[1] - y[0], z[1] - z[0]
        )
        # exhaust is advected as the texture is: that of the place and time of origin
        times = np.full(len(x), now)
        times[advected] -= gates.period
        extinction = self.wake.extinction(at_x, at_y, at_z, times[:, None, None])
        mean = self.background if extinction is None else extinction
        values = mean * self.texture.at(at_x, at_y, at_z) + self.molecules
        field = xr.DataArray(values, {"x": x, "y": y, "z": z}, ("x", "y", "z"))
        field["x"].attrs["cell_width"] = step
        return field

    def _origins(self, places: Places, now: float, *spacing: float) -> Places:
        """Places of the air one period ago: Runge-Kutta steps of fourth order back in time.

        places (x, y, z): m.
        now: s.
        *spacing: along x, y and z, m: with it the steepest gradient of the wind sets the step.
        """
        first = self._wind(places, now)
        steep = max(
            float(np.abs(np.gradient(component, width, axis=axis)).max())
            for component in first
            for axis, width in enumerate(spacing)
        )
        count = math.ceil(self.gates.period * steep / _STEP_ANGLE)
        h = -self.gates.period / max(1, count)
        place, time = places, now
        for _ in range(max(1, count)):
            k1 = first if time == now else self._wind(place, time)
            k2 = self._wind(_moved(place, k1, h / 2), time + h / 2)
            k3 = self._wind(_moved(place, k2, h / 2), time + h / 2)
            k4 = self._wind(_moved(place, k3, h), time + h)
            u, v, w = (a + 2 * b + 2 * c + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
            place, time = _moved(place, (u, v, w), h / 6), time + h
        return place

    def _wind(self, places: Places, time: float) -> Places:
        x, y, z = places
        return self.wake.wind(x, y, z, time)


def air_of(experiment: Experiment, gates: Gates) -> Air:
    """The air of an encounter: its texture has the longest period along the path that memory holds.

    Raises InputError: a texture finer than its nodes.
    """
    along_path, wake = air_along_path(experiment), experiment.wake
    assert wake is not None  # `air_along_path` refuses its absence
    reach = beam_reach(experiment.lidar, gates.look_ahead + 2 * gates.depth)
    spacing = float(gates.y[1] - gates.y[0])
    encounter = encounter_of(experiment)
    # oblique beams are not at the same place in both gates
    reach += window_reach(encounter) * (gates.stride + 2 * gates.depth) / gates.look_ahead
    margin = (reach + spacing, reach + spacing)
    step = gates.depth / gates.planes
    # images at both edges must not show the same texture: an outer scale apart
    width, height = (float(np.ptp(axis)) + wake.texture.outer_scale for axis in (gates.y, gates.z))
    path = encounter.path
    flight = path.start + path.beyond + gates.look_ahead
    longest = _TEXTURE_NODES * step / ((width / spacing + 1) * (height / spacing + 1))
    texture = periodic_texture(
        (min(flight, longest), width, height),
        (step, spacing, spacing),
        wake.texture.rms,
        wake.texture.outer_scale,
        experiment.seed,
    )
    clear = call(clear_air, experiment).extinction
    return Air(along_path, texture, wake.extinction.background, clear, gates, margin)


def _extended(axis: np.ndarray, margin: float) -> np.ndarray:
    step = float(axis[1] - axis[0])
    more = math.ceil(margin / step)
    return axis[0] + step * np.arange(-more, len(axis) + more)


def _moved(place: Places, velocity: Places, time: float) -> Places:
    (x, y, z), (u, v, w) = place, velocity
    return x + time * u, y + time * v, z + time * w
