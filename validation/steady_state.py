"""The steady-state reflectance of a slab: the signal summed over all ranges."""

import math
from importlib.resources import files

import numpy as np
from scipy.special import expn

from .eradiate import reference
from .report import Check, Row, mean_and_error
from .scenes import batches, layer, medium, scene

TITLE = "Steady states"
INTRODUCTION = (
    "A plane-parallel slab of optical thickness 1 reflects the light of a narrow beam within a "
    "cone into a telescope wide enough to receive all of it. The integral over all positions of "
    "a narrow beam is a plane wave, so that the signal summed over all ranges is the "
    "steady-state reflectance of the slab."
)

BATCHES = 32
ORDERS = 8
# a slab of 10 m: the gate ends at paths of 19 mean free paths inside the slab
EXTINCTION, THICKNESS, NEAR = 0.1, 10.0, 500.0


def returned(
    effort,
    estimator,
    phase,
    seed,
    albedo=0.9,
    orders=ORDERS,
    cone=0.2,
    near=NEAR,
    aperture=250.0,
    stop=600.0,
    samples=2_000_000,
):
    """Batches of the light returned by the slab: quantity to (batches,)."""
    shapes = {
        "slab": layer(near, near + THICKNESS, medium(EXTINCTION, phase, albedo), half_width=1e4)
    }
    loaded = scene(
        (near, stop),
        shapes,
        laser={"divergence_full_mrad": 0.0},
        integrator={"estimator": estimator, "max_order": orders, "orders": True},
        gate_kind="spherical",
        fov_half_mrad=1e3 * cone,
        aperture_radius=aperture,
    )
    found = batches(loaded, seed, samples * effort.scale, BATCHES)
    return {name: values[:, 0, 0, 0] for name, values in found.items()}


def compared(name, values, expected, reference, error=0.0, tolerance=0.0):
    got, own = mean_and_error(values)
    return Row(name, reference, expected, got, math.hypot(own, error), tolerance)


def source_functions(albedo, orders, thickness=1.0, cells=1000):
    """Isotropic scattering by order of scattering: Milne's integral equation, (orders, cells).

    S_1 = albedo / 4 pi exp(-t), S_n+1(t) = albedo / 2 times the integral of E_1(|t - t'|) S_n(t'),
    for a plane wave of irradiance 1 at right angles; cells are averages (a Galerkin method with
    exact integrals of the kernel, of second order in the cells' thickness).
    """
    h = thickness / cells
    edge = np.arange(cells + 1) * h
    # twice integrated E_1: E_3
    third = expn(3, edge)
    kernel = np.empty(cells)
    kernel[1:] = (third[:-2] - 2 * third[1:-1] + third[2:]) / h
    kernel[0] = 2 * (1 - (0.5 - third[1]) / h)
    at = np.abs(np.subtract.outer(np.arange(cells), np.arange(cells)))
    matrix = albedo / 2 * kernel[at]
    source = [albedo / (4 * math.pi) * -np.diff(np.exp(-edge)) / h]
    for _ in range(orders - 1):
        source.append(matrix @ source[-1])
    return np.stack(source), edge


def leaving(source, edge, cosine):
    """Power through the surface in directions with a cosine above ``cosine``, by order."""

    # integral of exp(-t / mu) dmu from cosine to 1 is E_2(t) - cosine E_2(t / cosine)
    def outward(t):
        within = -expn(3, t)
        return within + cosine**2 * expn(3, t / cosine) if cosine > 0 else within

    return 2 * math.pi * source @ np.diff(outward(edge))


def isotropic(effort):
    """Order by order against the integral equation."""
    source, edge = source_functions(0.9, ORDERS)
    expected = leaving(source, edge, math.cos(0.2))
    rows = []
    for seed, estimator in enumerate(("gated", "analog")):
        found = returned(effort, estimator, "isotropic", 300 + seed)
        rows += [
            compared(
                f"{estimator}: order {k + 1}",
                found[f"order{k + 1}.S0"],
                value,
                "Milne's integral equation",
                tolerance=2e-5 * value,
            )
            for k, value in enumerate(expected)
        ]
        rows.append(
            compared(
                f"{estimator}: sum",
                found["S0"],
                expected.sum(),
                "Milne's integral equation",
                tolerance=2e-5 * expected.sum(),
            )
        )
    return Check(
        "Isotropic scattering, order by order",
        "Albedo 0.9, a cone of 0.2 rad about the normal. The reference is exact except for the "
        "size of its cells (1e-6).",
        tuple(rows),
    )


def energy(effort):
    """Energy is conserved: conservative slab, nearly all directions."""
    orders, cone = 40, 1.4
    source, edge = source_functions(1.0, orders)
    reflected, in_view = leaving(source, edge, 0.0), leaving(source, edge, math.cos(cone))
    below = leaving(source[:, ::-1], edge, 0.0)
    direct = math.exp(-1)
    grazing = reflected.sum() - in_view.sum()
    rows = [
        Row(
            "the reference: reflected and transmitted",
            "conservation of energy",
            1.0,
            reflected.sum() + below.sum() + direct,
            tolerance=1e-6,
        )
    ]
    for seed, (estimator, samples) in enumerate({"gated": 2_000_000, "analog": 4_000_000}.items()):
        found = returned(
            effort,
            estimator,
            "isotropic",
            310 + seed,
            albedo=1.0,
            orders=orders,
            cone=cone,
            near=100.0,
            aperture=1000.0,
            stop=550.0,
            samples=samples,
        )
        rows.append(
            compared(
                f"{estimator}: rendered reflection + rest",
                found["S0"] + grazing + below.sum() + direct,
                1.0,
                "conservation of energy",
                tolerance=1e-5,
            )
        )
    return Check(
        "Conservation of energy",
        "Albedo 1, isotropic scattering, 40 orders, a field of view of 80 degrees half angle. "
        f"The transmission of the slab ({below.sum() + direct:.4f}) and the reflection beyond 80 "
        f"degrees ({grazing:.4f}) are from the integral equation; with the rendered reflection "
        "the sum must be one.",
        tuple(rows),
    )


def eradiate(effort):
    """Polarised slabs against Eradiate."""
    stored = reference(effort.eradiate, effort.scale)
    phases = {
        "rayleigh": "rayleigh_polarized",
        "isotropic": "isotropic",
        "henyey_greenstein": {"type": "hg", "g": 0.7},
        "spheroids": {
            "type": "mueller",
            "table": str(files("lidar_mi.scenes") / "aerosol_spheroids_532nm.txt"),
        },
    }
    label = f"Eradiate (eradiate-mitsuba {stored['versions']['eradiate-mitsuba']})"
    rows = []
    for number, (name, case) in enumerate(stored["cases"].items()):
        polarised = case["phase"] in ("rayleigh", "spheroids")
        for offset, estimator in enumerate(("gated", "analog")):
            found = returned(
                effort,
                estimator,
                phases[case["phase"]],
                320 + 2 * number + offset,
                orders=case["max_order"],
                albedo=stored["albedo"],
                cone=stored["cone_half_angle"],
            )
            for k, component in enumerate("IQ" if polarised else "I"):
                rows.append(
                    compared(
                        f"{name}, {estimator}: {component}",
                        found[f"S{k}"],
                        case["stokes"][k],
                        label,
                        case["stderr"][k],
                    )
                )
    return Check(
        "Polarised slabs",
        "Albedo 0.9, light polarised along e_h, a cone of 0.2 rad. Unpolarised phase functions "
        "depolarise in lidar-mi but not in Eradiate; for these only I is compared.",
        tuple(rows),
    )


CHECKS = (isotropic, energy, eradiate)
