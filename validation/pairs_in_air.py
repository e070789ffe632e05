"""Tracks of vortex pairs in families of air: errors against the standard errors stated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal, NamedTuple

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from lidar_mi.atmosphere.air.turbulence import Turbulence, turbulence
from lidar_mi.atmosphere.vortices.crow import linking_amplitude, time_scale
from lidar_mi.atmosphere.vortices.filament_path import FilamentsAlongPath
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.atmosphere.vortices.wake_path import PairAlongPath
from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.image_fit import detected_fit, started_fit
from lidar_mi.retrieval.vortices.model import PARAMETERS
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import Track, first_track, updated
from tests.support.flows import axes, data_array, origin

from .report import Check, Comparison
from .scenes import Effort

TITLE = "Vortex tracks in families of air"
INTRODUCTION = (
    "Flights towards a wake in air of many kinds. Images of textured air, 0.1 s apart, show one "
    "slab after the other, 7.5 m apart; each is fitted and tracked as in flight. One half of the "
    "families built the method, the other half only judges. 68 and 95 % of the errors of the last "
    "slab should be within 1 and 2 standard errors."
)

Purpose = Literal["build", "judge"]
Swirl = Callable[[np.ndarray, np.ndarray], Sequence[np.ndarray]]
"""v and w (m/s) of vortices at y and z (m)."""

FLIGHTS, SLABS = 20, 8
STRIDE, DT, NOISE, CONTRAST = 7.5, 0.1, 0.01, 0.1
COLUMNS, ROWS, SPACING = 121, 81, 0.75
MEAN = 1.0, 0.3
_COARSE = 3.0  # of the nodes between which turbulence is interpolated, m
_FRAME = 8  # pixels of air beyond the image


@dataclass(frozen=True)
class Family:
    """Air and wake of some flights, SI units.

    `gradient` is dv/dy, dv/dz, dw/dy of the mean wind (dw/dz = -dv/dy); `turbulence` rms of each
    component and length; `wave` the amplitude of waves of 8.6 separations, at 45 degrees; `inner`
    circulation and separation of a second pair between the first; `height` that above the ground.

    `rings`: both vortices have linked to vortex rings along the path (`crow_filaments`). Slabs
    cut pairs of any separation, or none: then the true parameters are NaN.

    `stability` is the buoyancy frequency N, 1/s. The pair has sunk for its time scale. A vortex
    sheet along its oval (`_oval`) slows it down. The air about it is layered (`_layers`).
    """

    name: str
    purpose: Purpose
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turbulence: tuple[float, float] = (0.0, 50.0)
    circulations: tuple[float, float] = (350.0, -350.0)
    separation: float = 40.0
    core: float = 3.0
    wave: float = 0.0
    inner: tuple[float, float] | None = None
    height: float | None = None
    rings: bool = False
    stability: float = 0.0


_build, _judge = partial(Family, purpose="build"), partial(Family, purpose="judge")
FAMILIES = (
    _build("calm"),
    _build("shear 0.05 1/s", gradient=(0, 0.05, 0)),
    _build("strain 0.04 1/s", gradient=(0.04, 0, 0)),
    _build("turbulence 0.3 m/s, 60 m", turbulence=(0.3, 60.0)),
    _build("turbulence 0.7 m/s, 40 m", turbulence=(0.7, 40.0)),
    _build("turbulence 1.2 m/s, 80 m", turbulence=(1.2, 80.0)),
    _build("core 2 m", core=2.0),
    _build("core 5 m", core=5.0),
    _build("waves of 1 m", wave=1.0),
    _build("in ground effect, 30 m", height=30.0),
    _build("rings", rings=True),
    _build("stratified, N 0.02 1/s", stability=0.02),
    _build("inner pair of 120 m2/s", inner=(120.0, 14.0)),
    _build("single vortex", circulations=(350.0, 0.0)),
    _build("unequal, -200 m2/s", circulations=(350.0, -200.0)),
    _judge("calm, 500 m2/s", circulations=(500.0, -500.0), separation=48.0),
    _judge("shear 0.08 1/s", gradient=(0, 0.08, 0)),
    _judge("shear of w 0.06 1/s, strain 0.03 1/s", gradient=(-0.03, 0, 0.06)),
    _judge("turbulence 0.5 m/s, 100 m", turbulence=(0.5, 100.0)),
    _judge("turbulence 0.5 m/s, 30 m", turbulence=(0.5, 30.0)),
    _judge("turbulence 1 m/s, 100 m", turbulence=(1.0, 100.0)),
    _judge("turbulence 1 m/s, 30 m", turbulence=(1.0, 30.0)),
    _judge("core 1.5 m", core=1.5),
    _judge("core 6 m", core=6.0),
    _judge("waves of 2 m", wave=2.0),
    _judge("in ground effect, 22 m", height=22.0),
    _judge("rings, 270 m2/s", rings=True, circulations=(270.0, -270.0), separation=47.0),
    _judge("stratified, N 0.03 1/s", stability=0.03),
    _judge("inner pair of 90 m2/s", inner=(90.0, 18.0)),
    _judge("inner pair of -100 m2/s", inner=(-100.0, 16.0)),
    _judge("single vortex of -400 m2/s", circulations=(0.0, -400.0)),
    _judge("unequal, 250 m2/s", circulations=(250.0, -400.0)),
)


def flight(family: Family, seed: int) -> tuple[list[VortexPairFit], list[np.ndarray], Track | None]:
    """Fits of the slabs, true parameters (10,) in them, and the track after the last."""
    random = np.random.default_rng([seed, *family.name.encode()])
    air = turbulence(*family.turbulence, int(random.integers(2**31)), shortest=3.0)
    start, phase = _start(family, random), random.uniform(0, 2 * np.pi)
    slopes = random.normal(0, 0.03, 2)
    layers = _layers(family, random)
    cut = random.uniform(0, _linked(family).wavelength) if family.rings else 0.0
    fits: list[VortexPairFit] = []
    truths, track = [], None
    for number in range(SLABS):
        x, time = number * STRIDE, number * DT
        if family.rings:
            vortices, moving, swirl = _of_rings(family, start, cut, slopes, x, time)
        else:
            bent = family.wave * np.sin(2 * np.pi * x / (8.6 * family.separation) + phase) / 2**0.5
            placed = [
                replace(one, y=one.y + slopes[0] * x + side * bent, z=one.z + slopes[1] * x + bent)
                for one, side in zip(start, (1, -1) * (len(start) // 2), strict=True)
            ]
            vortices, moving = _drifted(family, placed, layers, time)
            swirl = partial(velocity, [v for v in _with_ground(family, vortices) if v.circulation])
        first, second = _images(family, swirl, layers, moving, air, x, random)
        expected = track.pair_at(x, time) if track and not track.lost else None
        if expected is None:
            pair = detected_fit(first, second, DT, NOISE)
        else:
            pair = started_fit(first, DT, NOISE, start=expected)(second)
        fits.append(pair)
        of_pair = [(v.circulation, np.log(v.core_radius), v.y, v.z) for v in vortices[:2]]
        truths.append(
            np.array([*np.ravel(of_pair), *MEAN]) if vortices else np.full(len(PARAMETERS), np.nan)
        )
        if track is not None:
            track = updated(track, pair, x, time)
        elif pair.success and pair.parameters[0] > 0 > pair.parameters[4]:
            track = first_track(pair, x, time)
    return fits, truths, track


def _start(family: Family, random: np.random.Generator) -> list[Vortex]:
    """The vortices in the first slab: port, starboard, and those of an inner pair."""
    centre, tilt = random.uniform(-4, 4, 2), random.normal(0, 0.05)
    along = np.array([np.cos(tilt), np.sin(tilt)])
    found = [
        Vortex(circulation, family.core, *(centre + side * family.separation / 2 * along))
        for side, circulation in zip((1, -1), family.circulations, strict=True)
    ]
    if family.inner:
        circulation, separation = family.inner
        found += [
            Vortex(side * circulation, 2.0, *(centre + side * separation / 2 * along))
            for side in (1, -1)
        ]
    if family.stability:
        found += _oval(family, centre, along)
    return found


def _oval(family: Family, centre: np.ndarray, along: np.ndarray) -> list[Vortex]:
    """Vorticity that buoyancy makes at the edge of the oval in which the air sinks with a pair.

    Air of the oval is lighter than that around it by N^2 s after it sank by s. The sheet at its
    edge gains N^2 s per time and height, of the sense opposite to the vortex next to it (Scorer and
    Davenport, J. Fluid Mech. 43, 451-464, 1970; Spalart, J. Fluid Mech. 327, 139-160, 1996). It
    stays where it was made. The oval is 2.09 separations wide and 1.73 high (Lamb, section 155).
    """
    b, number = family.separation, 12
    scale = time_scale(family.circulations[0], b)
    per_height = family.stability**2 * (b / scale) * scale**2 / 2
    up = np.array([-along[1], along[0]])
    found = []
    for angle in (np.arange(number) + 0.5) / number * np.pi - np.pi / 2:
        height = 1.73 / 2 * b * np.cos(angle) * np.pi / number
        for side in (1, -1):
            edge = side * 1.045 * b * np.cos(angle) * along + 0.865 * b * np.sin(angle) * up
            found.append(Vortex(-side * per_height * height, b / 8, *(centre + edge)))
    return found


class _Layer(NamedTuple):
    """A plane wave of v and w: amplitudes, m/s, wave numbers along y and z, 1/m, and phase."""

    amplitudes: tuple[float, float]
    wave: tuple[float, float]
    phase: float


def _layers(family: Family, random: np.random.Generator) -> list[_Layer]:
    """Layers of v(z), and a gravity wave, in stratified air.

    The layers are 40 to 120 m deep and have Richardson's number 1/4, the least that is stable
    (Miles, J. Fluid Mech. 10, 496-508, 1961). The wave has lines of equal phase at 20 to 70 degrees
    to the ground, along which its air moves (Gill, Atmosphere-Ocean Dynamics, 1982, section 6.4),
    and the largest amplitude that does not overturn, N over the vertical wave number (Fritts and
    Alexander, Rev. Geophys. 41, 1003, 2003).
    """
    if not family.stability:
        return []
    depths = random.uniform(40, 120, 2)
    phases = random.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(random.uniform(20, 70)) * random.choice([-1, 1])
    level, inclined = 2 * np.pi / depths
    size = family.stability / inclined
    return [
        _Layer((2 * family.stability / level, 0.0), (0.0, level), phases[0]),
        _Layer(
            (size * np.cos(tilt), size * np.sin(tilt)),
            (-inclined * np.tan(tilt), inclined),
            phases[1],
        ),
    ]


def _layered(layers: Sequence[_Layer], y, z):
    """v and w of all layers at places, m/s."""
    v, w = np.zeros(np.shape(y)), np.zeros(np.shape(y))
    for layer in layers:
        part = np.sin(layer.wave[0] * y + layer.wave[1] * z + layer.phase)
        v, w = v + layer.amplitudes[0] * part, w + layer.amplitudes[1] * part
    return v, w


@lru_cache(maxsize=1)
def _linked(family: Family) -> FilamentsAlongPath:
    """The rings of a family along x, in still air."""
    pair = PairAlongPath(family.circulations[0], family.separation, family.core)
    return FilamentsAlongPath(pair, linking_amplitude(family.separation))


def _of_rings(
    family: Family, start: Sequence[Vortex], cut: float, slopes: np.ndarray, x: float, time: float
) -> tuple[list[Vortex], np.ndarray, Swirl]:
    """Port and starboard vortex in a slab, if there are, their velocity, and the flow of all.

    Rings are 0.9 of 344 m long, and the slabs 52 m. These begin at ``cut``; the scan has been
    aimed at the height of the rings in the middle slab.
    """
    wake = _linked(family)
    nodes = wake.filaments.curves[0].places
    middle = cut + (SLABS - 1) / 2 * STRIDE
    apart = nodes[:, 0] - middle
    apart -= wake.wavelength * np.round(apart / wake.wavelength)
    aimed = nodes[np.abs(apart).argmin(), 2]
    first = np.mean([(one.y, one.z) for one in start], axis=0) - (0.0, aimed)
    shift = first + slopes * x + np.array(MEAN) * time
    moving = np.array(MEAN) + (wake.centre_at(0.5) - wake.centre_at(-0.5))[1:]

    def swirl(y, z):
        return wake.wind(cut + x, y - shift[0], z - shift[1], time)[1:]

    try:
        pair = wake.vortices(cut + x, time)
    except InputError:
        return [], moving, swirl
    return [replace(v, y=v.y + shift[0], z=v.z + shift[1]) for v in pair], moving, swirl


def _with_ground(family: Family, vortices: Sequence[Vortex]) -> list[Vortex]:
    if family.height is None:
        return list(vortices)
    mirrored = [
        replace(v, circulation=-v.circulation, z=-2 * family.height - v.z) for v in vortices
    ]
    return [*vortices, *mirrored]


def _speeds(family: Family, vortices: Sequence[Vortex], layers: Sequence[_Layer]) -> np.ndarray:
    """Of every vortex by all others, their images, layers and the mean wind, (n, 2) m/s."""
    every = _with_ground(family, vortices)
    return np.array(
        [
            np.array(MEAN)
            + _layered(layers, v.y, v.z)
            + (velocity([o for o in every if o is not v], v.y, v.z) if len(every) > 1 else 0.0)
            for v in vortices
        ]
    )


def _drifted(
    family: Family, vortices: Sequence[Vortex], layers: Sequence[_Layer], time: float
) -> tuple[list[Vortex], np.ndarray]:
    """Where they are after a time, and the mean velocity of the first two."""
    steps = max(1, round(time / 0.1))
    for _ in range(steps if time else 0):
        speeds = _speeds(family, vortices, layers) * time / steps
        vortices = [
            replace(v, y=v.y + dy, z=v.z + dz) for v, (dy, dz) in zip(vortices, speeds, strict=True)
        ]
    return list(vortices), _speeds(family, vortices, layers)[:2].mean(0)


def _images(
    family: Family,
    swirl: Swirl,
    layers: Sequence[_Layer],
    moving: np.ndarray,
    air: Turbulence,
    x: float,
    random: np.random.Generator,
) -> tuple[xr.DataArray, xr.DataArray]:
    """Of one slab, half an interval before and after its time."""
    y, z = axes(COLUMNS, ROWS, SPACING)
    lateral, vertical = np.meshgrid(y, z)
    v_y, v_z, w_y = family.gradient
    nodes = [np.arange(axis[0], axis[-1] + _COARSE, _COARSE) for axis in (y, z)]
    eddies = [np.zeros(lateral.shape)] * 2
    if family.turbulence[0]:
        place = [(vertical - nodes[1][0]) / _COARSE, (lateral - nodes[0][0]) / _COARSE]
        coarse = air.velocity(x, nodes[0], nodes[1][:, None], 0.0)[1:]
        eddies = [map_coordinates(part, place, order=3, mode="nearest") for part in coarse]

    def wind(at_y, at_z):
        v, w = np.add(swirl(at_y, at_z), _layered(layers, at_y, at_z))
        v = v + eddies[0] + MEAN[0] - moving[0] + v_y * at_y + v_z * at_z
        w = w + eddies[1] + MEAN[1] - moving[1] + w_y * at_y - v_y * at_z
        return v, w

    field = gaussian_filter(
        random.standard_normal((ROWS + 2 * _FRAME, COLUMNS + 2 * _FRAME)), 1.5, mode="wrap"
    )
    waves = spline_filter(1 + CONTRAST * field / field.std(), 3, mode="grid-wrap")
    images = []
    for time in (-DT / 2, DT / 2):
        at = origin(wind, lateral - moving[0] * time, vertical - moving[1] * time, time, 4)
        pixels = [
            (place - axis[0]) / SPACING + _FRAME for place, axis in zip(at, (y, z), strict=True)
        ][::-1]
        image = map_coordinates(waves, pixels, order=3, mode="grid-wrap", prefilter=False)
        images.append(data_array(image + NOISE * random.standard_normal(image.shape), y, z))
    return images[0], images[1]


KINDS = {"circulation": [0, 4], "place": [2, 3, 6, 7], "core": [1, 5]}


def normalised_errors(family: Family, flights: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors over stated ones of the usable tracks in the last slab, (n, 10), and of all fits."""
    tracked, fitted = [np.empty((0, 10))], [np.empty((0, 10))]
    for seed in range(flights):
        fits, truths, track = flight(family, seed)
        fitted += [
            ((fit.parameters - truth) / np.sqrt(np.diagonal(fit.covariance)))[None]
            for fit, truth in zip(fits, truths, strict=True)
            if fit.success
        ]
        if track is not None and track.usable:
            spread = np.sqrt((track.inflation * np.diagonal(track.covariance))[:10])
            tracked.append(((track.state[:10] - truths[-1]) / spread)[None])
    return np.concatenate(tracked), np.concatenate(fitted)


def within(errors: np.ndarray, kind: str) -> str:
    """Per cent within 1 and 2 standard errors."""
    if not len(errors):
        return "-"
    size = np.abs(errors[:, KINDS[kind]])
    return ", ".join(f"{100 * (size < limit).mean():.0f}" for limit in (1, 2))


def by_family(effort: Effort) -> Check:
    """Tracks and single fits in every family."""
    flights, lines, every = FLIGHTS * effort.scale, [], {"build": [], "judge": []}
    for family in FAMILIES:
        if effort.purpose not in (None, family.purpose):
            continue
        tracked, fitted = normalised_errors(family, flights)
        every[family.purpose].append(tracked)
        used = f"{len(tracked)} of {flights}", f"{len(fitted)} of {flights * SLABS}"
        numbers = (within(part, kind) for part in (tracked, fitted) for kind in KINDS)
        lines.append((family.purpose, family.name, *used, *numbers))
    for purpose, parts in every.items():
        if parts:
            tracked = np.concatenate(parts)
            lines.append(
                (purpose, "all", str(len(tracked)), "", *(within(tracked, k) for k in KINDS))
            )
    heads = (
        "half",
        "family",
        "usable tracks",
        "accepted fits",
        *KINDS,
        *(f"{k} of fits" for k in KINDS),
    )
    lines = [line + ("",) * (len(heads) - len(line)) for line in lines]
    return Check(
        "Errors by family",
        f"{flights} flights of {SLABS} slabs in each family. Per cent of the errors within 1 and 2 "
        "standard errors: of usable tracks in the last slab, and of all accepted fits.",
        (),
        comparison=Comparison(heads, tuple(lines)),
    )


CHECKS = (by_family,)
