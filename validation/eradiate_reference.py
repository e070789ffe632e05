"""Steady states by Eradiate's kernel (eradiate-mitsuba), as numbers in a JSON file.

It replaces mitsuba, so it runs in an environment of its own, without lidar-mi::

    python -m venv eradiate && eradiate/bin/pip install eradiate-mitsuba
    eradiate/bin/python validation/eradiate_reference.py -o validation/eradiate_reference.json

Every case is a plane-parallel slab of optical thickness 1, illuminated at normal incidence by a
plane wave that is polarised along y. The result is the light returned inside a cone about the
surface's normal: power per area of the surface over the irradiance, I and Q about the part of y
perpendicular to the light.

Medium, phase functions, integrator and emitter sampling are Eradiate's; only the emitter is ours,
because its own are unpolarised.
"""

import argparse
import json
import platform
from importlib.metadata import version
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

HERE = Path(__file__).resolve().parent
TABLE = HERE.parent / "scenes" / "aerosol_spheroids_532nm.txt"
ALBEDO, CONE = 0.9, 0.2  # half angle, rad

# name: phase function, highest order
CASES = {
    "rayleigh, order 1": ("rayleigh", 1),
    "rayleigh, orders 1 and 2": ("rayleigh", 2),
    "rayleigh, orders 1 to 8": ("rayleigh", 8),
    "spheroids, order 1": ("spheroids", 1),
    "spheroids, orders 1 and 2": ("spheroids", 2),
    "spheroids, orders 1 to 8": ("spheroids", 8),
    "isotropic, orders 1 to 8": ("isotropic", 8),
    "henyey_greenstein, orders 1 to 8": ("henyey_greenstein", 8),
}


def phase(name: str) -> dict:
    match name:
        case "rayleigh":
            return {"type": "rayleigh_polarized"}
        case "isotropic":
            return {"type": "isotropic"}
        case "henyey_greenstein":
            return {"type": "hg", "g": 0.7}
    return table(np.loadtxt(TABLE))


def table(rows: np.ndarray) -> dict:
    """Columns angle, a1, a2, a3, a4, b1, b2; theirs is linear in the cosine, so nodes are added."""
    # in single precision cosines of smaller angles are equal to 1
    nodes = np.unique(np.cos(np.radians(np.linspace(0, 180, 3601))).astype(np.float32))
    angle = np.degrees(np.arccos(nodes.astype(float)))
    a1, a2, a3, a4, b1, b2 = (np.interp(angle, rows[:, 0], column) for column in rows[:, 1:].T)
    columns = {"nodes": nodes, "m11": a1, "m22": a2, "m33": a3, "m44": a4, "m12": b1, "m34": b2}
    text = {key: ", ".join(f"{v:.12g}" for v in values) for key, values in columns.items()}
    return {"type": "tabphase_polarized", **text}


def polarized_sun():
    class PolarizedSun(mi.Emitter):
        """A plane wave along x, of irradiance 1, fully polarised along y."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection

        def sample_direction(self, it, sample, active=True):
            along = mi.Vector3f(1, 0, 0)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist, ds.d, ds.n = mi.Float(1e4), -along, along
            ds.p, ds.time = it.p - along * 1e4, it.time
            ds.pdf, ds.delta, ds.emitter = mi.Float(1), mi.Bool(True), mi.EmitterPtr(self)
            light = mi.Spectrum(0)
            light[0, 0], light[1, 0] = 1, 1
            turn = mi.mueller.rotate_stokes_basis(
                along, mi.Vector3f(0, 1, 0), mi.mueller.stokes_basis(along)
            )
            return ds, turn @ light

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval_direction(self, it, ds, active=True):
            return mi.Spectrum(0)

        def eval(self, si, active=True):
            return mi.Spectrum(0)

        def flags(self, active=True):
            return self.m_flags

        def is_environment(self):
            return False

        def set_scene(self, scene):
            pass

        def bbox(self):
            return mi.ScalarBoundingBox3f()

    return PolarizedSun


def steady_state(name: str, order: int, samples: int, seed: int) -> dict:
    """Mean and standard error of I and Q."""
    place = mi.ScalarTransform4f().translate([0.5, 0, 0]).scale([0.5, 1000, 1000])
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": ALBEDO, "phase": phase(name)}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sun": {"type": "polarized_sun"},
            "slab": {
                "type": "cube",
                "to_world": place,
                "bsdf": {"type": "null"},
                "interior": medium,
            },
        }
    )
    integrator = mi.load_dict({"type": "volpath", "max_depth": order + 1, "rr_depth": 1000})
    batch, sums, squares, count = 1_000_000, np.zeros(2), np.zeros(2), 0
    for k in range(-(-samples // batch)):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * 10_000 + k, batch)
        cosine = dr.lerp(np.cos(CONE), 1, sampler.next_1d())
        sine, azimuth = dr.safe_sqrt(1 - cosine * cosine), dr.two_pi * sampler.next_1d()
        ray = dr.zeros(mi.RayDifferential3f)
        ray.o = mi.Point3f(-0.5, 0, 0)
        ray.d = mi.Vector3f(cosine, sine * dr.cos(azimuth), sine * dr.sin(azimuth))
        ray.maxt, ray.wavelengths = mi.Float(dr.inf), type(ray.wavelengths)(550.0)
        light, _, _ = integrator.sample(scene, sampler, ray, None, mi.Bool(True))
        onward = -ray.d
        axis = dr.normalize(mi.Vector3f(0, 1, 0) - onward * onward.y)
        light = (
            mi.mueller.rotate_stokes_basis(onward, mi.mueller.stokes_basis(onward), axis) @ light
        )
        weight = 2 * np.pi * (1 - np.cos(CONE)) * np.array(cosine, float)
        stokes = np.stack([np.array(light[row, 0][0], float) for row in (0, 1)]) * weight
        sums, squares, count = sums + stokes.sum(1), squares + (stokes**2).sum(1), count + batch
    mean = sums / count
    error = np.sqrt((squares / count - mean**2) / (count - 1))
    return {"stokes": mean.tolist(), "stderr": error.tolist(), "samples": count}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=HERE / "eradiate_reference.json")
    parser.add_argument(
        "-n", "--samples", "--photons", type=int, default=8_000_000, help="of every case"
    )
    options = parser.parse_args()
    mi.set_variant("llvm_ad_spectral_polarized")
    mi.set_log_level(mi.LogLevel.Error)
    mi.register_emitter("polarized_sun", polarized_sun())
    packages = ("eradiate-mitsuba", "drjit", "numpy")
    found = {
        "command": f"python validation/eradiate_reference.py -n {options.samples}",
        "versions": {name: version(name) for name in packages}
        | {"python": platform.python_version()},
        "variant": mi.variant(),
        "optical_thickness": 1.0,
        "albedo": ALBEDO,
        "cone_half_angle": CONE,
        "cases": {
            name: {"phase": kind, "max_order": order}
            | steady_state(kind, order, options.samples, seed)
            for seed, (name, (kind, order)) in enumerate(CASES.items())
        },
    }
    options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
