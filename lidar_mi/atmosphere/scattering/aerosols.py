"""Named aerosols: shape, material, sizes and number of their particles."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from lidar_mi.errors import InputError


@dataclass(frozen=True)
class LogNormal:
    """n(r) ~ exp(-ln^2(r/median)/(2 ln^2 sigma))/r.

    median: median radius (of number) in m.
    sigma: geometric standard deviation, > 1.
    smallest, largest: radii in m between which particles exist; see `Aerosol.area_left_out`.
    """

    median: float
    sigma: float
    smallest: float
    largest: float

    def __call__(self, radius: np.ndarray | float) -> np.ndarray:
        """Number per radius, not normalised."""
        return np.exp(-0.5 * (np.log(radius / self.median) / math.log(self.sigma)) ** 2) / radius


@dataclass(frozen=True)
class ModifiedGamma:
    """n(r) ~ r^alpha exp(-(alpha/gamma) (r/mode)^gamma) (Deirmendjian 1969).

    mode: radius of the largest n(r) in m.
    alpha, gamma: > 0.
    smallest, largest: radii in m between which particles exist.
    """

    mode: float
    alpha: float
    gamma: float
    smallest: float
    largest: float

    def __call__(self, radius: np.ndarray | float) -> np.ndarray:
        """Number per radius, not normalised."""
        x = radius / self.mode
        return np.exp(self.alpha * np.log(x) - self.alpha / self.gamma * (x**self.gamma - 1))


@dataclass(frozen=True)
class Aerosol:
    """A kind of particle: shape, material, sizes, and how many there usually are.

    name, source: `source` says where the numbers come from.
    sizes: of the radius of the sphere of equal volume.
    index (tuple of (wavelength in m, complex refractive index)): positive imaginary part absorbs.
        Linear between the wavelengths, undefined beyond them.
    elongation: length over width of a prolate spheroid; 1 is a sphere.
    number_density: typical particles per m^3.
    """

    name: str
    source: str
    sizes: LogNormal | ModifiedGamma
    index: tuple[tuple[float, complex], ...]
    elongation: float = 1.0
    number_density: float = 1e8

    def __post_init__(self) -> None:
        label = f"aerosol {self.name!r}"
        sizes = self.sizes
        numbers = dict(vars(sizes), number_density=self.number_density)
        for name, value in numbers.items():
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{label}, {name}: {value!r} is not allowed; it must be > 0")
        if isinstance(sizes, LogNormal) and sizes.sigma <= 1:
            raise InputError(f"{label}, sigma: {sizes.sigma!r} is not allowed; it must be > 1")
        if not sizes.smallest < sizes.largest:
            raise InputError(
                f"{label}: radii from {sizes.smallest:g} to {sizes.largest:g} m; expected rising"
            )
        if not 1 <= self.elongation <= 4:
            raise InputError(
                f"{label}, elongation: {self.elongation!r} is not allowed; "
                "expected 1 (sphere) to 4 (prolate)"
            )
        wavelengths = [wavelength for wavelength, _ in self.index]
        if not wavelengths or sorted(set(wavelengths)) != wavelengths:
            raise InputError(f"{label}, index: wavelengths {wavelengths} m must rise")
        for _, m in self.index:
            if not (complex(m).real > 0 and complex(m).imag >= 0):
                raise InputError(
                    f"{label}, index: {m!r} is not allowed; expected a positive real part and "
                    "an imaginary part >= 0"
                )

    def refractive_index(self, wavelength: float) -> complex:
        """Refractive index at a wavelength in m.

        Raises InputError: outside the wavelengths that `index` gives.
        """
        nodes = [node for node, _ in self.index]
        # a relative 1e-9 forgives the rounding of "532 nm"
        if not nodes[0] * (1 - 1e-9) <= wavelength <= nodes[-1] * (1 + 1e-9):
            span = f"{nodes[0] * 1e9:g}"
            if len(nodes) > 1:
                span += f" to {nodes[-1] * 1e9:g}"
            raise InputError(
                f"wavelength: {wavelength * 1e9:g} nm is not allowed for aerosol {self.name!r}; "
                f"its refractive index is given for {span} nm"
            )
        values = [complex(m) for _, m in self.index]
        return complex(
            np.interp(wavelength, nodes, [m.real for m in values]),
            np.interp(wavelength, nodes, [m.imag for m in values]),
        )

    def area_left_out(self) -> float:
        """Fraction of the geometric cross-section of all sizes that is beyond the limits."""

        def area(low: float, high: float) -> float:
            # r^2 n dr is r^3 n du, with u = ln r
            return scipy.integrate.quad(
                lambda u: self.sizes(math.exp(u)) * math.exp(3 * u), low, high, epsabs=0, limit=400
            )[0]

        low, high = math.log(self.sizes.smallest), math.log(self.sizes.largest)
        inside = area(low, high)
        outside = area(low - 10, low) + area(high, high + 10)
        return outside / (inside + outside)


# Water-soluble, dust-like and soot indices: d'Almeida, Koepke & Shettle 1991 as in OPAC (Hess,
# Koepke & Schult 1998, Bull. Am. Meteorol. Soc. 79, 831), rounded. OPAC calls the dust-like one
# insoluble; at 1.55 um it has 1.396.
_DUST_LIKE = (
    (355e-9, 1.53 + 0.008j),
    (532e-9, 1.53 + 0.008j),
    (1064e-9, 1.52 + 0.008j),
    (1250e-9, 1.46 + 0.008j),
    (1550e-9, 1.40 + 0.008j),
)
_WATER_SOLUBLE = ((355e-9, 1.53 + 0.005j), (532e-9, 1.53 + 0.006j), (1064e-9, 1.52 + 0.017j))
_SOOT = ((355e-9, 1.75 + 0.46j), (532e-9, 1.75 + 0.44j), (1064e-9, 1.75 + 0.44j))
_WATER = ((355e-9, 1.343 + 1e-8j), (532e-9, 1.334 + 1e-9j), (1064e-9, 1.326 + 1e-6j))
# One part of dry salt (1.50 at 532 nm) in eight of solution: growth by 2 at 80 % humidity, as
# OPAC's.
_SEA_SALT = ((355e-9, 1.364 + 1e-8j), (532e-9, 1.355 + 1e-8j), (1064e-9, 1.344 + 2.5e-5j))
# Our choice: less absorption than OPAC's mineral (0.0065i at 532 nm), more than sun photometers
# measure in desert dust (0.001i to 0.003i; Dubovik et al. 2002, J. Atmos. Sci. 59, 590).
_DESERT = ((532e-9, 1.53 + 0.004j), (1064e-9, 1.53 + 0.003j))

AEROSOLS: dict[str, Aerosol] = {
    aerosol.name: aerosol
    for aerosol in (
        Aerosol(
            "spheroids",
            "randomly oriented prolate spheroids at 532 nm as the backscatter-lidar paper uses "
            "them; it gives no sizes, these are ours",
            LogNormal(0.20e-6, 1.7, 0.03e-6, 1.5e-6),
            _DUST_LIKE[1:],  # at 355 nm the largest are beyond the T-matrix method
            elongation=2.0,
            number_density=2e8,
        ),
        Aerosol(
            "spheres",
            "the aerosol 'spheroids' as spheres of equal volume",
            LogNormal(0.20e-6, 1.7, 0.03e-6, 1.5e-6),
            _DUST_LIKE,
            number_density=2e8,
        ),
        Aerosol(
            "continental",
            "OPAC water-soluble component, dry, number of OPAC continental average",
            LogNormal(0.0212e-6, 2.24, 0.005e-6, 5e-6),
            _WATER_SOLUBLE,
            number_density=7e9,
        ),
        Aerosol(
            "sea_salt",
            "OPAC sea salt (accumulation mode) at 80 % humidity, number of OPAC clean maritime",
            LogNormal(0.416e-6, 2.03, 0.02e-6, 15e-6),
            _SEA_SALT,
            number_density=2e7,
        ),
        Aerosol(
            "dust",
            "desert dust after long transport, spheroids; fresh dust has many particles above "
            "2 um, which are left out",
            LogNormal(0.30e-6, 1.8, 0.04e-6, 2.0e-6),
            _DESERT,
            elongation=1.6,
            number_density=3e7,
        ),
        Aerosol(
            "droplets",
            "water cloud C.1 of Deirmendjian 1969",
            ModifiedGamma(4e-6, 6.0, 1.0, 0.2e-6, 20e-6),
            _WATER,
            number_density=1e8,
        ),
        Aerosol(
            "soot",
            "OPAC soot as compact spheres; grown soot is an open aggregate, which this is not",
            LogNormal(0.0118e-6, 2.0, 0.002e-6, 0.5e-6),
            _SOOT,
            number_density=8.3e9,
        ),
    )
}


def aerosol(name: str) -> Aerosol:
    """The aerosol of this name."""
    if name not in AEROSOLS:
        raise InputError(
            f"aerosol: {name!r} is not known; expected one of {', '.join(sorted(AEROSOLS))}"
        )
    return AEROSOLS[name]


def changed(
    name: str,
    wavelength: float,
    new_name: str | None = None,
    *,
    index: complex | None = None,
    elongation: float | None = None,
    number_density: float | None = None,
    **sizes: float | None,
) -> Aerosol:
    """A named aerosol with some of its numbers changed; what is None stays.

    name: a name in `AEROSOLS`.
    wavelength: m, at which ``index`` holds.
    new_name: needed when something is changed.
    index, elongation, number_density: as in `Aerosol`; the index at one wavelength.
    **sizes: ``radius`` (median of a log-normal, mode of a modified gamma distribution),
        ``smallest``, ``largest`` in m; ``sigma`` of a log-normal one.

    Raises InputError: unknown name, a number out of range, or a change without a new name.
    """
    particles = aerosol(name)
    numbers = {"elongation": elongation, "number_density": number_density}
    changes: dict[str, Any] = {key: x for key, x in numbers.items() if x is not None}
    if index is not None:
        changes["index"] = ((wavelength, index),)
    new_sizes: dict[str, Any] = {key: x for key, x in sizes.items() if x is not None}
    if "radius" in new_sizes:
        of = "median" if isinstance(particles.sizes, LogNormal) else "mode"
        new_sizes[of] = new_sizes.pop("radius")
    for key, value in new_sizes.items():
        if not hasattr(particles.sizes, key):
            raise InputError(
                f"{key}: {value:g} is not allowed; the sizes of {name!r} have no {key}, "
                f"expected one of {', '.join(vars(particles.sizes))}"
            )
    if new_sizes:
        changes["sizes"] = replace(particles.sizes, **new_sizes)
    if not changes:
        return particles if new_name is None else replace(particles, name=new_name)
    if new_name is None or new_name in AEROSOLS:
        raise InputError(
            f"name: {new_name} is not allowed for a changed {name!r}; expected a name of its own"
        )
    return replace(
        particles,
        name=new_name,
        source=f"made from {name!r} by changing {', '.join(changes)}",
        **changes,
    )
