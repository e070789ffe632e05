"""What every test may ask for: Mitsuba in a given variant."""

import gc

import pytest

# the package chooses Dr.Jit's LLVM, so it comes before anything that imports drjit
import lidar_mi  # noqa: F401


@pytest.fixture(scope="session")
def _long_lived():
    """Lets the collections below pass over what imports have left: 5 instead of 50 ms."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def variant(request, _long_lived):
    """Mitsuba's variant, ``llvm_ad_mono_polarized`` unless the test parametrises this fixture.

    Skips where the variant cannot run. Scenes hold reference cycles; they are freed afterwards,
    because every live one takes part in Dr.Jit's virtual calls and so changes later kernels.
    """
    import mitsuba as mi

    name = getattr(request, "param", "llvm_ad_mono_polarized")
    try:
        mi.set_variant(name)
    except ImportError as error:
        pytest.skip(f"{name} cannot run here: {str(error).strip().splitlines()[0]}")
    mi.set_log_level(mi.LogLevel.Error)
    yield name
    gc.collect()
    gc.collect()
