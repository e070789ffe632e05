"""Choosing Mitsuba's variant. Detects an error that is no single clear line."""

import drjit as dr
import mitsuba as mi
import pytest

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.rendering.settings import VARIANTS
from lidar_mi.rendering.variant import has_cuda, use_variant


@pytest.mark.slow
@pytest.mark.parametrize("name", [v for v in VARIANTS if v.startswith("llvm")])
def test_every_llvm_variant_can_be_set(variant, name):
    use_variant(name)
    assert mi.variant() == name
    assert mi.load_dict({"type": "rayleigh_polarized"}) is not None


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_magic", "", "LLVM_AD_RGB"])
def test_others_are_refused(variant, name):
    with pytest.raises(InputError) as error:
        use_variant(name)
    reason = ", as it has no arrays of rays" if name == "scalar_rgb" else ""
    assert str(error.value).startswith(
        f"variant: {name!r} is not allowed{reason}; expected one of llvm_ad_"
    )
    assert "\n" not in str(error.value)
    assert mi.variant() == variant


def test_a_variant_that_cannot_run_here_is_reported(variant):
    """Where there is a CUDA device it can, and is set."""
    try:
        lm.use_variant("cuda_ad_mono_polarized")
    except InputError as error:
        assert str(error).startswith(
            "variant: cuda_ad_mono_polarized cannot run here: no NVIDIA GPU"
        )
        assert "\n" not in str(error)
        assert mi.variant() == variant
    else:
        assert mi.variant() == "cuda_ad_mono_polarized"


def test_mitsuba_itself_reports_it_and_takes_the_next(variant):
    try:
        mi.set_variant("cuda_ad_rgb")
    except ImportError as error:
        assert str(error).startswith("variant: cuda_ad_rgb cannot run here: no NVIDIA GPU")
        assert mi.variant() == variant
        mi.set_variant("cuda_ad_rgb", "llvm_ad_rgb")
        assert mi.variant() == "llvm_ad_rgb"
    else:
        assert mi.variant() == "cuda_ad_rgb"


@pytest.mark.parametrize(("there", "serves"), [(False, False), (True, False), (True, True)])
def test_a_gpu_is_one_that_serves(monkeypatch, there, serves):
    """Dr.Jit has it, and Mitsuba's variant can be set; the variant in force stays."""
    mi.set_variant("llvm_ad_rgb")
    tried, set_variant = [], mi.set_variant

    def pretended(name):
        tried.append(name)
        if name.startswith("cuda") and not serves:
            raise ImportError("no OptiX")
        if name.startswith("llvm"):
            set_variant(name)

    monkeypatch.setattr(dr, "has_backend", lambda backend: there and "CUDA" in str(backend))
    monkeypatch.setattr(mi, "set_variant", pretended)
    assert has_cuda() == serves
    assert mi.variant() == "llvm_ad_rgb" and bool(tried) == there
