"""What this machine can run, and the commands that repair the rest.

Whatever could crash, hang or be aborted by LLVM is tried in a separate process.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from lidar_mi.system import llvm
from lidar_mi.system.memory import GIB, available_memory, machine_memory
from lidar_mi.tables import Table, Tabular

LLVM_VARIANTS = (
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "llvm_ad_mono_polarized",
    "llvm_ad_spectral_polarized",
)
CUDA_VARIANT = "cuda_ad_mono_polarized"
DEFAULT_VARIANT = "llvm_ad_mono_polarized"

MEMORY_NEEDED = 2 * GIB  # more than a full scan with all its kernels needs
DISK_NEEDED = 1 * GIB

# Random numbers, a recorded loop and a scatter with a known sum, then a render: the first shows
# that the backend computes, the second compiles the kind of kernel that LLVM 14 to 16 abort on.
_TRY_VARIANT = """
import sys
from lidar_mi.system.llvm import select_llvm
select_llvm()
import mitsuba as mi
mi.set_variant(sys.argv[1])
import drjit as dr
count = mi.UInt32(0)
step, count = dr.while_loop(
    (dr.arange(mi.UInt32, 100), count), lambda i, n: i < 100, lambda i, n: (i + 1, n + 1))
total = dr.zeros(mi.UInt32)
dr.scatter_add(total, count, mi.UInt32(0))
assert total[0] == 5050, f'sum of 1..100 came out as {total[0]}'
scene = mi.load_dict({
    'type': 'scene',
    'integrator': {'type': 'path', 'max_depth': 3},
    'emitter': {'type': 'constant'},
    'shape': {'type': 'sphere', 'center': [0, 0, 5], 'bsdf': {'type': 'roughplastic'}},
    'sensor': {'type': 'perspective', 'film': {'type': 'hdrfilm', 'width': 4, 'height': 4}}})
image = mi.render(scene, spp=4)
assert dr.all(dr.isfinite(image), axis=None), 'the render holds NaN or infinity'
"""

_TRY_PLUGINS = """
import sys
import lidar_mi
import mitsuba as mi
mi.set_variant(sys.argv[1])
mi.load_dict({'type': 'rayleigh_polarized'})
"""

_TRY_TORCH = """
import torch
build = f'CUDA {torch.version.cuda}' if torch.version.cuda else 'CPU'
devices = f', {torch.cuda.device_count()} CUDA device(s)' if torch.cuda.is_available() else ''
assert torch.fft.irfft2(torch.fft.rfft2(torch.ones(8, 8))).sum().item() == 64
print(f'{build} build, {torch.get_num_threads()} threads{devices}')
"""

_TRY_DEVICE = """
import torch
from lidar_mi.rendering.variant import has_cuda
where = {True: 'the GPU', False: 'the processor'}
rendering, retrieval = has_cuda(), torch.cuda.is_available()
print(f'auto renders on {where[rendering]}, retrieves on {where[rendering and retrieval]}')
"""

# The embedded sample through h5netcdf, which installs without the HDF5 reader that it needs.
_TRY_NETCDF = """
from importlib import resources
import xarray
with resources.as_file(resources.files('lidar_mi.scenes') / 'wake_slab_40s.nc') as path:
    with xarray.open_dataset(path, engine='h5netcdf') as wake:
        shape = wake.v.load().shape
print(f'the embedded wake reads: v is {shape}')
"""


@dataclass(frozen=True)
class Check:
    """One line of the report.

    ``ok`` is True or False, or None where something optional is absent; ``remedy`` is what to type,
    empty where nothing is wrong.
    """

    name: str
    ok: bool | None
    detail: str
    remedy: str = ""


@dataclass(frozen=True, repr=False)
class Checkup(Tabular):
    """The checks of this machine."""

    checks: tuple[Check, ...]

    @property
    def failed(self) -> list[Check]:
        """Checks of something that is needed and does not work."""
        return [check for check in self.checks if check.ok is False]

    def tables(self) -> list[Table]:
        """A line for each check, then what to type."""
        marks = {True: "ok", False: "FAILED", None: "-"}
        rows = [(marks[c.ok], c.name, c.detail) for c in self.checks]
        verdict = f"{len(self.failed)} of {len(rows)} checks failed"
        tables = [Table(verdict if self.failed else "all checks passed", rows)]
        remedies = [
            ("to repair" if c.ok is False else "optional", c.name, c.remedy)
            for c in self.checks
            if c.remedy
        ]
        return [*tables, Table("what to type", remedies)] if remedies else tables


def doctor() -> Checkup:
    """Examine this machine: versions, LLVM, every Mitsuba variant, plugins, torch, resources.

    Returns
    -------
    Checkup
        Shows itself as a table. ``failed`` is empty where everything that is needed works.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> checkup = lm.doctor()  # doctest: +SKIP
    >>> checkup.failed         # doctest: +SKIP
    []
    """
    trials: list[Callable[[], Check]] = [
        *(partial(_check_variant, variant) for variant in LLVM_VARIANTS),
        _check_cuda,
        _check_plugins,
        _check_netcdf,
        _check_torch,
        _check_device,
    ]
    checks = [_check_python(), *_check_dependencies(), _check_llvm()]
    with ThreadPoolExecutor(max_workers=_cores()) as pool:
        checks += pool.map(lambda trial: trial(), trials)
    checks.append(Check("cores", True, f"{_cores()} usable of {os.cpu_count()}"))
    checks += [_check_memory(), _check_disk(), _check_exr_tools()]
    return Checkup(tuple(checks))


def _check_python() -> Check:
    version = ".".join(map(str, sys.version_info[:3]))
    try:
        required = metadata.metadata("lidar-mi")["Requires-Python"]
    except metadata.PackageNotFoundError:
        return Check("Python", False, f"{version}; lidar-mi is not installed", "make setup")
    ok = SpecifierSet(required).contains(version, prereleases=True)
    remedy = "" if ok else "PYTHON=python3.12 make setup"
    return Check("Python", ok, f"{version} (needs {required}) in {sys.prefix}", remedy)


def _check_dependencies() -> list[Check]:
    try:
        lines = metadata.requires("lidar-mi") or []
    except metadata.PackageNotFoundError:
        return []  # the line about Python states it
    requirements = [Requirement(line) for line in lines]
    return [_check_dependency(r) for r in requirements if r.marker is None or r.marker.evaluate()]


def _check_dependency(requirement: Requirement) -> Check:
    needs = f"needs {requirement.specifier}"
    remedy = f'{sys.executable} -m pip install "{requirement}"'
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return Check(requirement.name, False, f"not installed ({needs})", remedy)
    ok = requirement.specifier.contains(version, prereleases=True)
    return Check(requirement.name, ok, f"{version} ({needs})", "" if ok else remedy)


def _check_llvm() -> Check:
    name = "LLVM library"
    chosen = llvm.select_llvm()
    if problem := llvm.check_llvm():
        return Check(name, False, problem, _install_llvm())
    if chosen is None:
        return Check(name, True, "left to Dr.Jit on this system")
    if os.path.realpath(chosen) == _best_llvm():
        versions = ", ".join(str(version) for _, version in llvm.find_llvm())
        return Check(name, True, f"{chosen}, the newest (LLVM {versions} found)")
    return Check(name, True, f"{chosen}, as {llvm.VARIABLE} says")


def _best_llvm() -> str | None:
    """The library that lidar-mi takes when the user has set none."""
    chosen = llvm.select_llvm(environ={})
    return None if chosen == llvm.NOT_FOUND else chosen


def _install_llvm() -> str:
    chosen, best = os.environ.get(llvm.VARIABLE, ""), _best_llvm()
    if chosen in ("", llvm.NOT_FOUND) or os.path.realpath(chosen) == best:
        return _install_command()
    return f"unset {llvm.VARIABLE}" + ("" if best else f"; {_install_command()}")


def _install_command() -> str:
    for tool, command in (
        ("apt-get", "sudo apt install libllvm19"),
        ("dnf", "sudo dnf install llvm-libs"),
        ("brew", "brew install llvm"),
    ):
        if shutil.which(tool):
            return command
    return "conda install -c conda-forge libllvm19"


def _attempt(code: str, *arguments: str, timeout: float = 180.0) -> tuple[bool, str]:
    """Run code in a fresh interpreter: whether it succeeded, and its last line."""
    # -P: a file named like a module in the working folder must not be imported instead of it.
    command = [sys.executable, "-P", "-c", code, *arguments]
    try:
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, errors="replace", timeout=timeout
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {timeout:.0f} s"
    if done.returncode == 0:
        return True, _last_line(done.stdout)
    if done.returncode < 0:
        return False, f"the process was ended by {signal.Signals(-done.returncode).name}"
    return False, _last_line(done.stderr) or f"exit code {done.returncode}"


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip()[:300] if lines else ""


def _check_variant(variant: str) -> Check:
    ok, message = _attempt(_TRY_VARIANT, variant)
    if ok:
        return Check(variant, True, "computes and renders")
    remedy = _install_llvm() if llvm.check_llvm() else _reinstall("mitsuba", "drjit")
    return Check(variant, False, message, remedy)


def _check_cuda() -> Check:
    ok, message = _attempt(_TRY_VARIANT, CUDA_VARIANT)
    if ok:
        return Check(CUDA_VARIANT, True, "computes and renders")
    if shutil.which("nvidia-smi") is None and not Path("/dev/nvidiactl").exists():
        return Check(CUDA_VARIANT, None, "no NVIDIA GPU here; llvm_* variants do everything")
    remedy = "nvidia-smi (a driver as new as Dr.Jit and OptiX ask for must be running)"
    return Check(CUDA_VARIANT, None, f"a GPU is here but does not serve: {message}", remedy)


def _check_plugins() -> Check:
    name = "plugins"
    ok, message = _attempt(_TRY_PLUGINS, DEFAULT_VARIANT)
    if ok:
        return Check(name, True, f"registered in {DEFAULT_VARIANT}")
    remedy = _install_llvm() if llvm.check_llvm() else _reinstall("lidar-mi")
    return Check(name, False, message, remedy)


def _reinstall(*packages: str) -> str:
    if packages == ("lidar-mi",):
        return f"{sys.executable} -m pip install -e .   (in the project's folder)"
    return f"{sys.executable} -m pip install --force-reinstall --no-deps " + " ".join(
        f'"{requirement}"'
        for requirement in map(Requirement, metadata.requires("lidar-mi") or [])
        if requirement.name in packages
    )


def _check_torch() -> Check:
    ok, message = _attempt(_TRY_TORCH)
    return Check("torch computes", ok, message, "" if ok else _reinstall("torch"))


def _check_device() -> Check:
    ok, message = _attempt(_TRY_DEVICE)
    return Check("device", ok, message, "" if ok else _reinstall("torch", "drjit"))


def _check_netcdf() -> Check:
    ok, message = _attempt(_TRY_NETCDF)
    remedy = "" if ok else f"{sys.executable} -m pip install h5py h5netcdf"
    return Check("NetCDF files", ok, message, remedy)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _check_memory() -> Check:
    total, free = machine_memory(), available_memory()
    ok = free >= MEMORY_NEEDED
    detail = f"{free / GIB:.1f} GiB free of {total / GIB:.1f} GiB (needs {MEMORY_NEEDED // GIB})"
    remedy = "" if ok else "ps aux --sort=-rss | head   (shows what to end)"
    return Check("memory", ok, detail, remedy)


def _check_disk() -> Check:
    cwd = Path.cwd()
    free = shutil.disk_usage(cwd).free
    if not os.access(cwd, os.W_OK):
        detail = f"{cwd} cannot be written to"
        return Check("disk", False, detail, "lidar-mi run EXPERIMENT.yaml -o A_WRITABLE_FOLDER")
    ok = free >= DISK_NEEDED
    detail = f"{free / GIB:.1f} GiB free in {cwd} (needs {DISK_NEEDED // GIB})"
    return Check("disk", ok, detail, "" if ok else f'du -sh "{cwd}"/outputs/*   (remove old runs)')


def _check_exr_tools() -> Check:
    tools = ("exrheader", "exrinfo", "oiiotool")
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if not missing:
        return Check("OpenEXR tools", True, ", ".join(tools))
    remedy = "sudo apt install openexr openimageio-tools"
    if shutil.which("brew"):
        remedy = "brew install openexr openimageio"
    elif shutil.which("dnf"):
        remedy = "sudo dnf install openexr OpenImageIO-utils"
    return Check("OpenEXR tools", None, f"not here: {', '.join(missing)} (only to look)", remedy)
