"""Named aerosols and their scattering tables.

The tables that ship with the package were made by this module, one command each::

    lidar-mi aerosol spheroids --wavelength '532 nm' -o FILE

Matrices come from ``scatrs`` (an optional library): T-matrix with analytic average over random
orientation for spheroids (Mishchenko 1991, J. Opt. Soc. Am. A 8, 871), Lorenz-Mie for spheres.
The average over sizes is computed here: equal steps in the logarithm of the radius.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.integrate import quad

from lidar_mi.atmosphere.scattering import ScatteringTable, read_table
from lidar_mi.errors import InputError

Notice = Callable[[str, float | None], None]
"""Called with a text that names the work and the fraction of it that is done."""

# Sizes to average over. Backscatter converges last. Spheroids: 48, 64, 96 sizes give lidar ratios
# within 0.7 % of each other (the orientation average smooths the ripple in size); spheres, whose
# ripple is narrow, need thousands: 0.5 % for cloud droplets, below 0.1 % for the others.
SPHEROID_NODES = 128
SPHERE_NODES = 10000


@dataclass(frozen=True)
class LogNormal:
    """n(r) ~ exp(-ln^2(r/median)/(2 ln^2 sigma))/r.

    Parameters
    ----------
    median : float
        Median radius (of number) in m.
    sigma : float
        Geometric standard deviation, > 1.
    smallest, largest : float
        Radii in m between which particles exist; see `Aerosol.area_left_out`.
    """

    median: float
    sigma: float
    smallest: float
    largest: float

    def __call__(self, radius):
        """Number per radius, not normalised."""
        return np.exp(-0.5 * (np.log(radius / self.median) / math.log(self.sigma)) ** 2) / radius


@dataclass(frozen=True)
class ModifiedGamma:
    """n(r) ~ r^alpha exp(-(alpha/gamma) (r/mode)^gamma) (Deirmendjian 1969).

    Parameters
    ----------
    mode : float
        Radius of the largest n(r) in m.
    alpha, gamma : float
        > 0.
    smallest, largest : float
        Radii in m between which particles exist.
    """

    mode: float
    alpha: float
    gamma: float
    smallest: float
    largest: float

    def __call__(self, radius):
        """Number per radius, not normalised."""
        x = radius / self.mode
        return np.exp(self.alpha * np.log(x) - self.alpha / self.gamma * (x**self.gamma - 1))


@dataclass(frozen=True)
class Aerosol:
    """A kind of particle: shape, material, sizes, and how many there usually are.

    Parameters
    ----------
    name, source : str
        `source` says where the numbers come from.
    sizes : LogNormal or ModifiedGamma
        Of the radius of the sphere of equal volume.
    index : tuple of (wavelength in m, complex refractive index)
        Positive imaginary part absorbs. Linear between the wavelengths, undefined beyond them.
    elongation : float
        Length over width of a prolate spheroid; 1 is a sphere.
    number_density : float
        Typical particles per m^3.

    Raises
    ------
    InputError
    """

    name: str
    source: str
    sizes: LogNormal | ModifiedGamma
    index: tuple[tuple[float, complex], ...]
    elongation: float = 1.0
    number_density: float = 1e8

    def __post_init__(self):
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

        Raises
        ------
        InputError
            Outside the wavelengths that `index` gives.
        """
        nodes = [node for node, _ in self.index]
        # a relative 1e-9 forgives the rounding of "532 nm"
        if not nodes[0] * (1 - 1e-9) <= wavelength <= nodes[-1] * (1 + 1e-9):
            known = f"{nodes[0] * 1e9:g}"
            if len(nodes) > 1:
                known += f" to {nodes[-1] * 1e9:g}"
            raise InputError(
                f"wavelength: {wavelength * 1e9:g} nm is not allowed for aerosol {self.name!r}; "
                f"its refractive index is given for {known} nm"
            )
        values = [complex(m) for _, m in self.index]
        return complex(
            np.interp(wavelength, nodes, [m.real for m in values]),
            np.interp(wavelength, nodes, [m.imag for m in values]),
        )

    def area_left_out(self) -> float:
        """Fraction of the geometric cross-section of all sizes that is beyond the limits."""

        def area(low: float, high: float) -> float:
            return quad(
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
    """The aerosol of this name.

    Raises
    ------
    InputError
        No such name.
    """
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

    Parameters
    ----------
    name : str
        A name in `AEROSOLS`.
    wavelength : float
        m, at which ``index`` holds.
    new_name : str, optional
        Needed when something is changed.
    index, elongation, number_density
        As in `Aerosol`; the index at one wavelength.
    **sizes
        ``radius`` (median of a log-normal, mode of a modified gamma distribution), ``smallest``,
        ``largest`` in m; ``sigma`` of a log-normal one.

    Raises
    ------
    InputError
        Unknown name, a number out of range, or a change without a new name.
    """
    particles = aerosol(name)
    numbers = {"elongation": elongation, "number_density": number_density}
    changes: dict[str, Any] = {key: x for key, x in numbers.items() if x is not None}
    if index is not None:
        changes["index"] = ((wavelength, index),)
    given: dict[str, Any] = {key: x for key, x in sizes.items() if x is not None}
    if "radius" in given:
        of = "median" if isinstance(particles.sizes, LogNormal) else "mode"
        given[of] = given.pop("radius")
    for key, value in given.items():
        if not hasattr(particles.sizes, key):
            raise InputError(
                f"{key}: {value:g} is not allowed; the sizes of {name!r} have no {key}, "
                f"expected one of {', '.join(vars(particles.sizes))}"
            )
    if given:
        changes["sizes"] = replace(particles.sizes, **given)
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


def aerosol_table(
    name: str, wavelength: float, notice: Notice = lambda text, fraction: None
) -> ScatteringTable:
    """The table of a named aerosol: the one that ships, or else a new one from `make_table`.

    Parameters
    ----------
    name : str
        A name in `AEROSOLS`.
    wavelength : float
        m, in vacuum.
    notice : callable, optional
        As in `make_table`.

    Raises
    ------
    InputError
        As `make_table`; ``scatrs`` is needed only where no table ships (all do at 532 nm).
    """
    shipped = (
        files("lidar_mi.scenes") / f"aerosol_{aerosol(name).name}_{wavelength * 1e9:.0f}nm.txt"
    )
    if shipped.is_file():
        table = read_table(str(shipped))
        if math.isclose(table.wavelength, wavelength, rel_tol=1e-6):
            return table
    return make_table(name, wavelength, notice=notice)


def table_angles() -> np.ndarray:
    """361 angles in degrees, steps from 0.05 near 0 and 180 to just under 1 between.

    Fine enough for cloud droplets: linear interpolation of a1 then integrates to 0.05 % of one.
    """
    # the step grows linearly away from both ends
    fine = np.linspace(0, 180, 180001)
    density = 1 / np.minimum(0.05 + 0.025 * np.minimum(fine, 180 - fine), 1.0)
    count = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    angle = np.interp(np.linspace(0, count[-1], 361), count, fine)
    # three decimals, mirrored so that both ends are alike
    half = np.round(angle[:180], 3)
    return np.concatenate([half, [90.0], 180 - half[::-1]]).round(3)


def make_table(
    particles: Aerosol | str,
    wavelength: float,
    nodes: int | None = None,
    notice: Notice = lambda text, fraction: None,
) -> ScatteringTable:
    """The scattering table of an aerosol: averages over sizes and, for spheroids, orientations.

    Parameters
    ----------
    particles : Aerosol or str
        An aerosol or the name of one in `AEROSOLS`.
    wavelength : float
        m, in vacuum.
    nodes : int, optional
        Sizes to compute; default 128 for spheroids, 10 000 for spheres, with which the lidar
        ratio has converged to 0.5 %.
    notice : callable, optional
        Called with a text that names the work and the fraction of it that is done.

    Returns
    -------
    ScatteringTable

    Raises
    ------
    InputError
        Unknown name, no refractive index at this wavelength, ``scatrs`` missing.

    Notes
    -----
    Sizes beyond the aerosol's limits are left out; the provenance states which fraction of the
    geometric cross-section that is (at 532 nm, taking the spheroids on to 2 um changes the lidar
    ratio by 0.4 %, depolarisation by 1 %). The cost of a spheroid grows steeply with its size:
    at size parameter 18 a second or two, at 26 minutes, and ``scatrs`` refuses what it has not
    been validated for, above about 24 for the presets. A preset of spheroids takes half a minute.
    """
    if isinstance(particles, str):
        particles = aerosol(particles)
    m = particles.refractive_index(wavelength)
    sphere = particles.elongation == 1
    nodes = nodes or (SPHERE_NODES if sphere else SPHEROID_NODES)
    one = _sphere if sphere else _spheroid
    sizes = particles.sizes
    low, high = math.log(sizes.smallest), math.log(sizes.largest)
    # Equal steps in ln r: the integrand vanishes at both ends, where the rule is as good as
    # Gauss's, and it spends no nodes on the largest sizes, which cost most.
    radius = np.exp(low + (high - low) * (np.arange(nodes) + 0.5) / nodes)
    number = sizes(radius) * radius
    number /= number.sum()
    area = number * math.pi * radius**2

    angle = table_angles()
    cosine = np.cos(np.radians(angle))
    extinction = scattering = 0.0
    elements = np.zeros((len(angle), 6))
    # largest first: a size that cannot be computed fails at once
    for done, i in enumerate(range(nodes - 1, -1, -1)):
        size_parameter = 2 * math.pi * radius[i] / wavelength
        q_ext, q_sca, matrix = one(size_parameter, m, particles.elongation, cosine)
        extinction += area[i] * q_ext
        scattering += area[i] * q_sca
        elements += area[i] * q_sca * matrix
        notice(f"{particles.name}: sizes", (done + 1) / nodes)
    shape = "spheres" if sphere else f"prolate spheroids, length/width {particles.elongation:g}"
    return ScatteringTable(
        name=particles.name,
        wavelength=wavelength,
        angle=angle,
        elements=elements / scattering,
        extinction_cross_section=extinction,
        albedo=scattering / extinction,
        number_density=particles.number_density,
        provenance=f"{particles.source}; {shape}, m = {m.real:.4g} + {m.imag:.3g}i, "
        f"{_sizes_text(sizes)}, {particles.area_left_out():.1g} of the geometric cross-section "
        f"left out; {_library()}, {nodes} sizes",
    )


def _sizes_text(sizes):
    limits = f"r {sizes.smallest * 1e6:g} to {sizes.largest * 1e6:g} um"
    if isinstance(sizes, LogNormal):
        return f"log-normal r {sizes.median * 1e6:g} um sigma {sizes.sigma:g}, {limits}"
    return (
        f"modified gamma mode {sizes.mode * 1e6:g} um alpha {sizes.alpha:g} "
        f"gamma {sizes.gamma:g}, {limits}"
    )


def _scatrs(module):
    """A module of the optional library."""
    from importlib import import_module

    try:
        return import_module(f"scatrs.{module}")
    except ModuleNotFoundError:
        raise InputError(
            "making a scattering table needs the library scatrs; "
            "install it with: pip install 'lidar-mi[particles]'"
        ) from None


def _library():
    from importlib.metadata import version

    return f"scatrs {version('scatrs')}"


def _sphere(x, m, _, cosine):
    """Efficiencies and matrix (a1 averages to one) of a sphere of size parameter x."""
    mie = _scatrs("mie")
    q = mie.efficiencies(x, m)
    f = mie.phase_matrix(x, m, cosine)
    return q.q_ext, q.q_sca, np.stack([f.f11, f.f11, f.f33, f.f33, f.f12, f.f34], axis=1)


def _spheroid(x, m, elongation, cosine):
    """The same for a randomly oriented prolate spheroid; x of the sphere of equal volume."""
    tmatrix, errors = _scatrs("tmatrix"), _scatrs("errors")
    try:
        # scatrs counts width over length: below one is prolate. It has not been validated for
        # the smallest sizes; our tests compare those with the Rayleigh limit in closed form.
        t = tmatrix.compute(
            x, m, 1 / elongation, rtol=1e-4, precision="auto", allow_unvalidated=x < 0.5
        )
    except errors.ScatrsError as error:
        raise InputError(
            f"spheroid of size parameter {x:.3g}, length/width {elongation:g}, index {m:.4g}: "
            f"{error}; lower the largest radius, the elongation or the index"
        ) from None
    q = t.efficiencies()
    f = t.phase_matrix(cosine)
    return q.q_ext, q.q_sca, np.stack([f.f11, f.f22, f.f33, f.f44, f.f12, f.f34], axis=1)
