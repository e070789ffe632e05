"""Scattering matrices as tables: what a particle or a molecule does to polarised light.

The matrix of a macroscopically isotropic, mirror-symmetric medium has six independent elements
over the scattering angle (Hansen & Travis 1974, Space Sci. Rev. 16, sec. 2.7)::

    a1  b1   0   0
    b1  a2   0   0
     0   0  a3  b2
     0   0 -b2  a4

It acts on Stokes vectors (I, Q, U, V) that refer to the scattering plane, Q > 0 parallel to it;
a1 averages to one over the sphere of directions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

ELEMENTS = ("a1", "a2", "a3", "a4", "b1", "b2")

# Rounding of seven digits in files; an interpolated 180 degree value is as good as its neighbours.
_TOLERANCE = 1e-5


@dataclass(frozen=True, eq=False)
class ScatteringTable:
    """What one kind of particle, or a mixture, does to light of one wavelength.

    wavelength: m, in vacuum.
    angle (N,): scattering angle in degrees, rising from 0 to 180; values between are linear in
        angle.
    elements (N, 6): a1, a2, a3, a4, b1, b2; a1 averages to one over the sphere.
    extinction_cross_section: m^2 per particle (the mean over the size distribution).
    albedo: single-scattering albedo.
    number_density: particles per m^3 that go with this table.
    provenance: one line: the source of the numbers.

    Raises InputError: a number out of range, or a matrix that no collection of particles can have
    (`check`).
    """

    name: str
    wavelength: float
    angle: np.ndarray = field(repr=False)
    elements: np.ndarray = field(repr=False)
    extinction_cross_section: float
    albedo: float = 1.0
    number_density: float = 1.0
    provenance: str = ""

    def __post_init__(self) -> None:
        for name in ("angle", "elements"):
            values = np.array(getattr(self, name), float)
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        check(self)

    @property
    def backscatter_per_extinction(self) -> float:
        """Backscatter over extinction coefficient, sr^-1: albedo a1(180)/(4 pi)."""
        # the last angle is 180 degrees
        return float(self.albedo * self.elements[-1, 0] / (4 * math.pi))

    @property
    def lidar_ratio(self) -> float:
        """Extinction over backscatter coefficient, sr."""
        return 1 / self.backscatter_per_extinction

    @property
    def depolarization_ratio(self) -> float:
        """Linear depolarisation ratio of backscatter, (a1 - a2)/(a1 + a2) at 180 degrees."""
        a1, a2 = self.elements[-1, :2]
        return float((a1 - a2) / (a1 + a2))

    @property
    def asymmetry(self) -> float:
        """Mean cosine of the scattering angle."""
        norm, mean = _moments(self.angle, self.elements[:, 0])
        return mean / norm

    @property
    def extinction(self) -> float:
        """Extinction coefficient at `number_density`, m^-1."""
        return self.number_density * self.extinction_cross_section

    @property
    def backscatter(self) -> float:
        """Backscatter coefficient at `number_density`, m^-1 sr^-1."""
        return self.extinction * self.backscatter_per_extinction

    def at(self, angle: ArrayLike) -> np.ndarray:
        """The elements at other angles (degrees), shape (..., 6), linear between the nodes."""
        angle = np.asarray(angle, float)
        return np.stack([np.interp(angle, self.angle, row) for row in self.elements.T], axis=-1)


def _moments(angle: np.ndarray, a1: np.ndarray) -> tuple[float, float]:
    """Mean over the sphere of a1 and of a1 cos(angle), exact for a1 linear in angle."""
    theta = np.radians(angle)
    slope = np.diff(a1) / np.diff(theta)

    def half_integral(first: np.ndarray, second: np.ndarray) -> float:
        # by parts on each interval, with the first and second antiderivative of the weight
        return float((np.diff(a1 * first) - slope * np.diff(second)).sum()) / 2

    norm = half_integral(-np.cos(theta), -np.sin(theta))  # weight sin
    mean = half_integral(-np.cos(2 * theta) / 4, -np.sin(2 * theta) / 8)  # weight sin cos
    return norm, mean


def check(table: ScatteringTable) -> None:
    """Refuse what no collection of particles can do.

    Checks: a1 > 0 and averaging to one within 1 %; no element above a1; the inequalities
    (a3 + a4)^2 + 4 b2^2 <= (a1 + a2)^2 - 4 b1^2 and |a3 - a4| <= a1 - a2, |a2 - b1| <= a1 - b1,
    |a2 + b1| <= a1 + b1, which hold for every sum of particles (Hovenier, van de Hulst & van der
    Mee 1986, Astron. Astrophys. 157, 301); the symmetry relations forward (a2 = a3, b1 = b2 = 0)
    and backward (a2 = -a3, a4 = a1 - 2 a2, b1 = b2 = 0; van de Hulst 1957, sec. 5.2;
    Mishchenko & Hovenier 1995).
    """
    label = f"scattering table {table.name!r}"
    numbers = {
        "wavelength": table.wavelength,
        "extinction_cross_section": table.extinction_cross_section,
        "number_density": table.number_density,
    }
    for name, number in numbers.items():
        if not (math.isfinite(number) and number > 0):
            raise InputError(f"{label}, {name}: {number!r} is not allowed; it must be > 0")
    if not 0 < table.albedo <= 1 + 1e-9:
        raise InputError(f"{label}, albedo: {table.albedo!r} is not allowed; 0 < albedo <= 1")
    angle, elements = table.angle, table.elements
    if angle.ndim != 1 or len(angle) < 3 or elements.shape != (len(angle), 6):
        raise InputError(
            f"{label}: {angle.shape} angles with {elements.shape} elements; expected N >= 3 "
            "angles and N x 6 elements"
        )
    if not (np.isfinite(angle).all() and np.isfinite(elements).all()):
        raise InputError(f"{label}: NaN or infinity; expected finite numbers")
    if angle[0] != 0 or angle[-1] != 180 or (np.diff(angle) <= 0).any():
        raise InputError(
            f"{label}, angle: {angle[0]:g} ... {angle[-1]:g}; expected rising from 0 to 180 degrees"
        )
    a1, a2, a3, a4, b1, b2 = elements.T
    if (a1 <= 0).any():
        raise InputError(
            f"{label}, a1: {a1.min():g} at {angle[a1.argmin()]:g} degrees; must be > 0"
        )
    norm, _ = _moments(angle, a1)
    if abs(norm - 1) > 0.01:
        raise InputError(
            f"{label}, a1: averages to {norm:.4f} over the sphere; expected 1 within 1 % "
            "(denser angles where a1 is steep may be needed)"
        )
    for name, values in zip(ELEMENTS[1:], elements.T[1:], strict=True):
        _worst(label, angle, f"|{name}| above a1", np.abs(values) - a1, a1)
    _worst(label, angle, "|a3 - a4| above a1 - a2", np.abs(a3 - a4) - (a1 - a2), a1)
    _worst(label, angle, "|a2 - b1| above a1 - b1", np.abs(a2 - b1) - (a1 - b1), a1)
    _worst(label, angle, "|a2 + b1| above a1 + b1", np.abs(a2 + b1) - (a1 + b1), a1)
    _worst(
        label,
        angle,
        "(a3 + a4)^2 + 4 b2^2 above (a1 + a2)^2 - 4 b1^2",
        (a3 + a4) ** 2 + 4 * b2**2 - (a1 + a2) ** 2 + 4 * b1**2,
        # the left side is at most this, as no element exceeds a1
        8 * a1**2,
    )
    relations = {
        "a2 = a3 at 0 degrees": (a2[0] - a3[0], a1[0]),
        "b1 = 0 at 0 degrees": (b1[0], a1[0]),
        "b2 = 0 at 0 degrees": (b2[0], a1[0]),
        "a2 = -a3 at 180 degrees": (a2[-1] + a3[-1], a1[-1]),
        "a4 = a1 - 2 a2 at 180 degrees": (a4[-1] - a1[-1] + 2 * a2[-1], a1[-1]),
        "b1 = 0 at 180 degrees": (b1[-1], a1[-1]),
        "b2 = 0 at 180 degrees": (b2[-1], a1[-1]),
    }
    for relation, (difference, scale) in relations.items():
        if abs(difference) > _TOLERANCE * scale:
            raise InputError(
                f"{label}: {relation} fails by {difference / scale:.2g} of a1; such a matrix "
                "does not exist"
            )


def _worst(label: str, angle: np.ndarray, what: str, excess: np.ndarray, scale: np.ndarray) -> None:
    worst = int((excess / scale).argmax())
    if excess[worst] > _TOLERANCE * scale[worst]:
        raise InputError(f"{label}: {what} at {angle[worst]:g} degrees; such a matrix cannot exist")


def rayleigh_table(
    depolarization: float,
    wavelength: float,
    extinction_cross_section: float,
    albedo: float = 1.0,
    name: str = "rayleigh",
    number_density: float = 1.0,
    provenance: str = "Hansen & Travis 1974, eqs. 2.15-2.17",
) -> ScatteringTable:
    """The scattering matrix of molecules (Hansen & Travis 1974, eqs. 2.15-2.17).

    depolarization: depolarisation factor of natural light at 90 degrees, 0 <= d < 0.5.

    Notes
    -----
    On the one-degree grid, linear interpolation is off by at most 8e-5 of a1.
    """
    if not 0 <= depolarization < 0.5:
        raise InputError(
            f"depolarization: {depolarization!r} is not allowed; 0 <= depolarization < 0.5"
        )
    angle = np.arange(181.0)
    cosine = np.cos(np.radians(angle))
    # Delta and Delta' of the source
    dipole = (1 - depolarization) / (1 + depolarization / 2)
    circular = (1 - 2 * depolarization) / (1 - depolarization)
    square = 0.75 * dipole * (1 + cosine**2)
    elements = np.stack(
        [
            square + (1 - dipole),
            square,
            1.5 * dipole * cosine,
            1.5 * dipole * circular * cosine,
            -0.75 * dipole * (1 - cosine**2),
            np.zeros_like(cosine),
        ],
        axis=1,
    )
    return ScatteringTable(
        name,
        wavelength,
        angle,
        elements,
        extinction_cross_section,
        albedo,
        number_density,
        provenance,
    )


def mix(
    tables: Sequence[ScatteringTable], extinctions: Sequence[float], name: str = "mixture"
) -> ScatteringTable:
    """Several kinds of particles in one volume (external mixture).

    Matrices add weighted by scattering coefficient, albedos by extinction coefficient.

    tables: all of one wavelength.
    extinctions: extinction coefficient of each in m^-1, >= 0, not all zero. Their sum is the
        mixture's.

    Returns
    -------
    ScatteringTable
        On the union of all angles. `extinction_cross_section` is the mean over all particles.
    """
    tables, extinctions = list(tables), [float(value) for value in extinctions]
    if not tables or len(tables) != len(extinctions):
        raise InputError(
            f"mixture {name!r}: {len(tables)} tables and {len(extinctions)} extinctions; "
            "expected one extinction a table"
        )
    if not all(math.isfinite(w) and w >= 0 for w in extinctions) or sum(extinctions) == 0:
        raise InputError(
            f"mixture {name!r}, extinctions: {extinctions} is not allowed; expected finite "
            "numbers >= 0, not all zero"
        )
    wavelength = tables[0].wavelength
    for table in tables:
        if not math.isclose(table.wavelength, wavelength, rel_tol=1e-6):
            raise InputError(
                f"mixture {name!r}: {table.name!r} is for {table.wavelength * 1e9:g} nm, "
                f"{tables[0].name!r} for {wavelength * 1e9:g} nm; expected one wavelength"
            )
    extinction = sum(extinctions)
    scattering = [w * table.albedo for w, table in zip(extinctions, tables, strict=True)]
    # particles per m^3 of all kinds
    number = sum(
        w / table.extinction_cross_section for w, table in zip(extinctions, tables, strict=True)
    )
    angle = np.unique(np.concatenate([table.angle for table in tables]))
    elements = np.zeros((len(angle), 6))
    for part, table in zip(scattering, tables, strict=True):
        elements += part / sum(scattering) * table.at(angle)
    parts = ", ".join(
        f"{w:.4g} m^-1 {table.name}" for w, table in zip(extinctions, tables, strict=True)
    )
    return ScatteringTable(
        name,
        wavelength,
        angle,
        elements,
        extinction / number,
        sum(scattering) / extinction,
        number,
        f"mixture of {parts}",
    )


def describe(table: ScatteringTable) -> dict[str, str]:
    """The main properties, as text with units, in the order to print them."""
    return {
        "name": table.name,
        "wavelength": f"{table.wavelength * 1e9:.6g} nm",
        "extinction cross-section": f"{table.extinction_cross_section:.4g} m^2 per particle",
        "single-scattering albedo": f"{table.albedo:.5g}",
        "lidar ratio": f"{table.lidar_ratio:.4g} sr",
        "linear depolarisation ratio at 180 degrees": f"{table.depolarization_ratio:.4g}",
        "asymmetry parameter": f"{table.asymmetry:.4g}",
        "at a number density of": f"{table.number_density:.4g} m^-3",
        "extinction coefficient": f"{table.extinction:.4g} m^-1",
        "backscatter coefficient": f"{table.backscatter:.4g} m^-1 sr^-1",
        "angles": f"{len(table.angle)}, smallest step {np.diff(table.angle).min():.3g} degrees",
        "provenance": table.provenance,
    }
