"""Setting Mitsuba's variant, with a clear message if it cannot be set."""

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.rendering.settings import VARIANTS
from lidar_mi.system.llvm import require_llvm
from lidar_mi.system.mitsuba_import import NO_CUDA


@checked_arguments
def use_variant(name: str) -> None:
    """Set the Mitsuba variant ``name``, in which the plugins can be used.

    As ``mitsuba.set_variant``, but a variant that this machine or the plugins do not support is
    refused in one line; the variant in force stays.

    Parameters
    ----------
    name : str
        One of the ``llvm_ad_*`` and ``cuda_ad_*`` variants.

    Raises
    ------
    InputError
        Another name, no suitable LLVM, no CUDA device.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> lm.use_variant("llvm_ad_mono")
    >>> lm.use_variant("scalar_rgb")
    Traceback (most recent call last):
        ...
    lidar_mi.errors.InputError: variant: 'scalar_rgb' is not allowed, as it has no arrays of rays; \
expected one of llvm_ad_mono_polarized, llvm_ad_mono, llvm_ad_rgb, llvm_ad_spectral_polarized, \
llvm_ad_spectral, cuda_ad_mono_polarized, cuda_ad_mono, cuda_ad_rgb, cuda_ad_spectral_polarized, \
cuda_ad_spectral
    """
    import mitsuba as mi

    _check_name(name)
    if name.startswith("llvm"):
        require_llvm()
    try:
        mi.set_variant(name)
    except ImportError as error:
        reason = NO_CUDA if name.startswith("cuda") else str(error).strip().splitlines()[0]
        raise InputError(f"variant: {name} cannot run here: {reason}") from None
    # hides Mitsuba's hint that a monochrome film is monochrome
    mi.set_log_level(mi.LogLevel.Error)


def has_cuda() -> bool:
    """Whether ``cuda_*`` variants can run here: an NVIDIA GPU, and a driver that is new enough.

    The variant in force stays.
    """
    import drjit as dr

    # does not import Mitsuba where there is no GPU
    if not dr.has_backend(dr.JitBackend.CUDA):
        return False
    import mitsuba as mi

    before = mi.variant()
    try:
        mi.set_variant("cuda_ad_mono")
    except ImportError:
        return False
    if before is not None:
        mi.set_variant(before)
    return True


def check_variant(name: str) -> None:
    """Refuse a variant as `use_variant` does; Mitsuba is loaded for CUDA alone."""
    if name.startswith("cuda"):
        use_variant(name)
        return
    _check_name(name)
    require_llvm()


def _check_name(name: str) -> None:
    if name not in VARIANTS:
        reason = ", as it has no arrays of rays" if name.startswith("scalar") else ""
        raise InputError(
            f"variant: {name!r} is not allowed{reason}; expected one of {', '.join(VARIANTS)}"
        )
