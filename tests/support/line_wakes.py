"""Vertical slices of a Doppler lidar beside wakes, with the truth.

Places are integrated by Runge and Kutta's method of fourth order and velocities by quadrature
along the lines, from the swirl of a vortex and its images: no code of the retrieval.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
import xarray as xr

from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.vortices.cores import find_cores, ring_averages
from lidar_mi.atmosphere.vortices.vortex import Vortex, angular_velocity, velocity
from lidar_mi.instrument.coherent.measurement import measured_lines
from lidar_mi.instrument.coherent.scans import LineScan, rhi_scan
from lidar_mi.instrument.coherent.weighting import CoherentLidar

LIDAR = CoherentLidar(
    pulse_duration=200e-9, gate_length=30.0, first_gate=300.0, gate_step=15.0, gates=54
)
START = np.datetime64("2000-01-01", "ns")


def slices(low=2.0, high=20.0, count=1, turn=0.5, rate=3.0):
    """Scans to the east at 3 degrees a second, a line every 50 ms."""
    ends = np.deg2rad(low), np.deg2rad(high)
    return rhi_scan(np.pi / 2, ends, np.deg2rad(rate), 0.05, count=count, turn=turn)


def averaging(length):
    """The lidar with pulses and gates of a length, m."""
    return replace(LIDAR, pulse_duration=2 * length / scipy.constants.c, gate_length=length)


@dataclass(frozen=True)
class Family:
    """Wakes of one kind, drawn by a seed.

    Attributes
    ----------
    circulations, core_radii : tuple of float
        Of each vortex, m^2/s (times 0.6 to 1.2) and m.
    separation : float
        m.
    sigma, length : float
        Of von Karman's turbulence, m/s and m.
    snr : float
    heights : (float, float)
        Of the middle, m.
    ground : float or None
        m.
    lidar : CoherentLidar
    rate : float
        Of the scan, deg/s.
    """

    circulations: tuple[float, ...] = (-400.0, 400.0)
    core_radii: tuple[float, ...] = (3.0, 3.0)
    separation: float = 47.0
    profile: str = "lamb_oseen"
    sigma: float = 0.3
    length: float = 75.0
    snr: float = 0.03
    heights: tuple[float, float] = (70.0, 150.0)
    ground: float | None = None
    lidar: CoherentLidar = LIDAR
    rate: float = 3.0


@dataclass(frozen=True, eq=False)
class Drawn:
    """A data set of lines and what is true.

    Attributes
    ----------
    lines : xr.Dataset
    times : (steps,) array
        s after `START`.
    places : (steps, vortices, 2) array
        y and z, m.
    circulations, core_radii : (vortices,) arrays
    """

    lines: xr.Dataset
    times: np.ndarray
    places: np.ndarray
    circulations: np.ndarray
    core_radii: np.ndarray

    def at(self, time):
        """Places (vortices, 2) at a time of day."""
        seconds = (time - START) / np.timedelta64(1, "s")
        shape = self.places.shape[1:]
        flat = self.places.reshape(len(self.times), -1)
        return np.array([np.interp(seconds, self.times, one) for one in flat.T]).reshape(shape)


def drawn(family: Family, seed: int, scan: LineScan | None = None, *, wake=True) -> Drawn:
    """Scans of one wake of a family; without it, of its air."""
    random = np.random.default_rng([seed, 0xAE])
    scan = slices(rate=family.rate) if scan is None else scan
    number = len(family.circulations)
    middle = np.array([random.uniform(550, 850), random.uniform(*family.heights)])
    offset = family.separation * (np.arange(number) - (number - 1) / 2)
    start = middle + np.column_stack([offset, np.zeros(number)]) + random.normal(0, 2, (number, 2))
    strengths = np.array(family.circulations) * random.uniform(0.6, 1.2)
    mean, shear = random.uniform(-4, 4), random.uniform(-0.03, 0.03)
    middle_time = scan.time.mean()

    def background(z):
        return mean + shear * (z - middle[1])

    def motion(_, flat):
        places = flat.reshape(number, 2)
        swirl = _swirl(family, strengths, places, places[:, 0], places[:, 1])
        return np.stack([swirl[0] + background(places[:, 1]), swirl[1]], -1).ravel()

    steps = np.linspace(scan.time[0] - 1, scan.time[-1] + 1, 400)
    parts = [
        scipy.integrate.solve_ivp(
            motion, (middle_time, end), start.ravel(), rtol=1e-8, atol=1e-8, dense_output=True
        ).sol
        for end in (steps[0], steps[-1])
    ]
    places = np.array([parts[int(t > middle_time)](t) for t in steps]).reshape(-1, number, 2)
    air = _air(family, seed, middle)

    def wind(x, _, z, time):
        x, z, time = np.broadcast_arrays(x, z, time)
        v, w = air(x - mean * (time - middle_time), z)
        v += background(z)
        if wake:
            now = [np.interp(time[:, 0], steps, one)[:, None] for one in places.reshape(400, -1).T]
            at = np.array(now).reshape(number, 2, -1, 1)
            swirl = _swirl(family, strengths, at, x, z)
            v, w = v + swirl[0], w + swirl[1]
        return v, np.zeros(x.shape), w

    lines = measured_lines(wind, scan, family.lidar, family.snr, seed=seed, resolution=1.5)
    return Drawn(lines, steps, places, strengths, np.array(family.core_radii))


def drawn_from(path, seed: int, sigma=0.2, length=75.0, snr=0.03, drift=-1.5) -> Drawn:
    """A slice through a simulated wake (a file with v and w on x, y, z) in turbulence.

    Its circulations are means over rings of 5 to 15 m, its places centroids of vorticity. Beyond
    the box the flow is that of two vortices.
    """
    random = np.random.default_rng([seed, 0x1E5])
    flow = xr.open_dataset(path)
    flow = flow.isel(time=0) if "time" in flow.dims else flow
    plane = flow[["v", "w"]].isel(x=int(random.integers(flow.sizes["x"]))).load()
    cores = sorted(find_cores(plane), key=lambda core: core.y)
    others = [[other for other in cores if other is not core] for core in cores]
    strengths = np.array(
        [ring_averages(plane, c, o).circulation for c, o in zip(cores, others, strict=True)]
    )
    outer = [Vortex(s, c.radius, c.y, c.z) for s, c in zip(strengths.tolist(), cores, strict=True)]
    y, z = plane["y"].values.astype(float), plane["z"].values.astype(float)
    splines = [
        scipy.interpolate.RectBivariateSpline(y, z, plane[name].transpose("y", "z").values)
        for name in "vw"
    ]
    centre = np.mean([(core.y, core.z) for core in cores], axis=0)
    middle = np.array([random.uniform(550, 850), random.uniform(90, 150)])
    scan, mean = slices(), random.uniform(-3, 3)
    middle_time = scan.time.mean()
    air = _air(Family(sigma=sigma, length=length), seed, middle)

    def wind(x, _, height, time):
        x, height, time = np.broadcast_arrays(x, height, time)
        since = time - middle_time
        v, w = air(x - mean * since, height)
        own = x - middle[0] - mean * since + centre[0], height - middle[1] - drift * since
        own = own[0], own[1] + centre[1]
        more = velocity(outer, *own)
        inside = (own[0] > y[1]) & (own[0] < y[-2]) & (own[1] > z[1]) & (own[1] < z[-2])
        for part, spline in zip(more, splines, strict=True):
            part[inside] = spline.ev(own[0][inside], own[1][inside])
        return v + mean + more[0], np.zeros(x.shape), w + more[1]

    lines = measured_lines(wind, scan, LIDAR, snr, seed=seed, resolution=1.5)
    steps = np.array([0.0, 2 * middle_time])
    own = np.array([(core.y, core.z) for core in cores]) - centre + middle
    places = np.array([own + (t - middle_time) * np.array([mean, drift]) for t in steps])
    return Drawn(lines, steps, places, strengths, np.array([core.radius for core in cores]))


def _swirl(family, strengths, places, y, z):
    """v and w at y and z of vortices at places (vortices, 2, ...), and of their images."""
    v, w = np.zeros(np.shape(y)), np.zeros(np.shape(y))
    for strength, radius, (py, pz) in zip(strengths, family.core_radii, places, strict=True):
        images = [(pz, strength)]
        if family.ground is not None:
            images.append((2 * family.ground - pz, -strength))
        for height, circulation in images:
            dy, dz = y - py, z - height
            omega = angular_velocity(dy**2 + dz**2, circulation, radius, family.profile)
            v, w = v - omega * dz, w + omega * dy
    return v, w


def _air(family, seed, middle):
    """v and w of frozen turbulence around a wake, from a grid of 2 m."""
    if not family.sigma:
        return lambda y, z: (np.zeros(np.shape(y)), np.zeros(np.shape(y)))
    field = turbulence(family.sigma, family.length, seed)
    y = middle[0] + np.arange(-200.0, 201.0, 2.0)
    z = np.maximum(middle[1], 100.0) + np.arange(-100.0, 111.0, 2.0)
    v, _, w = field.velocity(y[:, None], 0.0, z, 0.0)
    splines = [scipy.interpolate.RectBivariateSpline(y, z, one) for one in (v, w)]

    def at(across, height):
        across, height = np.clip(across, y[0], y[-1]), np.clip(height, z[0], z[-1])
        return tuple(spline.ev(across, height) for spline in splines)

    return at
