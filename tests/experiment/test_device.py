"""The device of an experiment. Unit and system tier.

Detects: an experiment without a device that changes, a variant or a retrieval on another device
than is asked for, a GPU that is not there and not refused in one line.
"""

import mitsuba as mi
import pytest
import torch

import lidar_mi as lm
from lidar_mi.encounter.lidar.virtual_lidar import VirtualLidar
from lidar_mi.errors import InputError
from lidar_mi.experiment import device, run
from lidar_mi.experiment.device import devices_in_words, on_its_device
from lidar_mi.rendering.settings import VARIANTS
from lidar_mi.rendering.variant import has_cuda
from lidar_mi.schema.reading import settings
from tests.support.encounters import small_encounter
from tests.support.experiments import check, small


@pytest.fixture
def gpu(monkeypatch):
    """Pretends that rendering and retrieval have a GPU or not."""

    def pretend(rendering, retrieval):
        monkeypatch.setattr(device, "has_cuda", lambda: rendering)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: retrieval)

    return pretend


def asked(name, variant="llvm_ad_mono", rings="llvm_ad_spectral_polarized"):
    data = small() | {"doppler": {"render": {"variant": rings}}, "device": name}
    data["render"] = data["render"] | {"variant": variant}
    return check(data)


def found(experiment):
    return experiment.device, experiment.render.variant, experiment.doppler.render.variant


def test_an_experiment_without_a_device_stays_as_it_is():
    plain = check(small())
    assert plain.device is None and on_its_device(plain) is plain
    assert settings(plain)["device"] is None
    assert devices_in_words(plain) == "rendering in llvm_ad_mono_polarized, retrieval on cpu"


@pytest.mark.parametrize(
    ("name", "rendering", "retrieval", "expected", "backend"),
    [
        ("cpu", True, True, "cpu", "llvm"),
        ("cuda", True, True, "cuda", "cuda"),
        ("auto", True, True, "cuda", "cuda"),
        ("auto", False, False, "cpu", "llvm"),
        # torch without CUDA, as it is installed here; a driver that Dr.Jit does not take
        ("auto", True, False, None, "cuda"),
        ("auto", False, True, "cpu", "llvm"),
    ],
)
def test_variants_and_retrieval_are_on_the_device(
    gpu, name, rendering, retrieval, expected, backend
):
    gpu(rendering, retrieval)
    for before in ("llvm", "cuda"):
        one = on_its_device(asked(name, f"{before}_ad_mono", f"{before}_ad_spectral_polarized"))
        variants = f"{backend}_ad_mono", f"{backend}_ad_spectral_polarized"
        assert found(one) == (expected, *variants) and set(variants) <= set(VARIANTS)
        assert found(on_its_device(one)) == found(one)
        words = f"rendering in {' and '.join(variants)}, retrieval on {expected or 'cpu'}"
        assert devices_in_words(one) == words


@pytest.mark.parametrize(
    ("rendering", "retrieval", "says"),
    [
        (False, False, "no NVIDIA GPU with a driver that is new enough"),
        (False, True, "no NVIDIA GPU with a driver that is new enough"),
        (True, False, "this torch does not compute with CUDA"),
    ],
)
def test_a_gpu_that_is_not_there_is_refused(gpu, rendering, retrieval, says):
    gpu(rendering, retrieval)
    with pytest.raises(InputError) as error:
        run.prepare(asked("cuda"))
    assert str(error.value) == f"device: cuda cannot be used here ({says}); expected auto or cpu"


@pytest.mark.skipif(has_cuda(), reason="CUDA is there")
def test_a_machine_without_a_gpu():
    """In truth: what `auto` finds, and one line for CUDA."""
    assert found(on_its_device(asked("auto"))) == found(on_its_device(asked("cpu")))
    with pytest.raises(InputError, match=r"^device: cuda cannot be used here"):
        VirtualLidar(small_encounter(device="cuda"))


@pytest.fixture
def computed(monkeypatch):
    """Names of the devices that a retrieval is asked to compute on; it stays on the processor."""
    names = []

    def device_of(name):
        names.append(str(name))
        return torch.device("cpu")

    monkeypatch.setattr("lidar_mi.retrieval.checks.device_of", device_of)
    for module in ("lidar_mi.experiment.run", "lidar_mi.encounter.lidar.virtual_lidar"):
        monkeypatch.setattr(f"{module}.on_its_device", lambda experiment: experiment)
    return names


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_all_winds_and_vortices_of_a_run_are_retrieved_there(computed):
    """Bound, winds, texture sweep, budget, noise of the simulation, vortices."""
    data = small() | {"device": "cuda", "detector": {}}
    data["retrieval"] = {"methods": ["cc", "vortex_fit"], "stride": 4, "error_budget": True}
    done = run.run(check(data), notice=lambda *_: None)
    assert computed and set(computed) == {"cuda"}
    assert done.scans[0].attrs["variant"] == mi.variant() == "llvm_ad_mono_polarized"


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_the_wind_of_a_flight_is_retrieved_there(computed):
    retrieval = {"methods": ["variational", "vortex_fit"]}
    lidar = lm.VirtualLidar(small_encounter(device="cuda", retrieval=retrieval))
    expected = None
    for number in range(4):
        estimate = lidar.step(0.1 * number, expected=expected)
        expected = estimate.pair
    assert estimate.wind is not None and set(computed) == {"cuda"}
