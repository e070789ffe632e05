"""Single scattering against closed forms."""

import itertools
import math
from importlib.resources import files

import mitsuba as mi
import numpy as np

from . import extinction_fields, figures
from .report import Check, Row, spread
from .scenes import ENVIRONMENT, box, grid, layer, medium, render, scene, secants

TITLE = "Single scattering"
INTRODUCTION = (
    "The lidar equation, integrated over each gate by Gauss-Legendre quadrature, for beams inside "
    "the field of view. It neglects the finite beam and telescope, which are 1e-6 of the signal "
    "at 500 m; ranges in single precision contribute about as much."
)
EQUATION = "lidar equation (Weitkamp 2005, chap. 1)"

AREA = math.pi * 0.5**2
RAYLEIGH = 3 / (8 * math.pi)
TRUNCATION = 1e-5
SCAN = {
    "azimuth_min_deg": -6.2,
    "azimuth_max_deg": 6.2,
    "elevation_min_deg": -3.9,
    "elevation_max_deg": 3.9,
}


def equation(edges, extinction, depth, breaks=(), backscatter=RAYLEIGH):
    """Received over emitted energy of gates, the integral of A p sigma exp(-2 tau) / R^2.

    Parameters
    ----------
    edges : (gates + 1, ...) array
        Ranges along each beam, m.
    extinction, depth : functions
        Scattering coefficient (1 / m) and optical depth of a range.
    breaks : sequence of arrays
        Ranges where the extinction jumps, ascending.
    backscatter : float
        Phase function at 180 degrees, per steradian.
    """
    total = 0.0
    for begin, end in itertools.pairwise([-np.inf, *breaks, np.inf]):
        low, high = (np.clip(e, begin, end) for e in (edges[:-1], edges[1:]))
        for node, weight in zip(*np.polynomial.legendre.leggauss(12), strict=True):
            r = (low + high) / 2 + (high - low) / 2 * node
            signal = AREA * backscatter * extinction(r) / r**2 * np.exp(-2 * depth(r))
            total = total + weight * (high - low) / 2 * signal
    return total


def layered(edges, steps, secant=1.0):
    """`equation` for layers across x, (start, extinction) each; all paths grow by ``secant``."""
    starts, values = (np.array(v, float) for v in zip(*steps, strict=True))
    depths = np.concatenate([[0], np.cumsum(np.diff(starts) * values[:-1])])

    def of(r):
        return np.searchsorted(starts, r / secant, side="right") - 1

    return equation(
        np.multiply.outer(np.asarray(edges, float), secant),
        lambda r: values[of(r)],
        lambda r: secant * (depths[of(r)] + (r / secant - starts[of(r)]) * values[of(r)]),
        [start * np.asarray(secant) for start in starts[1:]],
    )


def compared(name, found, truth, bias=TRUNCATION):
    """Two rows: the sum over all beams and gates, and the z-scores of each."""
    value, error = found["S0"], found["S0_stderr"]
    total = Row(
        f"{name}: rendered over expected",
        EQUATION,
        1.0,
        value.sum() / truth.sum(),
        math.sqrt((error**2).sum()) / truth.sum(),
        bias,
    )
    return [total, spread(name, EQUATION, (value - truth) / error)]


def scan_of_a_slab(effort):
    """Beams up to 7 degrees off the axis, planar gates, the telescope in the environment."""
    size, rows = (73, 47), []
    layers = [(0, 1e-4), (490, 2e-2)]
    media = {
        "homogeneous slab": medium(2e-2),
        "slab of a constant grid": grid(np.full((3, 4, 5), 2e-2), (490, -65, -45), (512, 65, 45)),
    }
    for seed, (name, slab) in enumerate(media.items()):
        shape = box((490, -65, -45), (512, 65, 45), slab, ENVIRONMENT)
        loaded = scene((500, 502.5), {"slab": shape}, size, environment=medium(1e-4), **SCAN)
        found = render(loaded, 10 + seed, 4096 * effort.scale)
        rows += compared(name, found, layered([500, 502.5], layers, secants(loaded, size)))
    return Check(
        "Scan of a slab in an environment",
        f"{size[0]} x {size[1]} beams over 12.4 by 7.8 degrees; slab of 0.02 / m from 490 m, "
        "environment of 0.0001 / m from the telescope on, gate from 500 to 502.5 m.",
        tuple(rows),
    )


def profile_through_layers(effort):
    """Many gates, boundaries of media inside them."""
    steps = [(0, 1e-3), (300, 5e-3), (350, 2e-2), (416.25, 5e-3), (450, 1e-3)]
    edges = np.linspace(250, 500, 101)
    outer = {"type": "ref", "id": "outer"}
    shapes = {
        "slab": layer(300, 450, medium(5e-3) | {"id": "outer"}, ENVIRONMENT),
        "core": layer(350, 416.25, medium(2e-2), outer, 1000.0),
    }
    loaded = scene(
        (edges[0], edges[-1]),
        shapes,
        environment=medium(1e-3),
        gate_count=len(edges) - 1,
        gate_kind="spherical",
    )
    found = render(loaded, 20, 400_000 * effort.scale)
    truth = layered(edges, steps)[:, None, None]
    place = effort.folder / "lidar_equation_profile.png"
    middle = (edges[1:] + edges[:-1]) / 2
    with figures.figure(place, (7, 4), 2, height_ratios=[2, 1], sharex=True) as (top, bottom):
        top.semilogy(middle, truth.ravel(), color=figures.REFERENCE, label="lidar equation")
        top.plot(middle, found["S0"].ravel(), ".", color=figures.OURS, label="rendered")
        top.set_ylabel("received / emitted energy")
        top.legend(frameon=False)
        bottom.axhspan(-2, 2, color="0.92")
        bottom.plot(
            middle, ((found["S0"] - truth) / found["S0_stderr"]).ravel(), ".", color=figures.OURS
        )
        bottom.set(xlabel="range, m", ylabel="deviation, sigmas", ylim=(-5, 5))
    return Check(
        "Profile through nested layers",
        "100 gates of 2.5 m; a slab of 0.005 / m from 300 to 450 m around one of 0.02 / m from "
        "350 to 416.25 m (inside a gate), environment of 0.001 / m.",
        tuple(compared("100 gates", found, truth)),
        ((place.name, "Signal of every gate, and its difference from the lidar equation."),),
    )


def surfaces_that_touch(effort):
    """Slabs one behind the other: faces at one place, nearly, nested, with a shape elsewhere."""
    edges = np.linspace(400, 520, 25)
    thin, dense = medium(2e-3), medium(6e-3)
    sphere = {"type": "sphere", "center": [0, 4000, 0], "bsdf": {"type": "null"}, "interior": thin}
    near, far = layer(390, 450, thin), layer(450, 530, dense, half_width=1800.0)
    cases = {
        "touching": {"near": near, "far": far},
        "a gap of 0.01 mm": {"near": near, "far": layer(450.00001, 530, dense)},
        "touching, a sphere elsewhere": {"near": near, "far": far, "sphere": sphere},
        "nested, a face shared": {"near": layer(390, 530, thin), "far": far},
        "overlapping by 10 m": {"near": layer(390, 460, thin, half_width=2200.0), "far": far},
    }
    truth = layered(edges, [(0, 0.0), (390, 2e-3), (450, 6e-3)])[:, None, None]
    rows = []
    for seed, (name, shapes) in enumerate(cases.items()):
        loaded = scene(
            (edges[0], edges[-1]), shapes, gate_count=len(edges) - 1, gate_kind="spherical"
        )
        found = render(loaded, 60 + seed, 50_000 * effort.scale)
        # the beam's width smears the faces over 1e-6 of the range
        rows += compared(name, found, truth, 2 * TRUNCATION)
    return Check(
        "Surfaces that touch",
        "24 gates of 5 m through slabs of 0.002 / m from 390 m and of 0.006 / m from 450 m. The "
        "smaller one's medium holds where they overlap.",
        tuple(rows),
    )


def valley_of_extinction(effort):
    """A grid that is linear between cell centres, with a minimum of the extinction."""
    size, edges = (9, 7), np.linspace(500, 540, 5)
    centres = 400 + 10 * (np.arange(20) + 0.5)
    values = 1e-3 * (1 + np.abs(centres - 465) / 10)
    low, high = (400, -90, -90), (600, 90, 90)
    rows = []
    for name, factor in (("majorant as it is", 1.0), ("majorant raised 20 times", 20.0)):
        filled = np.broadcast_to(values, (24, 24, 20)).copy()
        filled[0, 0, 0] = factor * values.max()
        shape = box(low, high, grid(filled, low, high))
        loaded = scene((500, 540), {"slab": shape}, size, gate_count=4, **SCAN)
        found = render(loaded, 30 + int(factor), 40_000 * effort.scale)
        secant = secants(loaded, size)

        def depth(r, secant=secant):
            # 7e-3 in the outermost half cell, down to 1e-3 at 465 m and up again
            x = r / secant - 465
            return secant * 1e-3 * (5 * 7 + 60 * 4 + x + x**2 / 20)

        truth = equation(
            np.multiply.outer(edges, secant),
            lambda r, s=secant: 1e-3 * (1 + (r / s - 465) / 10),
            depth,
        )
        rows += compared(name, found, truth, 5e-5)
    return Check(
        "Valley of extinction on a grid",
        "Extinction decreases from 0.007 to 0.001 / m at 465 m and increases again. Four gates "
        "are behind this minimum. One voxel that no beam crosses raises the majorant, the upper "
        "bound of the extinction from which free paths are drawn.",
        tuple(rows),
    )


def random_fields(effort):
    """Layers, spikes, voids and contrasts over decades anywhere on the path."""
    z = []
    for seed in range(50 * effort.scale):
        made = extinction_fields.field(5000 + seed)
        z.append(extinction_fields.deviation(made, 8192, seed)[0])
    reference = "lidar equation by quadrature, `validation/extinction_fields.py`"
    within = float(np.mean(np.abs(z) < 5))
    return Check(
        "Random extinction fields",
        "Grids of up to 200 x 6 x 6 cells with layers, one bright cell, voids, steps or contrasts "
        "over five decades; nearest or linear between cells, repeated, mirrored or clamped, at "
        "rest or moving, turned, in an environment or none; gates in them and behind them; one-way "
        "optical depths up to 2.5. 8192 samples each.",
        (
            Row("fraction within five standard errors", reference, 1.0, within, tolerance=1e-9),
            spread("random fields", reference, z),
        ),
    )


def _table_of_spheroids():
    return np.loadtxt(str(files("lidar_mi.scenes") / "aerosol_spheroids_532nm.txt"))


def phase_functions(effort):
    """Backscatter coefficients of every kind of scatterer."""
    table = _table_of_spheroids()
    theta = np.radians(np.linspace(0, 180, 400_001))
    a1 = np.interp(np.degrees(theta), table[:, 0], table[:, 1])
    norm = 2 * math.pi * np.trapezoid(a1 * np.sin(theta), theta)
    delta = 0.028
    dipole = (1 - delta) / (1 + delta / 2)
    cases = {
        "isotropic": ({"type": "isotropic"}, 1 / (4 * math.pi), "1 / 4 pi"),
        "Henyey-Greenstein g = 0.7": (
            {"type": "hg", "g": 0.7},
            0.51 / (4 * math.pi * 1.7**3),
            "Henyey & Greenstein 1941",
        ),
        "Rayleigh, depolarisation factor 0.028": (
            {"type": "rayleigh_polarized", "depolarization": delta},
            (1.5 * dipole + 1 - dipole) / (4 * math.pi),
            "Hansen & Travis 1974, eq. 2.15",
        ),
        "spheroids (table)": (
            {"type": "mueller", "table": mi.TensorXf(table)},
            a1[-1] / norm,
            "the table, by the trapezoidal rule",
        ),
    }
    rows = []
    for name, (phase, expected, reference) in cases.items():
        loaded = scene((500, 520), {"slab": layer(500, 520, medium(1e-2, phase))})
        found = render(loaded, 40 + len(rows), 200_000 * effort.scale)
        unit = layered([500, 520], [(0, 1e-12), (500, 1e-2)])[0] / RAYLEIGH
        rows.append(
            Row(
                f"{name}: phase function at 180 degrees",
                reference,
                expected,
                found["S0"].item() / unit,
                found["S0_stderr"].item() / unit,
                2e-5 * expected,
                "1/sr",
            )
        )
    return Check(
        "Phase functions in backscatter",
        "Rendered signal over the geometric factor of the lidar equation: the contribution of "
        "the scatterer.",
        tuple(rows),
    )


def depolarisation(effort):
    """Depolarisation ratios of backscatter, linear and circular."""
    rows = []
    laser = {"stokes": "1, 1, 0, 0", "divergence_full_mrad": 0.0}
    for delta in (0.00713, 0.0284, 0.3):
        phase = {"type": "rayleigh_polarized", "depolarization": delta}
        linear = delta / (2 - delta)
        for kind, stokes, expected in (
            ("linear", "1, 1, 0, 0", linear),
            ("circular", "1, 0, 0, 1", 2 * linear / (1 - linear)),
        ):
            shapes = {"slab": layer(500, 520, medium(1e-3, phase))}
            loaded = scene((500, 520), shapes, laser=laser | {"stokes": stokes})
            found = render(loaded, 50, 2000)
            polarised = found["S1"] if kind == "linear" else -found["S3"]
            got = (found["S0"] - polarised) / (found["S0"] + polarised)
            rows.append(
                Row(
                    f"{kind} ratio, depolarisation factor {delta:g}",
                    "D / (2 - D), circular 2 d / (1 - d) of the linear one (Mishchenko & "
                    "Hovenier 1995)",
                    expected,
                    got.item(),
                    tolerance=1e-5,
                )
            )
    table = _table_of_spheroids()
    phase = {"type": "mueller", "table": mi.TensorXf(table)}
    loaded = scene((500, 520), {"slab": layer(500, 520, medium(1e-3, phase))}, laser=laser)
    found = render(loaded, 51, 2000)
    got = (found["S0"] - found["S1"]) / (found["S0"] + found["S1"])
    a1, a2 = table[-1, 1:3]
    rows.append(
        Row(
            "linear ratio of the spheroids",
            "(a1 - a2) / (a1 + a2) of the last line of the table",
            (a1 - a2) / (a1 + a2),
            got.item(),
            tolerance=1e-5,
        )
    )
    return Check(
        "Depolarisation in backscatter",
        "I and Q of a Monte Carlo sample are fully correlated here, so that the ratio has no "
        "noise. The finite telescope receives light up to 1 mrad off 180 degrees; the effect is "
        "of second order in this angle.",
        tuple(rows),
    )


def diffuse_targets(effort):
    """Ground and walls: rho / pi cos A / R^2 T^2."""
    rho, far, extinction, aperture = 0.3, 200.0, 2e-3, 0.1
    rows = []
    for number, (tilt, estimator) in enumerate(
        itertools.product((0.0, 40.0, 75.0), ("gated", "analog"))
    ):
        place = mi.ScalarTransform4f().translate([far, 0.0, 0.0]).rotate([0, 0, 1], tilt)
        wall = {
            "type": "rectangle",
            "to_world": place.rotate([0, 1, 0], -90.0).scale(20.0),
            "bsdf": {"type": "diffuse", "reflectance": rho},
        }
        loaded = scene(
            (190, 210),
            {"wall": wall},
            laser={"beam_radius": 1e-6, "divergence_full_mrad": 0.0},
            integrator={"estimator": estimator},
            environment=medium(extinction, "isotropic", 0.0),
            gate_kind="spherical",
            aperture_radius=aperture,
        )
        found = render(loaded, 70 + number, 100_000 * effort.scale)
        area = math.pi * aperture**2
        expected = rho / math.pi * math.cos(math.radians(tilt)) * area / far**2
        expected *= math.exp(-2 * extinction * far)
        got, error = (found[name].item() / expected for name in ("S0", "S0_stderr"))
        # gated samples have all the same contribution but for the place in the telescope
        error = 0.0 if estimator == "gated" else error
        label = f"{estimator}, incidence of {tilt:g} degrees: rendered over expected"
        rows.append(Row(label, "rho / pi cos A / R^2 T^2", 1.0, got, error, 1e-4))
    return Check(
        "Diffuse targets",
        f"A Lambertian wall of reflectance {rho} at {far:g} m, behind air that absorbs "
        f"{extinction:g} / m.",
        tuple(rows),
    )


CHECKS = (
    scan_of_a_slab,
    profile_through_layers,
    surfaces_that_touch,
    valley_of_extinction,
    random_fields,
    phase_functions,
    depolarisation,
    diffuse_targets,
)
