"""The gated estimator against the analog one in dense air, where analog samples often contribute.

A homogeneous slab from 500 to 600 m, extinction 20 / km, in a vacuum; gates of 10 m. Every pixel of
an image is the same beam, so that the variance is that over pixels, not the stated standard error.
Efficiency = 1 / (variance x time). The gated estimator is meant for one gate: analog samples that
fall into other gates are lost there. With ten gates at once all of them contribute, while a gated
sample contributes to its own gate only, with ten times as many samples.
"""

import mitsuba as mi
import numpy as np

from lidar_mi.rendering.variant import use_variant

from .measure import in_turns
from .report import Comparison, row

CASES = {
    "molecules, field of view 50 mrad": ({"type": "rayleigh_polarized"}, 1.0, 50.0),
    "Henyey-Greenstein 0.7, albedo 0.95, 20 mrad": ({"type": "hg", "g": 0.7}, 0.95, 20.0),
}
GATES = ((500.0, 510.0), (540.0, 550.0), (590.0, 600.0))
ORDERS = 4


def compare(repeats: int = 5, beams: int = 1600) -> Comparison:
    """One gate alone and ten gates at once, orders of scattering up to four."""
    use_variant("llvm_ad_mono_polarized")
    lines = []
    for name, (phase, albedo, fov) in CASES.items():
        for first, last in GATES:
            scene = _scene(phase, albedo, fov, (first, last), 1, beams)
            # enough samples that both take much longer than recording and launching a kernel
            lines += _rows(f"{name}; {first:.0f} to {last:.0f} m alone", scene, repeats, 500, 1500)
        scene = _scene(phase, albedo, fov, (500.0, 600.0), 10, beams)
        lines += _rows(f"{name}; ten gates, the median one", scene, repeats, 200, 500)
    scene = _scene({"type": "rayleigh_polarized"}, 1.0, 5.0, (500.0, 600.0), 500, 400)
    lines += _rows("a profile of 500 gates, 5 mrad; the median gate", scene, repeats, 1000, 1000)
    one = _scene({"type": "rayleigh_polarized"}, 1.0, 5.0, (500.0, 600.0), 1, 400)
    lines += _time_of_gates(scene, one, repeats)
    return Comparison(
        f"Gated against analog estimator in dense air ({ORDERS} orders)",
        "gated",
        "analog",
        tuple(lines),
        ("Relative variance of one sample's contribution; time of one sample: all cores.",),
    )


def _time_of_gates(profile, one, repeats):
    def task(scene):
        return lambda turn: np.array(mi.render(scene, spp=1000, seed=turn))

    found = in_turns({"profile": task(profile), "one": task(one)}, repeats)
    times = {name: [s for s, _ in turns] for name, turns in found.items()}
    return [
        row(
            "as many gated samples in one gate",
            "time, 500 gates (left) and one",
            "s",
            times["profile"],
            times["one"],
            "lower",
            "cost of more gates",
        )
    ]


def _scene(phase, albedo, fov, gates, count, beams):
    width = round(beams**0.5)
    same = np.tile([[1.0, 0.0, 0.0]], (width * width, 1))
    place = mi.ScalarTransform4f().translate([550, 0, 0]).scale([50, 1000, 1000])
    medium = {"type": "homogeneous", "sigma_t": 0.02, "albedo": albedo, "phase": phase}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "gated_volpath", "max_order": ORDERS},
            "sensor": {
                "type": "scanning_lidar",
                "gate_kind": "spherical",
                "gate_start": gates[0],
                "gate_stop": gates[1],
                "gate_count": count,
                "fov_half_mrad": fov,
                "directions": mi.TensorXf(same),
                "laser": {"type": "laser", "beam_cut": 100.0, "divergence_full_mrad": 2.0},
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": width,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            "slab": {
                "type": "cube",
                "to_world": place,
                "bsdf": {"type": "null"},
                "interior": medium,
            },
        }
    )


def _rows(case, scene, repeats, gated_samples, analog_samples):
    analog = mi.load_dict({"type": "gated_volpath", "estimator": "analog", "max_order": ORDERS})
    gates = scene.sensors()[0].gate_count
    sides = {"gated": (scene.integrator(), gated_samples), "analog": (analog, analog_samples)}

    def task(integrator, samples):
        return lambda turn: np.array(
            mi.render(scene, integrator=integrator, spp=samples, seed=turn), float
        ).reshape(-1, gates, 5)[..., 0]

    found = in_turns({name: task(*side) for name, side in sides.items()}, repeats)
    variances, times = {}, {}
    for name, (_, samples) in sides.items():
        images = [image for _, image in found[name]]
        mean = np.mean(images, axis=(0, 1))
        variances[name] = [
            float(np.median(samples * image.var(0, ddof=1) / mean**2)) for image in images
        ]
        times[name] = [s / (samples * len(images[0])) for s, _ in found[name]]
    products = {
        name: [1e9 * v * t for v, t in zip(variances[name], times[name], strict=True)]
        for name in sides
    }
    return [
        row(case, "relative variance", "", variances["gated"], variances["analog"], "lower"),
        row(
            case,
            "time of one sample",
            "ns",
            [1e9 * t for t in times["gated"]],
            [1e9 * t for t in times["analog"]],
            "lower",
        ),
        row(
            case,
            "variance x time",
            "ns",
            products["gated"],
            products["analog"],
            "lower",
            "ratio of efficiencies",
        ),
    ]
