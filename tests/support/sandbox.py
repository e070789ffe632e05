"""Calls in processes that may die, hang or eat memory: each in a fork with limits of its own.

A server imports the package once; every call runs in a fork of it, which takes milliseconds. The
server starts no thread and renders nothing, so that what it forks is whole.
"""

import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# imported by the server, so that no fork has to
PRELOADED = (
    "lidar_mi.cli.app lidar_mi.experiment.preflight.check lidar_mi.experiment.study "
    "lidar_mi.io.images lidar_mi.rendering.fringes lidar_mi.retrieval.wind.pair mitsuba "
    "lidar_mi.retrieval.rings.analysis lidar_mi.assessment.figures.rings "
    "lidar_mi.io.vortex_file xarray h5netcdf PIL.Image PIL.ImageFile PIL.PngImagePlugin "
    "tifffile imagecodecs scipy.io astropy.io.fits"
).split()

PATIENCE = 10
"""Time of a call by the clock over its processor time, at most."""


@dataclass(frozen=True)
class Outcome:
    """How a call ended.

    Attributes
    ----------
    code : int
        Exit code; negative: the signal that ended it.
    timed_out : bool
    out, err : str
        What it wrote; invalid UTF-8 shows as escapes.
    seconds : float
    value : object
        What a function returned, or the exception that it raised.
    """

    code: int
    timed_out: bool
    out: str
    err: str
    seconds: float
    value: Any = None


class Sandbox:
    """Runs functions in forks of one server; use it as a context.

    Parameters
    ----------
    seconds : float
        Of processor time that a call may take; by the clock ten times as many, as it waits for its
        turn on a busy machine.
    memory : int
        Bytes of address space that a call may take beyond what the server has.
    """

    def __init__(self, seconds: float = 20.0, memory: int = 2 << 30):
        self.seconds, self.memory = seconds, memory

    def __enter__(self) -> "Sandbox":
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, "-c", "from tests.support.sandbox import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
            env=environment,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stdin.close()
        self._server.wait()

    def call(
        self,
        function: Callable,
        *arguments: Any,
        folder: str | Path | None = None,
        seconds: float | None = None,
    ) -> Outcome:
        """What a call of a function does, in a folder; it is pickled by name."""
        asked = (function, arguments, str(folder or "."), seconds or self.seconds, self.memory)
        pickle.dump(asked, self._server.stdin)
        self._server.stdin.flush()
        return pickle.load(self._server.stdout)


def command(*arguments: str) -> None:
    """The command ``lidar-mi`` with arguments, which ends the process."""
    from lidar_mi.cli import app

    sys.argv = ["lidar-mi", *arguments]
    app.main()


def serve() -> None:
    """Answer calls from standard input until it ends."""
    for name in PRELOADED:
        __import__(name)
    with suppress(ImportError):  # no LLVM here
        # loaded, its threads come with the first image: in a fork of their own
        mitsuba_with_plugins("llvm_ad_mono_polarized")
    if threading.active_count() > 1:
        raise RuntimeError("a thread is there already")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            asked = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(_fork(*asked), answers)
        answers.flush()


def mitsuba_with_plugins(variant: str) -> None:
    """Load Mitsuba as every command would."""
    import mitsuba

    mitsuba.set_variant(variant)


def _fork(function, arguments, folder, seconds, memory) -> Outcome:
    with (
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
        tempfile.TemporaryFile() as result,
    ):
        start = time.perf_counter()
        child = os.fork()
        if child == 0:
            _run(function, arguments, folder, memory, out, err, result)
        timed_out = False
        while True:
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid:
                break
            taken = time.perf_counter() - start
            if taken > PATIENCE * seconds or (taken > seconds and _worked(child) > seconds):
                timed_out = True
                os.kill(child, signal.SIGKILL)
            time.sleep(0.002)
        taken = time.perf_counter() - start
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read(1_000_000).decode(errors="backslashreplace"))
        result.seek(0)
        content = result.read()
        value = pickle.loads(content) if content else None
        code = os.waitstatus_to_exitcode(status)
        return Outcome(code, timed_out, *texts, taken, value)


def _run(function, arguments, folder, memory, out, err, result) -> None:
    """The fork: ends the process."""
    code = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        limit = _address_space() + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        os.chdir(folder)
        try:
            value: Any = function(*arguments)
            code = 0
        except SystemExit as stop:
            value, code = None, stop.code if isinstance(stop.code, int) else 0
        except BaseException as error:
            import traceback

            traceback.print_exc()
            value = error
        sys.stdout.flush()
        sys.stderr.flush()
        try:
            result.write(pickle.dumps(value))
        except Exception:
            result.write(pickle.dumps(repr(type(value))))
        result.flush()
    finally:
        os._exit(code)


def _worked(process: int) -> float:
    """Processor time (s) of all threads of a process."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
