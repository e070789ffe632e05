"""Choice of the LLVM library. Detects a misread version, a wrong order, a library that Dr.Jit
aborts on being taken, a user's setting being overridden, and an abort where an exception is due.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lidar_mi.system import llvm

HAS_LLVM = any(version >= llvm.MINIMUM_VERSION for _, version in llvm.find_llvm())
linux = pytest.mark.skipif(sys.platform != "linux", reason="the LLVM search differs elsewhere")


def tree(root: Path, *files: str) -> Path:
    """A folder with empty files."""
    root.mkdir(parents=True, exist_ok=True)
    for name in files:
        (root / name).touch()
    return root


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so.20.1", 20),
        ("libLLVM-17.so.1", 17),
        ("libLLVM-17.so", 17),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-9.so.1", 9),
        ("libLLVM.19.1.dylib", 19),
        ("libLLVM-18.dylib", 18),
        ("libLLVM.so", None),
        ("libLLVM.dylib", None),
        ("libLLVMSPIRVLib.so.15", None),
        ("libLLVM-18-rust-1.78.0-stable.so", None),
        ("libLLVMCore.a", None),
        ("libLLVM-17.so.debug", None),
    ],
)
def test_version_is_read_from_the_file_name(name, version, tmp_path):
    assert llvm.version_of(tree(tmp_path, name) / name) == version


def test_version_is_read_where_the_links_end(tmp_path):
    tree(tmp_path, "libLLVM.so.19.1")
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-19.so")
    assert llvm.version_of(tmp_path / "libLLVM.so") == 19


def test_version_is_read_from_a_homebrew_cellar(tmp_path):
    cellar = tree(tmp_path / "Cellar" / "llvm" / "19.1.7_1" / "lib", "libLLVM.dylib")
    opt = tree(tmp_path / "opt")
    (opt / "llvm").symlink_to(cellar.parent)
    assert llvm.find_llvm([opt / "llvm" / "lib"]) == [(cellar.resolve() / "libLLVM.dylib", 19)]


def test_candidates_are_newest_first_and_once(tmp_path):
    system = tree(tmp_path / "lib", "libLLVM-9.so.1", "libLLVM-14.so.1", "libLLVM.so.19.1")
    (system / "libLLVM-14.0.6.so.1").symlink_to("libLLVM-14.so.1")
    (system / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (system / "libLLVM-18.so").symlink_to("removed.so")
    own = tree(tmp_path / "llvm-14" / "lib")
    (own / "libLLVM-14.so").symlink_to(system / "libLLVM-14.so.1")
    found = llvm.find_llvm([own, system, tmp_path / "absent"])
    real = system.resolve()
    assert found == [
        (real / "libLLVM.so.19.1", 19),
        (real / "libLLVM-14.so.1", 14),
        (real / "libLLVM-9.so.1", 9),
    ]


@linux
@pytest.mark.parametrize(
    ("files", "chosen"),
    [
        (["libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1"], "libLLVM.so.19.1"),
        (["libLLVM-17.so.1", "libLLVM-16.so.1"], "libLLVM-17.so.1"),
        (["libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"], None),
        ([], None),
    ],
)
def test_newest_suitable_library_is_chosen(files, chosen, tmp_path):
    folder = tree(tmp_path / "lib", *files)
    environ = {}
    expected = str(folder.resolve() / chosen) if chosen else llvm.NOT_FOUND
    assert llvm.select_llvm([folder], environ) == expected
    assert environ == {llvm.VARIABLE: expected}


@linux
def test_choice_is_made_again_once_something_is_installed(tmp_path):
    environ = {}
    llvm.select_llvm([tree(tmp_path, "libLLVM-15.so.1")], environ)
    assert environ[llvm.VARIABLE] == llvm.NOT_FOUND
    assert llvm.select_llvm([tree(tmp_path, "libLLVM.so.19.1")], environ).endswith(".so.19.1")


@linux
@pytest.mark.parametrize("path", ["/opt/mine/libLLVM-17.so", "/opt/mine/libLLVM-15.so", "x.so"])
def test_a_path_set_by_the_user_stays(path, tmp_path):
    environ = {llvm.VARIABLE: path}
    assert llvm.select_llvm([tree(tmp_path, "libLLVM.so.19.1")], environ) == path
    assert environ == {llvm.VARIABLE: path}


@linux
def test_nothing_suitable_is_explained(tmp_path):
    message = llvm.check_llvm([tree(tmp_path, "libLLVM-14.so.1", "libLLVM-15.so.1")], {})
    assert "libLLVM-15.so.1 (LLVM 15)" in message
    assert "needs 17 or newer" in message
    assert "apt install libllvm19" in message
    assert "\n" not in message


@linux
@pytest.mark.parametrize(
    ("name", "create", "complaint"),
    [
        ("libLLVM-19.so", False, "is not a file"),
        ("libLLVM-15.so.1", True, "is LLVM 15, with which Dr.Jit aborts"),
        ("libLLVM-19.so", True, "cannot be loaded"),
    ],
)
def test_a_bad_path_set_by_the_user_is_explained(name, create, complaint, tmp_path):
    path = tmp_path / name
    if create:
        path.touch()
    message = llvm.check_llvm([], {llvm.VARIABLE: str(path)})
    assert message.startswith(f"{llvm.VARIABLE}: {path} {complaint}")
    assert "\n" not in message


@linux
def test_a_library_with_a_wrong_version_is_detected(tmp_path):
    """The version comes from the library itself: the C library under LLVM's name has none."""
    mapped = Path("/proc/self/maps").read_text().splitlines()
    libc = next((line.split()[-1] for line in mapped if re.search(r"/libc[.-]", line)), None)
    if libc is None:
        pytest.skip("no C library by that name in this process")
    liar = tmp_path / "libLLVM-19.so"
    liar.symlink_to(libc)
    assert "with which Dr.Jit aborts" in llvm.check_llvm([], {llvm.VARIABLE: str(liar)})


def python(code: str, **environ: str) -> subprocess.CompletedProcess:
    clean = {k: v for k, v in os.environ.items() if k != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-P", "-c", code],
        check=False,
        capture_output=True,
        text=True,
        timeout=120,
        env=clean | environ,
    )


@pytest.mark.skipif(not HAS_LLVM, reason="no LLVM >= 17 on this machine")
def test_dr_jit_takes_the_chosen_library():
    done = python(
        "from lidar_mi.system import llvm\n"
        "chosen = llvm.select_llvm()\n"
        "llvm.require_llvm()\n"
        "import mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "import drjit as dr\n"
        "assert dr.sum(dr.arange(mi.Float, 101))[0] == 5050\n"
        "print(chosen, llvm._loaded_llvm() or {chosen: 0})\n"
    )
    assert done.returncode == 0, done.stderr
    chosen, loaded = done.stdout.split(maxsplit=1)
    assert chosen == str(llvm.find_llvm()[0][0])
    assert chosen in loaded


@linux
def test_dr_jit_raises_and_does_not_abort_where_nothing_is_suitable(tmp_path):
    folder = tree(tmp_path / "lib", "libLLVM-14.so.1", "libLLVM-15.so.1")
    done = python(
        # by its path: importing lidar_mi would have chosen from this machine's own libraries
        "import runpy\n"
        f"select_llvm = runpy.run_path({llvm.__file__!r})['select_llvm']\n"
        f"select_llvm([{str(folder)!r}])\n"
        "import mitsuba as mi\n"
        "try:\n"
        "    mi.set_variant('llvm_ad_rgb')\n"
        "    mi.Float(1) + 1\n"
        "except ImportError as error:\n"
        "    print('ImportError', error)\n"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("ImportError")
    assert "lidar-mi doctor" in done.stderr  # Dr.Jit repeats the name it was given


@linux
def test_require_llvm_refuses_a_bad_setting(tmp_path):
    bad = tmp_path / "libLLVM-16.so"
    bad.touch()
    done = python(
        "from lidar_mi.system.llvm import require_llvm\n"
        "from lidar_mi.errors import InputError\n"
        "try:\n"
        "    require_llvm()\n"
        "except InputError as error:\n"
        "    print(error)\n",
        **{llvm.VARIABLE: str(bad)},
    )
    assert done.returncode == 0, done.stderr
    assert f"{llvm.VARIABLE}: {bad} is LLVM 16" in done.stdout


OLD = next((path for path, version in llvm.find_llvm() if version == 15), None)


@linux
@pytest.mark.skipif(OLD is None, reason="no LLVM 15 on this machine, the one Dr.Jit aborts on")
@pytest.mark.skipif(not HAS_LLVM, reason="no LLVM >= 17 on this machine")
def test_require_llvm_sees_that_dr_jit_came_first_with_an_old_library():
    done = python(
        "import os, drjit\n"
        f"del os.environ[{llvm.VARIABLE!r}]\n"
        "from lidar_mi.system.llvm import require_llvm\n"
        "try:\n"
        "    require_llvm()\n"
        "except ValueError as error:\n"
        "    print(error)\n",
        **{llvm.VARIABLE: str(OLD)},
    )
    assert done.returncode == 0, done.stderr
    assert "import lidar_mi before mitsuba and drjit" in done.stdout


def test_as_a_script_it_needs_nothing_installed(tmp_path):
    """Set-up asks before any package is there: -I -S leaves the standard library alone."""
    folder = tree(tmp_path / "a folder", "libLLVM-14.so.1")
    environ = {k: v for k, v in os.environ.items() if k != llvm.VARIABLE}
    command = [sys.executable, "-I", "-S", llvm.__file__, "--folders", str(folder)]
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=60, env=environ
    )
    assert (done.returncode, done.stderr) == (3, "")
    assert "libLLVM-14.so.1 (LLVM 14)" in done.stdout
    environ[llvm.VARIABLE] = str(folder / "libLLVM-14.so.1")
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=60, env=environ
    )
    assert (done.returncode, done.stderr) == (4, "")
    assert "is LLVM 14" in done.stdout
