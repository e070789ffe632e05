"""The folder of a run: its experiment, the file of each result, its progress."""

import functools
import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.image_store import BATCHES, MADE_BY, ImageStore
from lidar_mi.experiment.folder.records import (
    LOG,
    METRICS,
    RECORD,
    REPORT,
    SUMMARY,
    file_checksum,
    read_record,
)
from lidar_mi.experiment.graph import Keys, Store
from lidar_mi.experiment.stages import rendering
from lidar_mi.experiment.stages.timed_beams import timing_files
from lidar_mi.io import exr
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.folder import is_free, locked, make_folder
from lidar_mi.io.images import read_pixels
from lidar_mi.io.json import to_json
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.text import encoded, write_text
from lidar_mi.io.wind_box import mann_files
from lidar_mi.io.yaml import to_yaml
from lidar_mi.rendering.phase import table_files
from lidar_mi.schema import reading
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file

FIGURES = "figures"
IMAGES = tuple(f"{name}.exr" for name in rendering.IMAGES)
RENDERED = (*IMAGES, "fringes_*.exr")
"""Images of an earlier run of the same experiment that a resumed run reuses."""
PREVIEWS = tuple(pattern.replace(".exr", ".png") for pattern in RENDERED)
"""Images to look at, one for each rendered image."""
RESULTS = {
    "wind": "wind.nc",
    "wind_volume": "wind_volume.nc",
    "v_los": "v_los.nc",
    "lines": "lines_of_sight.nc",
    "coherent_lines": "lines_of_sight.nc",
    "line_winds": "wind_profiles.nc",
    "line_vortices": "line_vortices.nc",
    "wind3d": "wind3d.nc",
    "vortices": "vortex.json",
}
"""File of a result, by its stage."""

# images may depend on the versions of these
_RENDERED_BY = ("lidar-mi", "mitsuba", "drjit")
_LIBRARIES = ("mitsuba", "drjit", "numpy", "scipy", "torch", "kornia", "OpenEXR", "xarray")


class RunFolder:
    """The files of a run, each result saved as soon as it is complete.

    Rendered images are read back, so that a resumed run has the same float32 values as an
    uninterrupted one.

    search_path: folder in which files named by the experiment are looked for first.
    shared: images that are shared with other runs: used if they are there, else added.
    record: the experiment, checksums of its files and of its metrics, versions.
    made_by: SHA-256 of those parts of the record that determine the images. Every result has it as
        an attribute; a result with another hash is not of this run.
    """

    def __init__(
        self,
        path: str | Path,
        experiment: Experiment,
        search_path: str | Path,
        shared: Store | None = None,
    ):
        self.path = Path(path)
        self.figures = self.path / FIGURES
        self.log = self.path / LOG
        self._experiment, self._search_path = experiment, Path(search_path)
        self._inputs = _inputs(experiment, search_path)
        self.record = new_record(experiment, search_path)
        self.made_by = made_by(self.record)
        self._shared = shared
        self._images = ImageStore(lambda part: self.path, lambda part: self.made_by)

    @contextmanager
    def claimed(self, overwrite: bool) -> Iterator[None]:
        """Lock the folder for this run, keeping images of the same experiment.

        Raises InputError: another run is using the folder; it holds images of another experiment or
        version, and ``overwrite`` is not set; or it is no run folder.
        """
        with held(self.path, "run folder"):
            self._begin(overwrite)
            yield

    def _begin(self, overwrite: bool) -> None:
        """Write the record; keep the files of an earlier run that are of this experiment."""
        folder, marker = self.path, self.path / RECORD
        images = self._matching(RENDERED)
        results = [folder / name for name in (METRICS, REPORT, SUMMARY, *RESULTS.values())]
        results = [path for path in results if path.exists()] + [*folder.glob(f"*{BATCHES}")]
        change = _difference(read_record(folder), self.record) if marker.is_file() else None
        foreign = [path for path in images if self._is_foreign(path)]
        if change:
            contents, old = f"a run of {change}", [*results, *images]
        else:
            contents, old = f"{foreign[0].name} of another experiment" if foreign else "", foreign
        self._refuse_inputs(changed=bool(change))
        if old and not overwrite:
            raise InputError(
                f"{folder}: holds {contents}; expected an empty folder (-o DIR), or --overwrite to "
                "replace it"
            )
        # results of another experiment must not be mistaken for those of this one
        drawn = [*self.figures.glob("*.png"), *self._matching(PREVIEWS), self.log] if change else []
        previews = [path.with_suffix(".png") for path in foreign]

        def remove_old() -> None:
            for path in (*old, *drawn, *previews):
                path.unlink(missing_ok=True)

        # if the disk is full, the earlier run remains unchanged
        write_atomically(marker, encoded(to_yaml(self.record)), first=remove_old)

    def _refuse_inputs(self, *, changed: bool) -> None:
        """Do not overwrite files that this run reads."""
        folder = self.path.resolve()
        outputs = {METRICS, REPORT, SUMMARY, LOG, *RESULTS.values()}
        for field, path in self._inputs.items():
            rendered = any(path.match(pattern) for pattern in (*RENDERED, *PREVIEWS))
            if path.resolve().parent == folder and (path.name in outputs or rendered):
                raise InputError(
                    f"{field}: {path} lies where this run writes; expected another folder (-o DIR)"
                )
        # the record of a run is an experiment file, too
        if changed and self._search_path.resolve() == folder:
            raise InputError(
                f"{self.path}: holds the experiment that this one was made from; expected another "
                "folder (-o DIR)"
            )

    def stored(self, part: str) -> xr.Dataset | None:
        """As of `ImageStore`; an image shared with other runs is copied here."""
        image = self._images.stored(part)
        if image is None and self._shared:
            image = self._shared.stored(part)
            if image is not None:
                self._images.write(part, image)
        return image

    def unfinished(self, part: str) -> dict[str, Any] | None:
        """As of `ImageStore`."""
        return self._images.unfinished(part)

    def store_unfinished(self, part: str, arrays: dict[str, Any]) -> None:
        """As of `ImageStore`."""
        self._images.store_unfinished(part, arrays)

    def store_part(self, part: str, value: xr.Dataset) -> xr.Dataset:
        """As of `ImageStore`; an image that may be shared with other runs is also written there."""
        if self._shared:
            self._shared.store_part(part, value)
        stored = self._images.store_part(part, value)
        self.write_previews()  # the first thing to look at, long before the figures
        return stored

    def _is_foreign(self, image: Path) -> bool:
        """Whether an image is of another experiment or version, or cannot be read."""
        try:
            return exr.read_header(image).get(MADE_BY) != self.made_by
        except InputError:
            return True

    def store_result(self, name: str, value: Any) -> None:
        """Write a result into its file, if it has one; None: there is no such result."""
        if name == "detected":
            self._store_noise(value)
        write_result(self.path, name, value, self._experiment.name, self.made_by)

    def _matching(self, patterns: Sequence[str]) -> list[Path]:
        return [path for pattern in patterns for path in self.path.glob(pattern)]

    def write_previews(self) -> None:
        """Write a PNG of its layer Y beside each rendered image without one, to look at."""
        from lidar_mi.io.png import write_preview

        for image in self._matching(RENDERED):
            preview = image.with_suffix(".png")
            if not preview.exists():
                write_preview(preview, read_pixels(image))

    def data_files(self) -> list[str]:
        """Names of the files beside the report, for links to them."""
        paths = self._matching((*RENDERED, *PREVIEWS))
        names = dict.fromkeys(RESULTS.values())
        paths += [self.path / name for name in names if (self.path / name).exists()]
        return [*sorted(path.name for path in paths), METRICS, SUMMARY, RECORD, LOG]

    def store_verdict(
        self, metrics: Mapping[str, float], page: str, answer: Sequence[str] = ()
    ) -> None:
        """Write report, answer and metrics: the run is complete.

        The record has the metrics' checksum.
        """
        write_verdict(self.path, self.record, metrics, page, answer)

    def _store_noise(self, scans: list[xr.Dataset]) -> None:
        """Add noisy images to the files of those without noise."""
        for part, scan in zip(rendering.IMAGES, scans, strict=True):
            if "Y_noisy" in scan and "Y_noisy" not in exr.read_scan(self._images.path(part)):
                self._images.write(part, scan)


def write_verdict(
    folder: Path,
    record: Mapping[str, Any],
    metrics: Mapping[str, float],
    page: str,
    answer: Sequence[str] = (),
) -> None:
    """Write report, answer and metrics of a folder, last the metrics: then it is complete."""
    text = to_json(metrics)
    # metrics say that the run is complete: old ones must not, if this process is killed
    (folder / METRICS).unlink(missing_ok=True)
    checked = {**record, "metrics": hashlib.sha256(text.encode()).hexdigest()}
    samples = metrics.get(f"{Source.BACKSCATTER}.samples_per_beam")
    if samples is not None:  # which the experiment may leave open
        checked["samples_per_beam"] = int(samples)
    write_text(folder / RECORD, to_yaml(checked))
    write_text(folder / REPORT, page)
    if answer:
        write_text(folder / SUMMARY, "".join(f"{line}\n" for line in answer))
    write_text(folder / METRICS, text)


def write_result(folder: Path, name: str, value: Any, experiment: str, signature: str) -> None:
    """Write the result of a stage into its file, if it has one.

    name: of the stage.
    value: none: there is no such result.
    experiment, signature: name of the experiment and hash of its record, see `made_by`.
    """
    from lidar_mi.io.vortex_file import write_vortices

    if name not in RESULTS:
        return
    path = folder / RESULTS[name]
    if value is None:
        path.unlink(missing_ok=True)
    elif name == "vortices":
        about = {"experiment": experiment, "source": f"lidar-mi {__version__}"}
        if value.method:
            about["vectors_method"] = str(value.method)
        write_vortices(path, value.pairs, **about, **{MADE_BY: signature})
    else:
        write_netcdf(value.assign_attrs({MADE_BY: signature}), path)


@contextmanager
def held(folder: Path, kind: str) -> Iterator[None]:
    """Create and lock a folder with a record; one with other contents is refused.

    Raises InputError: another process uses the folder, or it holds files but no record.
    """
    refuse_strangers(folder, RECORD, kind)
    make_folder(folder)
    with locked(folder):
        # the former holder of the lock may have written an experiment
        refuse_strangers(folder, RECORD, kind)
        yield


def refuse_strangers(folder: Path, marker: str, kind: str) -> None:
    """Refuse a folder that is not empty and lacks a marker file.

    Raises InputError: the folder is not empty, and the marker is not in it.
    """
    if not (folder / marker).is_file() and not is_free(folder):
        raise InputError(f"{folder}: is no {kind}; expected an empty or a new one (-o DIR)")


def new_record(experiment: Experiment, search_path: str | Path) -> dict[str, Any]:
    """Record of a run to be: ``experiment`` (resolved), ``files`` (checksums), ``versions``."""
    return {
        "experiment": reading.settings(experiment),
        "files": {
            field: file_checksum(path) for field, path in _inputs(experiment, search_path).items()
        },
        "versions": dict(_versions()),
        "metrics": None,
    }


@functools.cache
def _versions() -> dict[str, str]:
    return {
        "lidar-mi": __version__,
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }


def made_by(record: Mapping[str, Any], keys: Keys | None = None) -> str:
    """Hash of the settings, files and versions in a record on which rendered images depend.

    record: from `new_record`.
    keys: those that matter, of settings and of files that they name; default: all.
    """
    # in SI units: 0.5 km is the experiment of 500 m
    settings, files = reading.in_si(record["experiment"]), record["files"]
    decisive = {
        "experiment": settings if keys is None else keys.of(settings),
        "files": files if keys is None else keys.of(files),
        "versions": {name: record["versions"][name] for name in _RENDERED_BY},
    }
    # sorted, as the order of keys has no meaning
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """The first difference to an earlier run that affects its images; None: there is none."""
    changed = reading.in_si(before["experiment"]) != reading.in_si(now["experiment"])
    if changed or before.get("files") != now["files"]:
        return "another experiment"
    for name in _RENDERED_BY:
        earlier = before["versions"].get(name)
        if earlier != now["versions"][name]:
            return f"{name} {earlier}, this is {now['versions'][name]}"
    return None


def _inputs(experiment: Experiment, search_path: str | Path) -> dict[str, Path]:
    """The files named by an experiment, by key: an experiment differs if a file changes."""
    if experiment.wake is None:
        return {}
    paths = table_files(experiment.scattering, search_path)
    if experiment.wake.file:
        paths["wake.file"] = find_file(experiment.wake.file, search_path, "wake.file")
    if experiment.site.sounding:
        key = "site.sounding"
        paths[key] = find_file(experiment.site.sounding, search_path, key)
    air = experiment.encounter.air if experiment.encounter else None
    if air is not None and air.volume is not None:
        key = "encounter.air.volume.file"
        paths[key] = find_file(air.volume.file, search_path, key)
        if air.volume.mann is not None:
            _, paths[f"{key} (v)"], paths[f"{key} (w)"] = mann_files(paths[key])
    return paths | timing_files(experiment, search_path)
