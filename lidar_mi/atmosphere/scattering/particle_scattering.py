"""Scattering tables of particles, averaged over sizes and orientations.

The tables that ship with the package were made by this module, one command each::

    lidar-mi aerosol spheroids --wavelength '532 nm' -o FILE

Matrices come from ``scatrs`` (an optional library): T-matrix with analytic average over random
orientation for spheroids (Mishchenko 1991, J. Opt. Soc. Am. A 8, 871), Lorenz-Mie for spheres.
The average over sizes is ours: equal steps in the logarithm of the radius.
"""

import math
from collections.abc import Callable
from types import ModuleType

import numpy as np

from lidar_mi.atmosphere.scattering.aerosols import Aerosol, LogNormal, ModifiedGamma, aerosol
from lidar_mi.atmosphere.scattering.tables import ScatteringTable
from lidar_mi.errors import InputError

Notice = Callable[[str, float | None], None]
"""Called with a text that names the work and the fraction of it that is done."""

# Sizes to average over. Backscatter converges last. Spheroids: 48, 64, 96 sizes give lidar ratios
# within 0.7 % of each other (the orientation average smooths the ripple in size); spheres, whose
# ripple is narrow, need thousands: 0.5 % for cloud droplets, below 0.1 % for the others.
SPHEROID_NODES = 128
SPHERE_NODES = 10000


def table_angles() -> np.ndarray:
    """361 angles in degrees, steps from 0.05 near 0 and 180 to just under 1 between.

    Fine enough for cloud droplets: linear interpolation of a1 then integrates to 0.05 % of one.
    """
    # the step grows linearly away from both ends
    fine = np.linspace(0, 180, 180001)
    density = 1 / np.minimum(0.05 + 0.025 * np.minimum(fine, 180 - fine), 1.0)
    count = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    angle = np.interp(np.linspace(0, count[-1], 361), count, fine)
    # three decimals, mirrored so that both ends are resolved equally
    half = np.round(angle[:180], 3)
    return np.concatenate([half, [90.0], 180 - half[::-1]]).round(3)


def make_table(
    particles: Aerosol | str,
    wavelength: float,
    nodes: int | None = None,
    notice: Notice = lambda text, fraction: None,
) -> ScatteringTable:
    """The scattering table of an aerosol: averages over sizes and, for spheroids, orientations.

    particles: an aerosol or the name of one in `AEROSOLS`.
    wavelength: m, in vacuum.
    nodes: sizes to compute; default 128 for spheroids, 10 000 for spheres, with which the lidar
        ratio has converged to 0.5 %.
    notice: called with a text that names the work and the fraction of it that is done.

    Raises InputError: unknown name, no refractive index at this wavelength, ``scatrs`` missing.

    Notes
    -----
    Sizes beyond the aerosol's limits are omitted; the provenance states which fraction of the
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
    scatter = _sphere if sphere else _spheroid
    sizes = particles.sizes
    low, high = math.log(sizes.smallest), math.log(sizes.largest)
    # Equal steps in ln r: as accurate as Gauss's rule for an integrand that vanishes at both ends,
    # and with fewer nodes at the largest sizes, which cost most.
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
        q_ext, q_sca, matrix = scatter(size_parameter, m, particles.elongation, cosine)
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


def _sizes_text(sizes: LogNormal | ModifiedGamma) -> str:
    limits = f"r {sizes.smallest * 1e6:g} to {sizes.largest * 1e6:g} um"
    if isinstance(sizes, LogNormal):
        return f"log-normal r {sizes.median * 1e6:g} um sigma {sizes.sigma:g}, {limits}"
    return (
        f"modified gamma mode {sizes.mode * 1e6:g} um alpha {sizes.alpha:g} "
        f"gamma {sizes.gamma:g}, {limits}"
    )


def _scatrs(module: str) -> ModuleType:
    """A module of the optional library."""
    from importlib import import_module

    try:
        return import_module(f"scatrs.{module}")
    except ModuleNotFoundError:
        raise InputError(
            "making a scattering table needs the library scatrs; "
            "install it with: pip install 'lidar-mi[particles]'"
        ) from None


def _library() -> str:
    from importlib.metadata import version

    return f"scatrs {version('scatrs')}"


def _sphere(x: float, m: complex, _: float, cosine: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Efficiencies and matrix (a1 averages to one) of a sphere of size parameter x."""
    mie = _scatrs("mie")
    q = mie.efficiencies(x, m)
    f = mie.phase_matrix(x, m, cosine)
    return q.q_ext, q.q_sca, np.stack([f.f11, f.f11, f.f33, f.f33, f.f12, f.f34], axis=1)


def _spheroid(
    x: float, m: complex, elongation: float, cosine: np.ndarray
) -> tuple[float, float, np.ndarray]:
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
