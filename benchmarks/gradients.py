"""Gradients of an image against the image itself: time and memory, order by order.

A slab of the optical depth 1, a grid of voxels, in which light is scattered up to eight times. The
gradient is that of the extinction of all voxels from the Stokes vectors of all beams and gates.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from lidar_mi.rendering.variant import use_variant
from validation import gradient_reference as reference

from .measure import fresh_process, in_turns, peak_memory
from .report import Comparison, row

ORDERS = (1, 2, 4, 8)
KEY = f"{reference.MEDIUM}.sigma_t.data"


def compare(repeats: int = 5, samples: int = 20_000) -> Comparison:
    """Reverse and forward mode against images of as many samples, each order in a process."""
    lines = []
    for order in ORDERS:
        case = f"orders up to {order}, {samples} samples per beam"
        with fresh_process() as process:
            times, memory = process.submit(measured, order, repeats, samples).result()
        for name in ("reverse", "forward"):
            ratios = [a / b for a, b in zip(times[name], times["image"], strict=True)]
            note = f"{np.median(ratios):.2g} times an image"
            what = f"time, {name} mode"
            lines.append(row(case, what, "s", times[name], times["image"], note=note))
        with fresh_process() as process:
            alone = process.submit(image_memory, order, samples).result()
        lines.append(row(case, "memory, reverse mode", "MB", [memory / 1e6], [alone / 1e6]))
    return Comparison(
        f"Gradients ({reference.SIDE**2} beams, {len(reference.GATES)} gates)",
        "gradient",
        "image",
        tuple(lines),
        ("Memory: the largest of a process, with Python and all libraries.",),
    )


def measured(order: int, repeats: int, samples: int) -> tuple[dict[str, list[float]], float]:
    """Seconds of an image and of both modes, turn by turn; the process' memory after the former."""
    loaded, weights = _scene(order)
    parameters, integrator = mi.traverse(loaded), loaded.integrator()
    dr.enable_grad(parameters[KEY])
    parameters.update()

    def image(turn: int) -> None:
        np.array(integrator.render(loaded, spp=samples, seed=turn))

    def reverse(turn: int) -> None:
        integrator.render_backward(loaded, parameters, weights, seed=turn, spp=samples)
        np.array(dr.grad(parameters[KEY]))

    def forward(turn: int) -> None:
        dr.set_grad(parameters[KEY], mi.TensorXf(np.ones((*reference.SHAPE, 1), np.float32)))
        np.array(integrator.render_forward(loaded, parameters, seed=turn, spp=samples))

    reverse(0)
    memory = peak_memory()
    found = in_turns({"image": image, "reverse": reverse, "forward": forward}, repeats)
    return {name: [turn.seconds for turn in turns] for name, turns in found.items()}, memory


def image_memory(order: int, samples: int) -> float:
    """Largest memory of a process that renders the image alone, bytes."""
    loaded, _ = _scene(order)
    np.array(loaded.integrator().render(loaded, spp=samples))
    return peak_memory()


def _scene(order: int):
    """The scene, and gradients of S0 to S3 of all beams and gates."""
    use_variant("llvm_ad_mono_polarized")
    loaded = reference.loaded(reference.extinction(1.0, True))
    integrator = loaded.integrator()
    integrator.max_order, integrator.orders = order, False
    side, gates = reference.SIDE, len(reference.GATES)
    weights = np.zeros((side, side, gates, len(integrator.quantities())), np.float32)
    weights[..., :4] = 1e9
    return loaded, mi.TensorXf(weights.reshape(side, side, -1))
