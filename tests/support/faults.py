"""Runs in which the disk fails or the process is killed at every place that touches the disk.

A process of its own, ``python -m tests.support.faults``: it reads what to try from standard input
and writes what came of it to standard output, both as JSON. It forks for every run, and starts no
thread itself. The places are found by watching a run: files opened to be written, writes, syncs,
renames, removals, folders made.
"""

import builtins
import errno
import io
import json
import os
import shutil
import signal
import sys
import traceback
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import save_all
from lidar_mi.assessment.report import page
from lidar_mi.cli.exit_codes import exit_by
from lidar_mi.experiment import measure, pipeline, report
from lidar_mi.experiment import run as experiment
from lidar_mi.experiment.graph import Stage
from lidar_mi.experiment.stages.rendering import IMAGES, batches_of
from lidar_mi.io.exr import QUANTITIES, label_scan
from lidar_mi.io.png import png_bytes
from lidar_mi.rendering import batches
from lidar_mi.schema import reading

SETTINGS = {
    "name": "faults",
    "wake": {
        "vortex_pair": {"separation": 16, "core_radius": 2, "width": 30, "height": 20},
        "extinction": {"molecules": 0},
    },
    "render": {"samples_per_beam": 4, "max_order": 1, "samples_per_pass": 1024},
    "retrieval": {"methods": ["cc"], "stride": 8},
}
PASSES = 3
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_APPEND
KILL = "kill"


# --- places that touch the disk --------------------------------------------------------------


class Places:
    """Every place in a folder that touches the disk, in order; at one of them something happens.

    Parameters
    ----------
    folder : path
    number : int
        Of the place, from 0.
    fault : str
        ``kill``, or the name of an error of the operating system.
    """

    def __init__(self, folder, number=-1, fault=""):
        self.found = []
        self._folder, self._number, self._fault = os.path.abspath(folder), number, fault

    def watch(self):
        """From now on, in this process."""
        sys.addaudithook(self._audited)
        real_fsync, real_open = os.fsync, io.open

        def fsync(descriptor):
            number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
            self._at("fsync", os.readlink(f"/proc/self/fd/{number}"))
            return real_fsync(descriptor)

        def watched_open(file, mode="r", *arguments, **options):
            opened = real_open(file, mode, *arguments, **options)
            return Watched(opened, self._at, file) if set(mode) & set("wax+") else opened

        os.fsync, io.open, builtins.open = fsync, watched_open, watched_open

    def _audited(self, event, arguments):
        if event == "open":
            path, _, flags = arguments
            if isinstance(path, str | os.PathLike) and flags & WRITING:
                self._at("open", path)
        elif event in ("os.rename", "os.remove", "os.mkdir", "os.link", "os.symlink"):
            self._at(event.removeprefix("os."), arguments[0])

    def _at(self, kind, path):
        path = os.path.abspath(os.fspath(path))
        if path != self._folder and not path.startswith(self._folder + os.sep):
            return
        self.found.append((kind, os.path.relpath(path, self._folder)))
        if len(self.found) - 1 == self._number:
            if self._fault == KILL:
                os.kill(os.getpid(), signal.SIGKILL)
            number = getattr(errno, self._fault)
            raise OSError(number, os.strerror(number), path)


class Watched:
    """A file whose writes are places."""

    def __init__(self, file, at, path):
        self._file, self._at, self._path = file, at, path

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()

    def write(self, content):
        self._at("write", self._path)
        return self._file.write(content)


# --- runs ------------------------------------------------------------------------------------


def asked(seed):
    return reading.check(SETTINGS | {"seed": seed}, "faults")


def make_fake(seed):
    """Replace what takes long, not what is stored nor how: images, winds, metrics, figures."""
    random = np.random.default_rng(seed)
    axes = {"gate": [0], "z": np.arange(5.0), "y": np.arange(7.0)}
    wind = xr.Dataset({"v": (("z", "y"), random.random((5, 7)))})

    def images(log, missing, store):
        for name in missing:
            light = np.random.default_rng([seed, IMAGES.index(name)]).random((1, 5, 7))
            batches = batches_of(IMAGES, store, log)(IMAGES.index(name))
            passes, arrays = batches.stored()
            total = arrays.get("total", np.zeros_like(light))
            for number in range(passes, PASSES):
                total = total + light / (number + 1)
                batches.store(number + 1, lambda total=total: {"total": total})
            values = {q: (tuple(axes), total) for q in QUANTITIES} | {"Y": (("z", "y"), total[0])}
            scan = label_scan(xr.Dataset(values, coords=axes))
            yield name, scan.assign_attrs(render_seconds=1.0, seed=seed)

    def figures(asked, results, metrics, folder, log):
        drawn = save_all(folder, [("fig", "Fig", (Figure((1, 1)), "caption"))], log)
        return drawn, {}

    pipeline.STAGES = (
        Stage("images", images, parts=lambda: IMAGES),
        Stage("scans", lambda images: list(images.values())),
        Stage("wind", lambda scans: wind),
    )
    measure.measure = lambda *_: {"backscatter.cc.rmse_v": float(random.random())}
    report.chapters = figures
    page.page = lambda *_: "<html></html>"


def run_once(folder, seed, number=-1, fault=""):
    """A run in a process of its own: exit code, what it said, and the places it came by."""
    output = Path(f"{folder}.said")
    process = os.fork()
    if process == 0:
        code = 99
        try:
            descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(descriptor, 2)
            # samples are kept after every pass
            batches.INTERVAL, batches.time = 0, SimpleNamespace(monotonic=lambda: 0.0)
            make_fake(seed)
            places = Places(folder, number, fault)
            places.watch()
            code = exit_code(
                lambda: experiment.run(asked(seed), folder, overwrite=True, notice=lambda *_: None)
            )
            sys.stderr.flush()
            Path(f"{folder}.places").write_text(json.dumps(places.found))
        except BaseException:
            traceback.print_exc()
            code = 99
        finally:
            os._exit(code)
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status), output.read_text()


def exit_code(command):
    """As the command line ends."""
    try:
        exit_by(lambda **_: command() and None)
    except SystemExit as stop:
        return stop.code
    raise AssertionError


def state(folder):
    """Content of all files in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes().hex()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file()
    }


def tried(folder, start, seed, number, fault):
    """A run with a fault in a folder like ``start``, and the next one without."""
    shutil.rmtree(folder, ignore_errors=True)
    if start:
        shutil.copytree(start, folder)
    code, output = run_once(folder, seed, number, fault)
    left = state(folder) if Path(folder).exists() else {}
    again, said_again = run_once(folder, seed)
    return {
        "code": code,
        "said": output,
        "left": left,
        "again": again,
        "said_again": said_again,
        "end": state(folder),
    }


def scenario(work, start, task):
    """What came of all faults in a folder that is new, or holds a run with the seed ``start``."""
    work.mkdir()
    seed = task["seed"]
    whole, begin = work / "whole", work / "start" if start else None
    if begin:
        assert run_once(begin, start) == (0, "")
        shutil.copytree(begin, whole)
    assert run_once(whole, seed) == (0, "")
    places = json.loads(Path(f"{whole}.places").read_text())
    cases = []
    for fault, kinds in task["faults"].items():
        possible = [number for number, (kind, _) in enumerate(places) if kind in kinds]
        for number in possible[:: task["every"].get(fault, 1)]:
            case = tried(work / "run", begin, seed, number, fault)
            cases.append({"place": f"{number} {' '.join(places[number])}", "fault": fault, **case})
    found = {"places": places, "start": state(begin) if begin else {}, "whole": state(whole)}
    return found | {"cases": cases}


def main():
    """Try what standard input asks for."""
    task = json.load(sys.stdin)
    # what every run would do for the first time
    png_bytes(Figure((1, 1)))
    xr.Dataset({"v": 1.0}).to_netcdf(engine="h5netcdf")
    json.dump(
        [scenario(Path(task["work"]) / str(start), start, task) for start in task["starts"]],
        sys.stdout,
    )


if __name__ == "__main__":
    main()
