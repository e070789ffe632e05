#!/bin/sh
# Sets the project up in .venv: Python packages, the project itself, an LLVM for Dr.Jit.
# Safe to run again: does nothing when nothing changed, repairs what an interruption left behind.
# PYTHON=/path/to/python3 chooses the interpreter.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
cd "$root"

# Packages from elsewhere would count as installed here and be missing later.
unset PYTHONPATH PYTHONHOME
export PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1

# pip answers Ctrl-C with an ordinary exit code; without this the script would go on after it.
trap 'exit 130' INT
trap 'exit 143' HUP TERM

say() { printf '%s\n' "setup: $*"; }
die() { printf '%s\n' "setup: $*" >&2; exit 1; }

# A virtual environment's programs name it in their first line, and PATH is split at colons.
check_name() {
    case $root in
        *[:\"\$\`\\]* | *'
'*) die "$root: a folder with a colon, a quotation mark, \$, \`, \\ or a line's end in its name cannot" \
            "hold a virtual environment; move the project to another folder" ;;
    esac
}

good_python() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        good_python "$PYTHON" || die "PYTHON=$PYTHON does not run or is older than Python 3.11"
        python=$PYTHON
        return
    fi
    for python in python3 python3.14 python3.13 python3.12 python3.11; do
        if good_python "$python"; then return; fi
    done
    die "no Python 3.11 or newer found; install one (Debian/Ubuntu: sudo apt install python3" \
        "python3-venv; macOS: brew install python) or run: PYTHON=/path/to/python3 make setup"
}

# Says which LLVM would be used (0), what to install (3), or why DRJIT_LIBLLVM_PATH is bad (4).
judge_llvm() { "$python" -P lidar_mi/system/llvm.py; }

provide_llvm() {
    status=0
    said=$(judge_llvm) || status=$?
    case $status in
        0) return ;;
        3) ;;
        *) die "${said:-lidar_mi/system/llvm.py could not run}" ;;
    esac
    command -v apt-get >/dev/null || die "$said"
    if [ "$(id -u)" = 0 ]; then
        as_root=''
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        as_root='sudo -n'
    else
        die "$said" "-- then run make again"
    fi
    say "Dr.Jit needs LLVM 17 or newer, this machine has none: installing it with apt-get"
    $as_root apt-get update -q || say "apt-get update failed; trying the package lists of last time"
    for package in libllvm19 libllvm20 libllvm18 libllvm17t64 libllvm17; do
        if apt-cache show "$package" >/dev/null 2>&1; then
            $as_root env DEBIAN_FRONTEND=noninteractive \
                apt-get install -q -y --no-install-recommends "$package" ||
                die "apt-get could not install $package (see above). $said"
            said=$(judge_llvm) || die "$package is installed, but: $said"
            return
        fi
    done
    die "apt knows no libllvm17 to libllvm20 (is there a network?). $said"
}

# The marker stays behind when an installation is interrupted: half a package may be there.
interrupted=.venv/.installing
stamp=.venv/.set-up-for

create_venv() {
    if [ ! -e "$interrupted" ] && good_python .venv/bin/python &&
        .venv/bin/python -c 'import pip' 2>/dev/null; then
        return
    fi
    if [ -e .venv ] || [ -L .venv ]; then
        say ".venv is incomplete: making it anew"
        rm -rf .venv
    fi
    say "making .venv with $python"
    if ! "$python" -m venv .venv; then
        rm -rf .venv
        die "$python cannot make virtual environments (see above);" \
            "Debian/Ubuntu: sudo apt install python3-venv; in a folder whose name is not UTF-8: move" \
            "the project to another folder"
    fi
}

# Without an NVIDIA GPU torch's builds for the processor do, a tenth of the size of the others.
cpu_index=https://download.pytorch.org/whl/cpu

prefer_cpu_torch() {
    if nvidia-smi -L >/dev/null 2>&1; then return; fi
    case "${PIP_INDEX_URL:-} ${PIP_EXTRA_INDEX_URL:-}" in *download.pytorch.org*) return ;; esac
    # alarm: a search for the address has no timeout of its own
    if "$python" -c "import signal, sys, urllib.request as u; signal.alarm(3); \
sys.exit(sys.platform != 'linux' or u.urlopen('$cpu_index/torch/').status != 200)" 2>/dev/null; then
        export PIP_EXTRA_INDEX_URL="${PIP_EXTRA_INDEX_URL:+$PIP_EXTRA_INDEX_URL }$cpu_index"
        say "no NVIDIA GPU here: taking torch's builds for the processor from $cpu_index"
    else
        say "taking torch from your package index ($cpu_index did not answer within 3 seconds)"
    fi
}

install_packages() {
    prefer_cpu_torch
    : >"$interrupted"
    # pip's exit code tells a clean failure (no network, nothing installed) from an interruption.
    if ! .venv/bin/python -m pip install -e '.[test]'; then
        rm -f "$interrupted"
        die "pip could not install what pyproject.toml asks for (see above); check the network" \
            "(HTTPS_PROXY, PIP_INDEX_URL) and run make setup again, downloads are kept"
    fi
    .venv/bin/python -c 'import lidar_mi.plugins' || die "the installed package cannot be imported"
    rm -f "$interrupted"
}

check_name
find_python
provide_llvm
wanted=$(printf '%s\n' "$root" && cat pyproject.toml)
if [ ! -e "$interrupted" ] && good_python .venv/bin/python &&
    [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ]; then
    exit 0
fi
create_venv
say "installing into .venv (the first time this takes minutes)"
install_packages
printf '%s\n' "$wanted" >"$stamp"
say "done; .venv/bin/lidar-mi doctor says what this machine can run"
