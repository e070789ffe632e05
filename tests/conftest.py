# ruff: noqa: E402 - numpy and torch count their threads when they are imported
"""What every test may ask for: Mitsuba in a given variant; one thread for each of many processes.

With pytest-xdist (`make test`) every process runs on one thread, and all tests of a file in one
process. Processes share Dr.Jit's kernel cache: it writes a kernel nameless and links it into place.
"""

import gc
import os

BACKEND = os.environ.get("LIDAR_MI_TEST_BACKEND", "llvm")
"""cuda: tests that ask for a variant run in that of CUDA."""
IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
if IS_WORKER:  # before anything imports numpy or torch
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

import hypothesis
import pytest

# the package chooses Dr.Jit's LLVM, so it comes before anything that imports drjit
import lidar_mi  # noqa: F401

# the same cases in every run; `python -m tests.fuzz` draws new ones
hypothesis.settings.register_profile("reproducible", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("reproducible")


def pytest_configure():
    if IS_WORKER:
        import drjit

        # mitsuba.Bitmap reads and writes EXR on a second thread: here it would wait for ever
        drjit.set_thread_count(1)


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

    name = getattr(request, "param", "llvm_ad_mono_polarized").replace("llvm", BACKEND)
    try:
        mi.set_variant(name)
    except ImportError as error:
        pytest.skip(f"{name} cannot run here: {str(error).strip().splitlines()[0]}")
    mi.set_log_level(mi.LogLevel.Error)
    yield name
    gc.collect()
    gc.collect()
