"""The device that renders and retrieves, as an experiment asks for it.

Rendering and retrieval are of two libraries, each of which may or may not compute on a GPU.
"""

from typing import TypeVar

from lidar_mi.errors import InputError
from lidar_mi.rendering.settings import FringeSettings, RenderSettings
from lidar_mi.rendering.variant import has_cuda
from lidar_mi.schema.experiment import Experiment

Settings = TypeVar("Settings", RenderSettings, FringeSettings)

CPU, CUDA = "cpu", "cuda"
_BACKENDS = {CPU: "llvm", CUDA: "cuda"}


def on_its_device(experiment: Experiment) -> Experiment:
    """The experiment with the variants and the retrieval's device that its `device` asks for.

    Variants keep what follows llvm or cuda. Where rendering alone can be on the GPU, `auto` puts
    retrieval on the processor. It is idempotent.

    Raises InputError: CUDA is asked for, and one of both does not compute there.
    """
    device = experiment.device
    if device is None:
        return experiment
    rendering, retrieval = (CPU, CPU) if device == CPU else _devices(device)
    update: dict[str, object] = {
        "device": retrieval if rendering == retrieval else None,
        "render": _of(experiment.render, rendering),
    }
    if experiment.fringes:
        render = _of(experiment.fringes.render, rendering)
        update["doppler"] = experiment.fringes.model_copy(update={"render": render})
    return experiment.model_copy(update=update).read_from(experiment.folder)


def devices_in_words(experiment: Experiment) -> str:
    """Where an experiment that is on its device renders and retrieves, for the log."""
    sections = (
        experiment.imaged_wake and experiment.render,
        experiment.fringes and experiment.fringes.render,
    )
    variants = dict.fromkeys(section.variant for section in sections if section)
    rendering = f"rendering in {' and '.join(variants)}, " if variants else ""
    return f"{rendering}retrieval on {experiment.device or CPU}"


def _devices(device: str) -> tuple[str, str]:
    """Devices of rendering and of retrieval: CUDA's where they are there."""
    # loaded only if a device is set
    import torch

    rendering, retrieval = has_cuda(), torch.cuda.is_available()
    if device == CUDA and not (rendering and retrieval):
        reason = (
            "this torch does not compute with CUDA"
            if rendering
            else "no NVIDIA GPU with a driver that is new enough"
        )
        raise InputError(f"device: cuda cannot be used here ({reason}); expected auto or cpu")
    if retrieval and not rendering:
        return CPU, CPU
    return (CUDA if rendering else CPU), (CUDA if retrieval else CPU)


def _of(render: Settings, device: str) -> Settings:
    """Settings with the variant of a device."""
    _, _, kind = render.variant.partition("_")
    return render.model_copy(update={"variant": f"{_BACKENDS[device]}_{kind}"})
