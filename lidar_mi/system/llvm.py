"""Choose the LLVM library that Dr.Jit loads, before it loads one.

Dr.Jit 1.5 emits instructions that LLVM 14 to 16 cannot compile; LLVM then aborts the process,
which Python cannot catch. Dr.Jit opens its LLVM while ``drjit`` is imported, so the choice is
made on ``import lidar_mi``, through ``DRJIT_LIBLLVM_PATH``.

The module needs the standard library only and is also a script: ``python3 -P
lidar_mi/system/llvm.py`` prints the chosen library (exit code 0), or what to install (3), or what
is wrong with the ``DRJIT_LIBLLVM_PATH`` that the user has set (4). On systems other than Linux and
macOS the search is left to Dr.Jit.
"""

import ctypes
import os
import platform
import re
import sys
from collections.abc import Iterable, MutableMapping
from pathlib import Path

MINIMUM_VERSION = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"

# What the variable holds when nothing suitable was found. Dr.Jit cannot load a file of this name,
# switches its LLVM backend off and raises ImportError; left to itself it would take LLVM 15.
NOT_FOUND = f"no libLLVM >= {MINIMUM_VERSION} found, see: lidar-mi doctor"

INSTALL = (
    "Debian/Ubuntu: sudo apt install libllvm19; Fedora: sudo dnf install llvm-libs; "
    "conda: conda install -c conda-forge libllvm19; macOS: brew install llvm"
)

# libLLVM.so.19.1, libLLVM-17.so.1, libLLVM-14.0.6.so.1, libLLVM-18.so, libLLVM.19.1.dylib; but not
# libLLVMSPIRVLib.so.15 or the private builds of other compilers (libLLVM-18-rust-1.78.so).
_NUMBERED = re.compile(
    r"libLLVM(?:\.so\.(\d+)[\d.]*|-(\d+)[\d.]*\.so[\d.]*|[-.](\d+)[\d.]*\.dylib)"
)
_UNNUMBERED = re.compile(r"libLLVM\.(?:so|dylib)")


def library_folders() -> list[Path]:
    """Folders in which systems keep libLLVM, those of this machine's architecture only."""
    patterns = [
        *(f for f in os.environ.get("LD_LIBRARY_PATH", "").split(":") if f),
        f"{sys.prefix}/lib",
        f"{sys.base_prefix}/lib",
        f"/usr/lib/{platform.machine()}-linux-gnu",
        "/usr/lib/llvm-*/lib",
        "/usr/lib64",
        "/usr/lib64/llvm*/lib",
        "/usr/lib",
        "/usr/local/lib",
        "/opt/homebrew/opt/llvm*/lib",
        "/usr/local/opt/llvm*/lib",
    ]
    folders = []
    for pattern in patterns:
        root, _, tail = pattern.partition("*")
        if tail:
            parent, stem = os.path.split(root)
            middle, _, last = tail.partition("/")
            matches = sorted(Path(parent).glob(f"{stem}*{middle}/{last}"))
        else:
            matches = [Path(pattern)]
        folders += [folder for folder in matches if folder.is_dir()]
    return list(dict.fromkeys(folders))


def version_of(library: str | os.PathLike[str]) -> int | None:
    """Major LLVM version that a file's name states, None where it states none.

    A name without a number is looked up where its links end; there Homebrew has the version as a
    folder (``Cellar/llvm/19.1.7/lib/libLLVM.dylib``).
    """
    real = Path(os.path.realpath(library))
    for name in (Path(library).name, real.name):
        if match := _NUMBERED.fullmatch(name):
            return int(next(filter(None, match.groups())))
    folder = re.fullmatch(r"(\d+)\.\d[\d._]*", real.parent.parent.name)
    return int(folder[1]) if folder and _UNNUMBERED.fullmatch(real.name) else None


def find_llvm(folders: Iterable[str | os.PathLike[str]] | None = None) -> list[tuple[Path, int]]:
    """LLVM libraries on this machine and their major versions, newest first.

    By default in :func:`library_folders`; each file once (links resolved), without links to
    nowhere.
    """
    versions: dict[Path, int] = {}
    for folder in library_folders() if folders is None else folders:
        for path in sorted(Path(folder).glob("libLLVM*")):
            version = version_of(path)
            if version is not None and path.is_file():
                versions.setdefault(path.resolve(), version)
    return sorted(versions.items(), key=lambda item: -item[1])


def select_llvm(
    folders: Iterable[str | os.PathLike[str]] | None = None,
    environ: MutableMapping[str, str] = os.environ,
) -> str | None:
    """Set ``DRJIT_LIBLLVM_PATH`` to the newest suitable LLVM, unless the user has set it.

    Must run before ``drjit`` is imported. Where nothing is suitable the variable names a file that
    cannot be loaded: ``mi.set_variant("llvm_...")`` then raises ImportError instead of ending the
    process. A path set by the user stays, good or bad; :func:`check_llvm` judges it.

    Returns
    -------
    str or None
        The variable's value; None on systems where the search is left to Dr.Jit.
    """
    if sys.platform not in ("linux", "darwin"):
        return environ.get(VARIABLE)
    if environ.get(VARIABLE, "") in ("", NOT_FOUND):
        suitable = [path for path, version in find_llvm(folders) if version >= MINIMUM_VERSION]
        environ[VARIABLE] = str(suitable[0]) if suitable else NOT_FOUND
    return environ[VARIABLE]


def check_llvm(
    folders: Iterable[str | os.PathLike[str]] | None = None,
    environ: MutableMapping[str, str] = os.environ,
) -> str | None:
    """Why the LLVM backend cannot run with the present choice, in one line; None if it can.

    The library is opened and asked for its version, so a file whose name lies is found out.
    """
    choice = select_llvm(folders, dict(environ))  # a copy: the check changes nothing
    if not choice:
        return None
    if choice == NOT_FOUND:
        return _nothing_suitable(folders)
    advice = f"it must name libLLVM {MINIMUM_VERSION} or newer, or be unset"
    if os.sep in choice and not Path(choice).is_file():
        return f"{VARIABLE}: {choice} is not a file; {advice} ({INSTALL})"
    version = version_of(choice)
    if version is None or version >= MINIMUM_VERSION:
        try:
            version = _ask_version(choice)
        except OSError as error:
            return f"{VARIABLE}: {choice} cannot be loaded ({error}); {advice} ({INSTALL})"
    if version < MINIMUM_VERSION:
        return (
            f"{VARIABLE}: {choice} is LLVM {version or 'before 16'}, with which Dr.Jit aborts; "
            f"{advice} ({INSTALL})"
        )
    return None


def require_llvm() -> None:
    """Raise unless an ``llvm_*`` variant can run; call it before setting one.

    Raises InputError: no LLVM >= 17, a bad ``DRJIT_LIBLLVM_PATH``, or Dr.Jit imported first with an
    older LLVM. The message says what to install or set.
    """
    # Imported here because as a script this file runs before the package is installed.
    from lidar_mi.errors import InputError

    in_use = _loaded_llvm() if "drjit" in sys.modules else {}
    select_llvm()
    if problem := check_llvm():
        raise InputError(problem)
    if in_use and max(in_use.values()) < MINIMUM_VERSION:
        library, version = max(in_use.items(), key=lambda item: item[1])
        raise InputError(
            f"{VARIABLE}: Dr.Jit was imported before lidar_mi and took {library} (LLVM {version}, "
            f"with which it aborts); import lidar_mi before mitsuba and drjit, or set "
            f"{VARIABLE}={os.environ[VARIABLE]}"
        )


def _nothing_suitable(folders: Iterable[str | os.PathLike[str]] | None) -> str:
    libraries = ", ".join(f"{path} (LLVM {version})" for path, version in find_llvm(folders))
    return (
        f"libLLVM: found {libraries or 'none'}, Dr.Jit needs {MINIMUM_VERSION} or newer; "
        f"install one ({INSTALL}) or set {VARIABLE}"
    )


def _ask_version(library: str) -> int:
    """Major version as the library itself reports it; 0 if it predates that call (LLVM 16)."""
    handle = ctypes.CDLL(library)
    if not hasattr(handle, "LLVMGetVersion"):
        return 0
    version = ctypes.c_uint()
    handle.LLVMGetVersion(ctypes.byref(version), None, None)
    return version.value


def _loaded_llvm() -> dict[Path, int]:
    """LLVM libraries mapped into this process; empty where /proc does not say (macOS)."""
    try:
        lines = Path("/proc/self/maps").read_text(errors="replace").splitlines()
    except OSError:
        return {}
    paths = {Path(line.split(maxsplit=5)[5]) for line in lines if "/libLLVM" in line}
    versions = {path: version_of(path) for path in paths}
    return {path: version for path, version in versions.items() if version is not None}


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description="Print the libLLVM that Dr.Jit would be given.")
    parser.add_argument("--folders", nargs="+", help="look here instead of the usual folders")
    folders = parser.parse_args().folders
    own_choice = os.environ.get(VARIABLE, "") in ("", NOT_FOUND)
    select_llvm(folders)
    if message := check_llvm(folders):
        print(message)
        sys.exit(3 if own_choice else 4)
    print(os.environ.get(VARIABLE, "left to Dr.Jit"))
