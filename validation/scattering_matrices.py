"""Scattering matrices against published tables, other solvers, and general laws."""

import math
from functools import cache
from importlib.resources import files

import miepython
import mitsuba as mi
import numpy as np
import rustmatrix
import scatrs

from lidar_mi.atmosphere.scattering.aerosols import AEROSOLS, Aerosol, LogNormal
from lidar_mi.atmosphere.scattering.particle_scattering import make_table
from lidar_mi.atmosphere.scattering.tables import ELEMENTS
from lidar_mi.io.scattering_table import read_table

from . import figures
from .amplitude_matrix import phase_matrix
from .published_spheroids import POLYDISPERSE
from .report import Check, Row, largest

TITLE = "Scattering matrices"
INTRODUCTION = (
    "Tables of randomly oriented spheroids and spheres, made with "
    "[scatrs](https://pypi.org/project/scatrs/): rows (a1, b1, 0, 0), (b1, a2, 0, 0), (0, 0, a3, "
    "b2), (0, 0, -b2, a4), where a1 has the mean one."
)
GREEN = 532e-9


def one_size(radius, index, elongation=1.0):
    """Through all of `make_table`: particles of one radius (within 1e-6 of it)."""
    sizes = LogNormal(radius, 2.0, radius * (1 - 1e-6), radius * (1 + 1e-6))
    return make_table(Aerosol("one", "-", sizes, ((GREEN, index),), elongation), GREEN, nodes=1)


# --- laws -------------------------------------------------------------------------------------


def coherency(elements):
    """Cloude's coherency matrices (N, 4, 4) of scattering matrices in scattering-plane form."""
    a1, a2, a3, a4, b1, b2 = elements.T
    h = np.zeros((len(a1), 4, 4), complex)
    h[:, 0, 0], h[:, 1, 1] = a1 + a2 + a3 + a4, a1 + a2 - a3 - a4
    h[:, 2, 2], h[:, 3, 3] = a1 - a2 + a3 - a4, a1 - a2 - a3 + a4
    h[:, 0, 1] = 2 * b1 - 2j * b2
    h[:, 1, 0] = h[:, 0, 1].conj()
    return h / 4


# --- directions -------------------------------------------------------------------------------


def poles(effort):
    """Density over value next to 0 and 180 degrees, and samples against the tables there."""
    rng = np.random.default_rng(70)
    number, rows = 400_000 * effort.scale, []
    off = np.r_[0, np.geomspace(3e-4, 1, 20)]
    for name in sorted(AEROSOLS):
        path = files("lidar_mi.scenes") / f"aerosol_{name}_532nm.txt"
        angle, a1 = np.loadtxt(str(path))[:, :2].T
        phase = mi.load_dict({"type": "mueller", "table": str(path)})
        incident = rng.standard_normal((number, 3))
        incident /= np.linalg.norm(incident, axis=1, keepdims=True)
        tilt = rng.standard_normal((number, 3)) * np.geomspace(1e-8, 1e-2, number)[:, None]
        ratios = []
        for side in (1, -1):
            scattered = side * incident + tilt
            scattered /= np.linalg.norm(scattered, axis=1, keepdims=True)
            value, density = _evaluate(phase, incident, scattered)
            ratios += [(density / value).min(), (density / value).max()]
        rows.append(
            largest(
                f"{name}: density over value within 10 mrad of 0 and 180 degrees",
                "the sampler draws what is evaluated",
                ratios,
                1.0,
                1e-5,
            )
        )
        edges = np.degrees(off)
        dense = np.union1d(np.union1d(np.linspace(0, 180, 200_001), angle), edges)
        table = np.interp(dense, angle, a1) * np.sin(np.radians(dense))
        below = np.r_[0, np.cumsum((table[1:] + table[:-1]) / 2 * np.diff(dense))]
        expected = number * np.diff(np.interp(edges, dense, below)) / below[-1]
        samples = phase.sample(
            mi.PhaseFunctionContext(),
            _interaction(np.tile([0.0, 0, 1], (number, 1))),
            mi.Float(rng.random(number)),
            mi.Point2f(mi.Float(rng.random(number)), mi.Float(rng.random(number))),
        )[0]
        x, y, z = np.array(samples, float)
        found, _ = np.histogram(np.degrees(np.arctan2(np.hypot(x, y), z)), edges)
        enough = expected > 20
        rows.append(
            Row(
                f"{name}: chi-square over rings from 0.3 mrad to 1 rad",
                "table, linear in angle",
                enough.sum(),
                ((found - expected)[enough] ** 2 / expected[enough]).sum(),
                math.sqrt(2 * enough.sum()),
            )
        )
    return Check(
        "Directions at the poles",
        "Directions whose cosine single precision rounds to 1, and beyond it.",
        tuple(rows),
    )


def _interaction(incident):
    mei = mi.MediumInteraction3f()
    vectors = mi.Vector3f(*(mi.Float(np.ascontiguousarray(axis)) for axis in incident.T))
    mei.wi, mei.sh_frame = -vectors, mi.Frame3f(vectors)
    return mei


def _evaluate(phase, incident, scattered):
    wo = mi.Vector3f(*(mi.Float(np.ascontiguousarray(axis)) for axis in scattered.T))
    value, density = phase.eval_pdf(mi.PhaseFunctionContext(), _interaction(incident), wo)
    return np.array(value[0, 0][0], float), np.array(density, float)


def laws(effort):
    """Inequalities that hold for every sum of particles, for all shipped tables."""
    rows = []
    for name in sorted(AEROSOLS):
        path = files("lidar_mi.scenes") / f"aerosol_{name}_532nm.txt"
        numbers = np.loadtxt(str(path))
        angle, elements = numbers[:, 0], numbers[:, 1:]
        a1, a2, a3, a4, b1, b2 = elements.T
        theta = np.union1d(np.linspace(0, 180, 200_001), angle)
        mean = np.trapezoid(
            np.interp(theta, angle, a1) * np.sin(np.radians(theta)) / 2, np.radians(theta)
        )
        rows.append(
            Row(f"{name}: mean of a1 over the sphere", "normalisation", 1.0, mean, tolerance=1e-3)
        )
        smallest = np.linalg.eigvalsh(coherency(elements))[:, 0] / a1
        rows.append(
            Row(
                f"{name}: most negative eigenvalue of the coherency matrix over a1",
                "0 or more: Cloude 1989; Hovenier & van der Mee 1996",
                0.0,
                min(0.0, smallest.min()),
                tolerance=1e-6,
            )
        )
        ends = [
            (a2[0] - a3[0]) / a1[0],
            b1[0] / a1[0],
            b2[0] / a1[0],
            (a2[-1] + a3[-1]) / a1[-1],
            b1[-1] / a1[-1],
            b2[-1] / a1[-1],
            (a4[-1] - a1[-1] + 2 * a2[-1]) / a1[-1],
        ]
        rows.append(
            largest(
                f"{name}: worst relation between elements at 0 and 180 degrees",
                "van de Hulst 1957, sect. 5.2; Mishchenko & Hovenier 1995",
                ends,
                0.0,
                2e-6,
            )
        )
    return Check(
        "Laws that hold for every collection of particles",
        "Worst values over the 361 angles of each shipped table (seven digits are written). The "
        "coherency matrix of a sum of Mueller-Jones matrices has no negative eigenvalue; this "
        "includes all inequalities between the elements. At 0 degrees a2 = a3, at 180 degrees a2 "
        "= -a3 and a4 = a1 - 2 a2, b1 = b2 = 0 at both. Linear interpolation between the angles "
        "overestimates a1 near a peak: the mean may exceed one by 0.1 % (the plugins normalise "
        "it).",
        tuple(rows),
    )


# --- spheroids --------------------------------------------------------------------------------


def volume_over_area(oblateness):
    """Radius of the sphere of equal volume over that of equal area, oblate spheroid."""
    e = math.sqrt(1 - oblateness**-2)
    area = 2 * math.pi * oblateness ** (2 / 3) * (1 + (1 - e * e) / e * math.atanh(e))
    return math.sqrt(4 * math.pi / area)


@cache
def polydisperse(effective_radius):
    """The case of the published table, with the nodes its author used.

    Power law r^-3 between two radii, Gauss-Legendre in r; radii of equal surface area; wavelength
    0.5 um, index 1.53 + 0.008i, oblate 2 to 1. Cross-sections in um^2, elements at 0, 10 ... 180.
    """
    case = POLYDISPERSE[effective_radius]
    node, weight = np.polynomial.legendre.leggauss(case["nodes"])
    low, high = case["radii"]
    radius = (low + high) / 2 + (high - low) / 2 * node
    weight = weight * radius**-3
    weight /= weight.sum()
    radius = radius * volume_over_area(2.0)
    cosine = np.cos(np.radians(np.arange(0.0, 181.0, 10.0)))
    extinction = scattering = forward = 0.0
    elements = np.zeros((19, 6))
    for r, w in zip(radius, weight, strict=True):
        solved = scatrs.tmatrix.compute(
            2 * math.pi * r / 0.5, 1.53 + 0.008j, 2.0, rtol=1e-4, precision="auto"
        )
        q, f, area = solved.efficiencies(), solved.phase_matrix(cosine), w * math.pi * r**2
        extinction += area * q.q_ext
        scattering += area * q.q_sca
        forward += area * q.q_sca * q.g
        elements += area * q.q_sca * np.stack([f.f11, f.f22, f.f33, f.f44, f.f12, f.f34], axis=1)
    return extinction, scattering, forward / scattering, elements / scattering


def published(effort):
    """Mishchenko's test case of randomly oriented spheroids."""
    reference = "Mishchenko & Travis 1998, test of the code tmd.lp.f"
    rows, drawn = [], effort.folder / "matrix_spheroids.png"
    for radius, case in POLYDISPERSE.items():
        extinction, scattering, asymmetry, elements = polydisperse(radius)
        name = f"r_eff {radius:g} um"
        rows += [
            Row(
                f"{name}: extinction cross-section",
                reference,
                case["extinction"],
                extinction,
                tolerance=1e-3 * case["extinction"],
                unit="um2",
            ),
            Row(
                f"{name}: scattering cross-section",
                reference,
                case["scattering"],
                scattering,
                tolerance=1e-3 * case["scattering"],
                unit="um2",
            ),
            Row(
                f"{name}: asymmetry parameter",
                reference,
                case["asymmetry"],
                asymmetry,
                tolerance=1e-3,
            ),
        ]
        table = np.array(case["elements"])
        for k, element in enumerate(ELEMENTS):
            rows.append(
                largest(
                    f"{name}: {element} over a1, 19 angles",
                    reference,
                    elements[:, k] / elements[:, 0] - table[:, k + 1] / table[:, 1],
                    0.0,
                    3e-3,
                )
                if k
                else largest(
                    f"{name}: a1, relative, 19 angles",
                    reference,
                    elements[:, 0] / table[:, 1] - 1,
                    0.0,
                    3e-3,
                )
            )
    _draw(drawn, *polydisperse(1.0)[3:], np.array(POLYDISPERSE[1.0]["elements"]))
    return Check(
        "Published table of randomly oriented spheroids",
        "Oblate spheroids, 2 to 1, wavelength 0.5 um, index 1.53 + 0.008i, power law r^-3 of "
        "effective variance 0.1, at the same sizes. The published computation was stopped when "
        "cross-sections had converged to 1e-3, and has four decimals: the error of its elements "
        "may be a few 1e-3. It tests the solver that computes the tables, at larger size "
        "parameters (up to 20) than theirs.",
        tuple(rows),
        ((drawn.name, "Elements over a1 (a1 itself top left): line computed, points published."),),
    )


def _draw(place, ours, published_table):
    angle = published_table[:, 0]
    with figures.figure(place, (7, 4), 2, 3, sharex=True) as axes:
        for k, (axis, element) in enumerate(zip(axes.ravel(), ELEMENTS, strict=True)):
            scale = (1, 1) if k == 0 else (ours[:, 0], published_table[:, 1])
            axis.plot(angle, ours[:, k] / scale[0], color=figures.OURS)
            axis.plot(angle, published_table[:, k + 1] / scale[1], ".", color=figures.REFERENCE)
            axis.set_title(element if k == 0 else f"{element} / a1", fontsize=9)
            axis.set_xticks([0, 60, 120, 180])
            if k == 0:
                axis.set_yscale("log")
        for axis in axes[1]:
            axis.set_xlabel("scattering angle, degrees")


def amplitudes(solver, incident, scattered, azimuths, alpha, beta):
    solver.set_geometry((incident, scattered, *azimuths, alpha, beta))
    return solver.get_S()


def orientations(x, index, elongation, angle, order=24):
    """Random orientation by brute force: quadrature over orientations of another solver.

    Extinction cross-section (k = 1) from the optical theorem, and differential cross-sections.
    """
    solver = rustmatrix.Scatterer(
        radius=x, wavelength=2 * math.pi, m=index, axis_ratio=1 / elongation, ddelt=1e-6, ndgs=4
    )
    cosine, weight = np.polynomial.legendre.leggauss(order)
    # the long axis has no direction: half the sphere of orientations is enough
    cosine, weight = cosine[cosine > 0], weight[cosine > 0]
    turns = (np.arange(order) + 0.5) * 360 / order
    elements, forward = np.zeros((len(angle), 6)), 0.0
    for c, w in zip(cosine, weight, strict=True):
        beta = math.degrees(math.acos(c))
        for k, scattered in enumerate(angle):
            s = np.array(
                [amplitudes(solver, 0.0, scattered, (0.0, 0.0), turn, beta) for turn in turns]
            )
            elements[k] += w * phase_matrix(s).mean(axis=0)
            if scattered == 0:
                forward += w * np.trace(s.mean(axis=0)).imag / 2
    return 4 * math.pi * forward, elements


def prolate(effort):
    """Prolate spheroids: rustmatrix against a published amplitude matrix, ours against it."""
    solver = rustmatrix.Scatterer(
        radius=9.63711, wavelength=2 * math.pi, m=1.5 + 0.02j, axis_ratio=0.5, ddelt=1e-6, ndgs=4
    )
    s = np.array(amplitudes(solver, 56.0, 65.0, (114.0, 128.0), 145.0, 52.0))
    paper = "Mishchenko 2000, test of the code ampld.lp.f"
    expected = np.array(
        [[-5.0941 + 24.402j, -1.9425 + 1.9971j], [-1.1521 - 3.0977j, -6.9323 + 24.748j]]
    )
    z = phase_matrix(s[None])[0]
    rows = [
        largest(
            "rustmatrix: amplitude matrix, 4 complex numbers", paper, abs(s - expected), 0.0, 1e-3
        )
    ]
    rows += [
        Row(f"rustmatrix: {name} in a fixed orientation", paper, value, got, tolerance=0.01)
        for name, value, got in zip(
            ("Z11", "Z22", "Z33", "Z44", "Z12", "Z34"),
            (650.3172, 631.6323, 635.2768, 643.1738, -17.9846, -34.7730),
            z,
            strict=True,
        )
    ]
    witness = "rustmatrix, quadrature over orientations"
    for radius, elongation in ((0.169e-6, 3.0), (0.423e-6, 2.0)):
        x, index = 2 * math.pi * radius / GREEN, 1.53 + 0.008j
        table = one_size(radius, index, elongation)
        near = [np.abs(table.angle - a).argmin() for a in (0, 30, 75, 90, 120, 150, 180)]
        angle = table.angle[near]
        extinction, elements = orientations(x, index, elongation, angle)
        got = table.elements[near]
        scale = table.extinction_cross_section * table.albedo / (4 * math.pi)
        scale *= (2 * math.pi / GREEN) ** 2
        name = f"prolate {elongation:g} to 1, x = {x:.2f}"
        expected = extinction / (2 * math.pi / GREEN) ** 2
        rows.append(
            Row(
                f"{name}: extinction cross-section",
                witness,
                1e12 * expected,
                1e12 * table.extinction_cross_section,
                tolerance=1e-5 * 1e12 * expected,
                unit="um2",
            )
        )
        rows.append(
            largest(
                f"{name}: a1, relative, 7 angles",
                witness,
                got[:, 0] * scale / elements[:, 0] - 1,
                0.0,
                1e-4,
            )
        )
        rows += [
            largest(
                f"{name}: {element} over a1, 7 angles",
                witness,
                got[:, k] / got[:, 0],
                elements[:, k] / elements[:, 0],
                1e-4,
            )
            for k, element in enumerate(ELEMENTS)
            if k
        ]
    return Check(
        "Prolate spheroids by another solver",
        "The published amplitude matrix (prolate, 2 to 1, x of equal area 10, index 1.5 + 0.02i) "
        "validates rustmatrix. Its average over 12 x 24 orientations is then compared with "
        "tables of one size, 532 nm, index 1.53 + 0.008i, whose solver has a tolerance of 1e-4.",
        tuple(rows),
    )


# --- spheres and small spheroids ----------------------------------------------------------------


def spheres(effort):
    """Spheres of one size against miepython."""
    rows = []
    for radius, index in ((0.05e-6, 1.75 + 0.44j), (0.4e-6, 1.53 + 0.008j), (2e-6, 1.334 + 1e-9j)):
        table = one_size(radius, index)
        x = 2 * math.pi * radius / GREEN
        # its imaginary parts and its S34 have the opposite sign
        extinction, scattering, backward, asymmetry = miepython.efficiencies_mx(np.conj(index), x)
        s1, s2 = miepython.S1_S2(np.conj(index), x, np.cos(np.radians(table.angle)), norm="4pi")
        expected = np.stack(
            [
                (abs(s1) ** 2 + abs(s2) ** 2) / 2,
                (abs(s1) ** 2 + abs(s2) ** 2) / 2,
                (s2 * s1.conj()).real,
                (s2 * s1.conj()).real,
                (abs(s2) ** 2 - abs(s1) ** 2) / 2,
                -(s2 * s1.conj()).imag,
            ],
            axis=1,
        )
        area = 1e12 * math.pi * radius**2
        name, reference = f"r {radius * 1e6:g} um, index {index:.3g}", "miepython"
        ratio = 4 * math.pi * extinction / backward
        rows += [
            Row(
                f"{name}: extinction cross-section",
                reference,
                extinction * area,
                1e12 * table.extinction_cross_section,
                tolerance=1e-7 * extinction * area,
                unit="um2",
            ),
            Row(
                f"{name}: albedo", reference, scattering / extinction, table.albedo, tolerance=1e-7
            ),
            Row(
                f"{name}: lidar ratio",
                reference,
                ratio,
                table.lidar_ratio,
                tolerance=1e-7 * ratio,
                unit="sr",
            ),
            Row(
                f"{name}: asymmetry parameter",
                reference,
                asymmetry,
                table.asymmetry,
                tolerance=3e-4,
            ),
            largest(
                f"{name}: six elements over a1(0), 361 angles",
                reference,
                table.elements / expected[0, 0],
                expected / expected[0, 0],
                1e-7,
            ),
        ]
    return Check(
        "Spheres",
        "Tables of one size against Lorenz-Mie theory by another program. The mean cosine is "
        "computed with linear interpolation between the angles of the table, with an error of a "
        "few 1e-5.",
        tuple(rows),
    )


def small_spheroids(effort):
    """Spheroids much smaller than the wavelength: closed form."""
    rows = []
    for elongation in (1.6, 3.0):
        index, radius = 1.53 + 0.008j, 2e-9
        e = math.sqrt(1 - elongation**-2)
        along = (1 - e**2) / e**2 * (math.log((1 + e) / (1 - e)) / (2 * e) - 1)
        contrast = index**2 - 1
        a, b = (contrast / (3 + 3 * f * contrast) for f in (along, (1 - along) / 2))
        gamma = abs(a - b) ** 2 / abs((a + 2 * b) / 3) ** 2
        expected = 3 * gamma / (45 + 4 * gamma)
        got = one_size(radius, index, elongation).depolarization_ratio
        rows.append(
            Row(
                f"length over width {elongation:g}: linear depolarisation ratio",
                "Rayleigh limit (Bohren & Huffman 1983, eqs. 5.32-5.33)",
                expected,
                got,
                tolerance=3e-3 * expected,
            )
        )
    return Check(
        "Small spheroids",
        "Radius 2 nm at 532 nm: size parameter 0.024; the closed form neglects terms of the "
        "order of its square.",
        tuple(rows),
    )


def shipped(effort):
    """The shipped tables against their stated particles."""
    table = read_table(str(files("lidar_mi.scenes") / "aerosol_droplets_532nm.txt"))
    area = math.pi * 7 * 8 / 1.5**2  # mean r^2 of r^6 exp(-1.5 r)
    rows = [
        Row(
            "droplets: lidar ratio",
            "18.8 +- 0.8 sr (O'Connor et al. 2004)",
            18.8,
            table.lidar_ratio,
            tolerance=0.8,
            unit="sr",
        ),
        Row(
            "droplets: extinction efficiency",
            "2.05 to 2.20: twice the area and the edge term",
            2.125,
            1e12 * table.extinction_cross_section / area,
            tolerance=0.075,
        ),
    ]
    table = read_table(str(files("lidar_mi.scenes") / "aerosol_continental_532nm.txt"))
    rows.append(
        Row(
            "water-soluble: single-scattering albedo",
            "0.962 at 550 nm (OPAC, Hess et al. 1998)",
            0.962,
            table.albedo,
            tolerance=0.002,
        )
    )
    return Check(
        "Shipped tables against published properties",
        "Cloud C.1 of Deirmendjian 1969 and OPAC's dry water-soluble aerosol.",
        tuple(rows),
    )


CHECKS = (poles, laws, published, prolate, spheres, small_spheroids, shipped)
