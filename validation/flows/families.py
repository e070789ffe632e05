"""Families of flows with exactly known winds, one half to build retrievals on, one to judge them.

A family that judges takes part in no choice of a constant, threshold or default: errors that are
as stated on the flows that a method was made with say nothing of other air. All that is random in
a flow (turbulence, places, strengths and directions) is drawn anew for every seed, so that the
scatter over seeds is that over flows. Flows are steady and fill more than the image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Literal
from zlib import crc32

import numpy as np
import xarray as xr
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates, spline_filter

from lidar_mi.atmosphere.turbine import TurbineWake, turbine_flow
from lidar_mi.atmosphere.vortices.vortex import Model, Vortex, velocity, vortex_pair
from lidar_mi.atmosphere.vortices.wake import centre
from lidar_mi.io.wake_file import read_wake

from .turbulence import Wind, turbulence

Purpose = Literal["build", "judge"]
Draw = Callable[[np.random.Generator], Wind]

WIDTH, HEIGHT = 109.0, 69.0
"""Of an image, m: 139 x 219 px of 0.5 m."""

VOLUME = Path(str(files("lidar_mi.scenes"))) / "wake_volume_40s.nc"
"""The simulated wake: 20 planes 1 m apart, of which the shipped experiments show x = 20.5 m."""

WAKES = Path(__file__).parent / "wakes"
"""Planes of other simulated wakes, each with the parameters of its simulation."""


@dataclass(frozen=True)
class Family:
    """Flows of one kind.

    Attributes
    ----------
    name : str
    what : str
        The flows in one phrase.
    purpose : {"build", "judge"}
    draw : callable
        From a random generator to v, w (m s^-1) as a function of y, z (m).
    """

    name: str
    what: str
    purpose: Purpose
    draw: Draw

    def flow(self, seed: int) -> Wind:
        """The flow of a seed; families have unlike flows of the same seed."""
        return self.draw(np.random.default_rng([crc32(self.name.encode()), seed]))


def together(*draws: Draw) -> Draw:
    """The sum of independent flows."""

    def draw(random):
        winds = [one(random) for one in draws]

        def wind(y, z):
            return tuple(sum(parts) for parts in zip(*(w(y, z) for w in winds), strict=True))

        return wind

    return draw


def isotropic(largest, smallest, rms, slope=5 / 3, planar=False) -> Draw:
    return partial(
        turbulence, largest=largest, smallest=smallest, rms=rms, slope=slope, planar=planar
    )


def uniform(speed: float) -> Draw:
    """A wind of this speed in any direction."""

    def draw(random):
        angle = random.uniform(0, 2 * np.pi)
        v, w = speed * np.cos(angle), speed * np.sin(angle)
        return lambda y, z: (np.full(np.shape(y), v), np.full(np.shape(y), w))

    return draw


def linear(matrix: Callable[[np.random.Generator], np.ndarray]) -> Draw:
    """A uniform gradient (2, 2), s^-1, in axes of any direction, about a point near the middle."""

    def draw(random):
        angle = random.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        gradient = turn @ matrix(random) @ turn.T
        y0, z0 = random.uniform(-10, 10, 2)

        def wind(y, z):
            dy, dz = y - y0, z - z0
            return tuple(row[0] * dy + row[1] * dz for row in gradient)

        return wind

    return draw


def shear(random):
    return np.array([[0.0, random.uniform(0.08, 0.2)], [0.0, 0.0]])


def strain(random):
    rate = random.uniform(0.06, 0.14)
    return np.array([[rate, 0.0], [0.0, -rate]])


def jet(random) -> Wind:
    """Gaussian across any direction: 8 to 15 m/s, half width 4 to 9 m, on a slow counterflow."""
    speed, sigma = random.uniform(8, 15), random.uniform(4, 9)
    angle, offset = random.uniform(0, 2 * np.pi), random.uniform(-10, 10)
    along, across = (np.array([np.cos(a), np.sin(a)]) for a in (angle, angle + np.pi / 2))

    def wind(y, z):
        r = across[0] * y + across[1] * z - offset
        profile = speed * np.exp(-(r**2) / (2 * sigma**2)) - 1.5
        return along[0] * profile, along[1] * profile

    return wind


def outflow(random) -> Wind:
    """Three sources or sinks of Gaussian divergence, up to 6 m/s each."""
    places = random.uniform(-0.4, 0.4, (3, 2)) * (WIDTH, HEIGHT)
    radii, speeds = random.uniform(8, 20, 3), random.uniform(3, 6, 3) * random.choice([-1, 1], 3)

    def wind(y, z):
        v, w = np.zeros(np.shape(y)), np.zeros(np.shape(y))
        for (y0, z0), radius, speed in zip(places, radii, speeds, strict=True):
            dy, dz = (y - y0) / radius, (z - z0) / radius
            # r exp(-r^2 / 2) is exp(-1/2) at its largest
            profile = speed * np.exp(0.5 - (dy**2 + dz**2) / 2)
            v, w = v + profile * dy, w + profile * dz
        return v, w

    return wind


def cells(random) -> Wind:
    """Convection cells of 12 to 25 m width and up to 4 to 8 m/s, turned by up to 0.3 rad."""
    size, speed = random.uniform(12, 25, 2), random.uniform(4, 8)
    phase, angle = random.uniform(0, 2 * np.pi, 2), random.uniform(-0.3, 0.3)
    cos, sin = np.cos(angle), np.sin(angle)
    ky, kz = np.pi / size

    def wind(y, z):
        along, up = ky * (cos * y + sin * z) + phase[0], kz * (cos * z - sin * y) + phase[1]
        # of the stream function sin(along) sin(up) / k
        v = -speed * kz / np.hypot(ky, kz) * np.sin(along) * np.cos(up)
        w = speed * ky / np.hypot(ky, kz) * np.cos(along) * np.sin(up)
        return cos * v - sin * w, sin * v + cos * w

    return wind


def vortices(
    count: int,
    speeds: tuple[float, float],
    cores: tuple[float, float],
    models: Sequence[Model] = ("lamb_oseen",),
) -> Draw:
    """Vortices of either sign, of these swirls (m/s) at these core radii (m), anywhere."""

    def draw(random):
        found = []
        for _ in range(count):
            y, z = random.uniform(-0.45, 0.45, 2) * (WIDTH, HEIGHT)
            core, swirl = random.uniform(*cores), random.uniform(*speeds) * random.choice([-1, 1])
            model = models[random.integers(len(models))]
            one = Vortex(1.0, core, y, z, model)
            # the swirl at the core radius is 0.7153 (Lamb-Oseen) or 1/2 of Gamma / (2 pi r_c)
            circulation = swirl / float(velocity([one], y + core, z)[1])
            found.append(Vortex(circulation, core, y, z, model))
        return partial(velocity, found)

    return draw


def pair(separation: float, core: float, circulations: tuple[float, float]) -> Draw:
    """A wake's pair, within 8 m of the middle."""

    def draw(random):
        y, z = random.uniform(-8, 8, 2)
        return partial(velocity, vortex_pair(random.uniform(*circulations), separation, core, y, z))

    return draw


@cache
def _volume():
    wake = centre(read_wake(VOLUME))
    return wake.transpose("x", "y", "z")


def box(low: float, high: float) -> Draw:
    """A plane of the simulated wake between two places x (m), mirrored or upside down or not.

    The wind is the cubic spline through the nodes of 1 m, and constant beyond the edges.
    """

    def draw(random):
        wake = _volume().sel(x=slice(low, high))
        plane = wake.isel(x=int(random.integers(wake.sizes["x"])))
        y_axis, z_axis = plane["y"].values, plane["z"].values
        splines = [RectBivariateSpline(y_axis, z_axis, plane[name].values) for name in "vw"]
        signs = random.choice([-1.0, 1.0], 2)

        def wind(y, z):
            places = [
                np.clip(sign * np.asarray(a, float), axis[0], axis[-1])
                for sign, a, axis in zip(signs, (y, z), (y_axis, z_axis), strict=True)
            ]
            return tuple(
                sign * spline(*places, grid=False)
                for sign, spline in zip(signs, splines, strict=True)
            )

        return wind

    return draw


@cache
def _wake(name: str) -> xr.Dataset:
    return xr.load_dataset(WAKES / f"{name}.nc")


def wake(name: str) -> Draw:
    """A plane of another simulated wake, mirrored or upside down or not.

    The pair's middle is within 8 m of the image's. The wind is the cubic spline through the nodes,
    and periodic as the simulation is. Planes are 5 to 6.25 m apart.
    """

    def draw(random):
        planes = _wake(name)
        plane = planes.isel(x=int(random.integers(planes.sizes["x"])))
        first = [float(plane[axis][0]) for axis in "yz"]
        step = float(plane["y"][1] - plane["y"][0])
        splines = [
            spline_filter(plane[component].values, 3, mode="grid-wrap") for component in "vw"
        ]
        signs, middle = random.choice([-1.0, 1.0], 2), random.uniform(-8, 8, 2)

        def wind(y, z):
            nodes = [
                (sign * (np.asarray(a, float) - a0) - start) / step
                for sign, a, a0, start in zip(signs, (y, z), middle, first, strict=True)
            ]
            return tuple(
                sign * map_coordinates(spline, nodes, mode="grid-wrap", prefilter=False)
                for sign, spline in zip(signs, splines, strict=True)
            )

        return wind

    return draw


def turbine(random) -> Wind:
    """Swirl and turbulence 2.5 to 4 diameters behind a rotor, its axis within 8 m of the middle."""
    diameter = random.uniform(45, 65)
    wake = TurbineWake(
        diameter=diameter,
        thrust=random.uniform(0.6, 0.8),
        tip_speed_ratio=random.uniform(5, 8) * random.choice([-1, 1]),
        wind_speed=random.uniform(9, 14),
        growth=0.04,
        downstream=random.uniform(2.5, 4) * diameter,
        hub_core=random.uniform(3, 6),
    )
    y_axis, z_axis = np.arange(-75.0, 75.5), np.arange(-55.0, 55.5)
    seed = int(random.integers(2**31))
    flow = turbine_flow(wake, np.arange(2.0), y_axis, z_axis, ambient=0.08, seed=seed)
    plane = flow.isel(x=0).transpose("y", "z")
    splines = [RectBivariateSpline(y_axis, z_axis, plane[name].values) for name in "vw"]
    y0, z0 = random.uniform(-8, 8, 2)

    def wind(y, z):
        places = np.asarray(y, float) - y0, np.asarray(z, float) - z0
        return tuple(spline(*places, grid=False) for spline in splines)

    return wind


UNLIKE = vortices(4, (4, 12), (2, 6))
CLOSE = pair(20.0, 1.5, (80, 160))
WIDE = pair(47.1, 3.0, (250, 450))

FAMILIES = (
    Family(
        "turbulence 60 to 4 m",
        "three-dimensional, E ~ k^-5/3, 1.5 m/s",
        "build",
        isotropic(60, 4, 1.5),
    ),
    Family(
        "turbulence 30 to 2 m",
        "three-dimensional, E ~ k^-5/3, 3 m/s",
        "build",
        isotropic(30, 2, 3.0),
    ),
    Family(
        "turbulence 100 to 10 m",
        "three-dimensional, E ~ k^-5/3, 4 m/s",
        "build",
        isotropic(100, 10, 4.0),
    ),
    Family(
        "steep turbulence 80 to 3 m",
        "three-dimensional, E ~ k^-2.5, 3 m/s",
        "build",
        isotropic(80, 3, 3.0, slope=2.5),
    ),
    Family(
        "planar turbulence 60 to 3 m",
        "two-dimensional, E ~ k^-3, 3 m/s",
        "build",
        isotropic(60, 3, 3.0, slope=3.0, planar=True),
    ),
    Family(
        "planar turbulence 50 to 3.5 m",
        "two-dimensional, E ~ k^-5/3, 2.5 m/s",
        "build",
        isotropic(50, 3.5, 2.5, planar=True),
    ),
    Family("shear", "linear, 0.08 to 0.2 s^-1, any direction", "build", linear(shear)),
    Family(
        "shear in turbulence",
        "the same with turbulence of 0.8 m/s, 50 to 3 m",
        "build",
        together(linear(shear), isotropic(50, 3, 0.8)),
    ),
    Family("four vortices", "unlike, cores of 2 to 6 m, 4 to 12 m/s", "build", UNLIKE),
    Family("wide pair", "47.1 m apart, cores of 3 m", "build", WIDE),
    Family(
        "wide pair in turbulence",
        "the same in turbulence of 0.5 m/s, 30 to 3 m",
        "build",
        together(WIDE, isotropic(30, 3, 0.5)),
    ),
    Family("close pair", "20 m apart, cores of 1.5 m", "build", CLOSE),
    Family("outflow", "three sources or sinks of 8 to 20 m", "build", outflow),
    Family(
        "uniform wind, 0.5 m/s of turbulence",
        "5 m/s, turbulence from 50 to 5 m",
        "build",
        together(uniform(5.0), isotropic(50, 5, 0.5)),
    ),
    Family(
        "simulated wake, x = 11 to 15 m",
        "planes of the box, 5 to 9 m from the experiments'",
        "build",
        box(11, 15),
    ),
    Family(
        "turbulence 40 to 3 m",
        "three-dimensional, E ~ k^-5/3, 2 m/s",
        "judge",
        isotropic(40, 3, 2.0),
    ),
    Family(
        "planar turbulence 40 to 3 m",
        "two-dimensional, E ~ k^-5/3, 2 m/s",
        "judge",
        isotropic(40, 3, 2.0, planar=True),
    ),
    Family(
        "planar turbulence 60 to 5 m",
        "two-dimensional, E ~ k^-5/3, 5 m/s",
        "judge",
        isotropic(60, 5, 5.0, planar=True),
    ),
    Family(
        "flat turbulence 40 to 2 m",
        "three-dimensional, E ~ k^-1.2, 1.2 m/s",
        "judge",
        isotropic(40, 2, 1.2, slope=1.2),
    ),
    Family(
        "planar turbulence 90 to 4 m",
        "two-dimensional, E ~ k^-3, 5 m/s",
        "judge",
        isotropic(90, 4, 5.0, slope=3.0, planar=True),
    ),
    Family("jet", "Gaussian, 8 to 15 m/s, sigma of 4 to 9 m", "judge", jet),
    Family(
        "jet in turbulence",
        "the same in turbulence of 1 m/s, 25 to 2.5 m",
        "judge",
        together(jet, isotropic(25, 2.5, 1.0)),
    ),
    Family("cells", "convection cells of 12 to 25 m, 4 to 8 m/s", "judge", cells),
    Family("strain", "pure, 0.06 to 0.14 s^-1, any direction", "judge", linear(strain)),
    Family(
        "many small vortices",
        "24, cores of 1 to 2.5 m, 1.5 to 5 m/s",
        "judge",
        vortices(24, (1.5, 5), (1, 2.5)),
    ),
    Family(
        "vortices of many sizes",
        "9 of both models, cores of 1.5 to 10 m, 2 to 9 m/s",
        "judge",
        vortices(9, (2, 9), (1.5, 10), ("lamb_oseen", "burnham_hallock")),
    ),
    Family(
        "close pair in turbulence",
        "20 m apart, cores of 1.5 m; planar, 0.8 m/s from 30 to 3 m",
        "judge",
        together(CLOSE, isotropic(30, 3, 0.8, planar=True)),
    ),
    Family(
        "uniform wind, 0.2 m/s of turbulence",
        "5 m/s, planar turbulence from 40 to 3 m",
        "judge",
        together(uniform(5.0), isotropic(40, 3, 0.2, planar=True)),
    ),
    Family(
        "simulated wake, x = 25 to 30 m",
        "planes of the box, 5 to 9 m from the experiments'",
        "judge",
        box(25, 30),
    ),
    Family("turbine", "swirl and turbulence behind a rotor, 9 to 14 m/s", "judge", turbine),
    Family(
        "wake of a light aircraft, strong turbulence",
        "large eddy simulation, 20 m apart, 10 s old",
        "build",
        wake("light_strong_turbulence"),
    ),
    Family(
        "wake of a medium aircraft, strong turbulence",
        "large eddy simulation, 24 m apart, 10 s old",
        "judge",
        wake("medium_strong_turbulence"),
    ),
    Family(
        "wake of a medium aircraft, weak turbulence",
        "large eddy simulation, 28 m apart, 12 s old",
        "build",
        wake("medium_weak_turbulence"),
    ),
    Family(
        "wake of a heavy aircraft, stratified air",
        "large eddy simulation, 34 m apart, 18 s old",
        "judge",
        wake("heavy_stratified"),
    ),
)

BY_NAME = {family.name: family for family in FAMILIES}


def chosen(purpose: Purpose | None = None) -> tuple[Family, ...]:
    """Families of a purpose, or all."""
    return tuple(family for family in FAMILIES if purpose in (None, family.purpose))
