"""Contents of a file, a folder of results or a named scatterer, as titled tables of text."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.atmosphere.scattering.aerosols import AEROSOLS
from lidar_mi.atmosphere.scattering.molecules import BANDS, molecular_scattering
from lidar_mi.atmosphere.scattering.particle_scattering import Notice
from lidar_mi.atmosphere.scattering.tables import ScatteringTable, describe
from lidar_mi.errors import InputError
from lidar_mi.flags import masks_of
from lidar_mi.io.scattering_table import aerosol_table, read_table
from lidar_mi.io.size import fits

MOLECULES = "molecules"

Section = tuple[str, Sequence[tuple[str, ...]]]
"""A title and rows of equal length."""


def sections(
    what: str,
    wavelength: float | None = None,
    altitude: float | None = None,
    notice: Notice = lambda text, fraction: None,
) -> Iterator[Section]:
    """Describe a file, a folder of a run or a study, a named aerosol or the molecules of air.

    what: path of an EXR or NetCDF file, a scattering table, a run folder or a study's; or a name.
    wavelength: m, of a named scatterer; default 532 nm.
    altitude: m in the standard atmosphere, of molecules; default 0.

    Raises InputError: nothing of this name, not readable, or an option that does not apply to it.
    """
    path = Path(what)
    # a file with the name of a scatterer comes first
    is_scatterer = not path.exists() and (what in AEROSOLS or what == MOLECULES)
    if wavelength is not None and not is_scatterer:
        raise InputError(f"--wavelength: not allowed with {what}; expected a named scatterer")
    if altitude is not None and (not is_scatterer or what != MOLECULES):
        raise InputError(f"--altitude: not allowed with {what}; expected {MOLECULES}")
    kinds = {
        ".exr": _image,
        ".nc4": _netcdf,
        ".cdf": _netcdf,
        ".txt": _table_file,
        ".json": _vortices,
        ".hpl": _lines_of_sight,
        ".csv": _lines_of_sight,
    }
    if is_scatterer:
        wavelength = wavelength or 532e-9
        if what == MOLECULES:
            yield from _molecules(wavelength, altitude or 0.0)
        else:
            yield _scatterer(what, aerosol_table(what, wavelength, notice))
    elif not path.exists():
        raise InputError(
            f"{what}: no such file; expected .exr, .nc, .hpl, .csv, .txt, .json, a run folder, "
            f"{MOLECULES} or one of the aerosols {', '.join(AEROSOLS)}"
        )
    elif path.is_dir():
        yield from _folder(path)
    elif ".nc" in path.suffixes:
        yield from _netcdf(path)
    elif path.suffix in kinds:
        yield from kinds[path.suffix](path)
    elif path.suffix in (".yaml", ".yml"):
        raise InputError(f"{path}: an experiment, not a result; expected lidar-mi check {path}")
    else:
        raise InputError(
            f"{path}: unknown kind of file; expected .exr, .nc, .hpl or .csv (lines of sight), "
            ".txt (scattering table), .json (vortex pairs) or a run folder"
        )


def _vortices(path: Path) -> Iterator[Section]:
    from lidar_mi.io.vortex_file import read_vortices

    for name, fit in read_vortices(path).items():
        rows = [
            (
                quantity.long_name,
                f"{quantity.value:.4g} \u00b1 {quantity.stderr:.2g}",
                quantity.units,
            )
            for quantity in fit.quantities.values()
        ]
        yield f"{path}: vortex pair, {name}, {fit.profile.replace('_', ' ')}", rows


def _scatterer(title: str, table: ScatteringTable) -> Section:
    return title, list(describe(table).items())


def _table_file(path: Path) -> Iterator[Section]:
    yield _scatterer(str(path), read_table(path))


def _molecules(wavelength: float, altitude: float) -> Iterator[Section]:
    """The whole band of Rayleigh scattering, and the line that a narrow receiver detects."""
    pressure, temperature, _ = standard_atmosphere(altitude)
    bands = [molecular_scattering(wavelength, pressure, temperature, band) for band in BANDS]
    rows = [("", *(f"{band} {kind}" for band, kind in zip(BANDS, ("line", "band"), strict=True)))]
    for label, name, unit in (
        ("extinction coefficient", "extinction", "m^-1"),
        ("single-scattering albedo", "albedo", ""),
        ("backscatter coefficient", "backscatter", "m^-1 sr^-1"),
        ("lidar ratio", "lidar_ratio", "sr"),
        ("linear depolarisation ratio at 180 degrees", "depolarization_ratio", ""),
        ("depolarisation of natural light at 90 degrees", "depolarization", ""),
        ("extinction cross-section", "cross_section", "m^2 per molecule"),
        ("King factor", "king_factor", ""),
        ("number density", "number_density", "m^-3"),
    ):
        rows.append((label, *(f"{getattr(band, name):.5g} {unit}".strip() for band in bands)))
    title = (
        f"dry air at {wavelength * 1e9:g} nm, {altitude:g} m: {pressure / 100:.5g} hPa, "
        f"{temperature:.5g} K"
    )
    yield title, rows


def _image(path: Path) -> Iterator[Section]:
    from lidar_mi.io import exr

    header, layers = exr.read_layers(path)
    rows = []
    for name, pixels in sorted(layers.items()):
        span = f"{np.nanmin(pixels):.4g} ... {np.nanmax(pixels):.4g}"
        rows.append((name, f"{pixels.shape[1]} x {pixels.shape[0]}", str(pixels.dtype), span))
    yield f"{path}: {len(layers)} layers", rows
    yield "header", [(key, _short(value)) for key, value in sorted(header.items())]


def _netcdf(path: Path) -> Iterator[Section]:
    import xarray as xr

    from lidar_mi.io.lines_of_sight.read import is_lines_of_sight
    from lidar_mi.io.netcdf import load_variable, open_netcdf

    if is_lines_of_sight(path):
        try:
            yield from _lines_of_sight(path)
        except InputError as error:
            yield f"{path}: lines of sight", [("not read", str(error))]
    with open_netcdf(path) as data:
        rows = []
        for name, variable in data.variables.items():
            shape = " x ".join(f"{d} {n}" for d, n in variable.sizes.items())
            span = ""
            # larger variables would have to be read in parts
            if variable.dtype.kind in "fiu" and variable.size and fits(path, variable.nbytes):
                values = load_variable(xr.DataArray(variable, name=name), path)
                span = _span(float(values.min()), float(values.max()))
            rows.append((str(name), shape, span, str(variable.attrs.get("units", ""))))
        yield str(path), rows
        yield "attributes", [(key, _short(value)) for key, value in data.attrs.items()]


def _lines_of_sight(path: Path) -> Iterator[Section]:
    """Where a Doppler lidar looked, how much of it is valid, what is unusual."""
    from lidar_mi.io.lines_of_sight.read import read_lines_of_sight

    data = read_lines_of_sight(path)
    time, flag = data["time"].values, data["flag"].values
    seconds = float((time[-1] - time[0]) / np.timedelta64(1, "s"))
    about = data.attrs
    rows = [
        ("instrument", str(about.get("instrument", "unknown"))),
        ("scan, as the file says", str(about.get("scan_type", "")) or "unknown"),
        ("lines", f"{time.size}, {seconds:.4g} s"),
        ("first line", f"{str(time[0])[:23].replace('T', ' ')} UTC"),
    ]
    for name in ("azimuth", "elevation", "range"):
        values = data[name].values
        span = _span(float(values.min()), float(values.max()))
        extent = f"{values[0]:.4g}" if np.ptp(values) < 0.05 else span
        unit = "degrees" if name != "range" else f"m, {values.size} gates"
        rows.append((name, f"{extent} {unit}"))
    values = data["radial_velocity"].values[flag == 0]
    if values.size:
        span = _span(float(values.min()), float(values.max()))
        rows.append(("radial velocity (valid)", f"{span} m/s, positive away"))
    rows.append(("valid", f"{100 * values.size / flag.size:.1f} %"))
    for name, mask in masks_of(data["flag"].attrs).items():
        if part := float(((flag & mask) > 0).mean()):
            rows.append((name.replace("_", " "), f"{100 * part:.1f} %"))
    rows += [("remark", text) for text in about["remarks"].splitlines()]
    yield f"{path}: lines of sight, {about['kind']}, {about['scan']}", rows


def _span(low: float, high: float) -> str:
    """Both ends with 4 digits, or with as many as distinguish them."""
    for digits in range(4, 17):
        ends = f"{low:.{digits}g}", f"{high:.{digits}g}"
        if ends[0] != ends[1] or not low < high:
            break
    return " ... ".join(ends)


def _folder(folder: Path) -> Iterator[Section]:
    from lidar_mi.experiment.folder.records import STUDY

    yield from _study(folder) if (folder / STUDY).is_file() else _run_folder(folder)


def _study(folder: Path) -> Iterator[Section]:
    """Settings in which a study's variants differ, and their results, one column per variant."""
    from lidar_mi.assessment.report.comparison import differences, flat, results, setting
    from lidar_mi.experiment.folder.records import read_study

    name, records, metrics = read_study(folder)
    rows = [
        ("variant", *(key if record else f"{key} (not run)" for key, record in records.items()))
    ]
    settings = {
        key: flat(record["experiment"]) if record else {} for key, record in records.items()
    }
    # a variant that was not run would differ in every key
    done = {key: variant_settings for key, variant_settings in settings.items() if variant_settings}
    for key, values in differences(done).items():
        texts = dict(zip(done, map(setting, values), strict=True))
        rows.append((key, *(texts.get(variant, "-") for variant in records)))
    yield f"{folder}: study {name}", rows
    rows_of_results = [
        (f"{label} / {unit}" if unit else label, *values)
        for label, unit, values in results(metrics)
    ]
    if rows_of_results:
        yield "results", [("", *metrics), *rows_of_results]
    # the folder of a variant is a run that can be described by itself
    yield _files(folder, without=records)


def _run_folder(folder: Path) -> Iterator[Section]:
    from lidar_mi.assessment.report.comparison import setting
    from lidar_mi.experiment.folder.records import read_record

    record = read_record(folder)
    experiment = record["experiment"]
    main = dict(_main_keys(experiment))
    # the number that was chosen is known only to the record
    if main.get("render.samples_per_beam") == "auto" and "samples_per_beam" in record:
        main["render.samples_per_beam"] = f"auto: {record['samples_per_beam']}"
    yield (
        f"{folder}: experiment {experiment.get('name')}",
        [(key, setting(value)) for key, value in main.items()],
    )
    yield "versions", [(name, str(number)) for name, number in record["versions"].items()]
    yield _files(folder)


def _files(folder: Path, without: Iterable[str] = ()) -> Section:
    """Files in a folder, without those in some of its folders."""
    paths = {path.relative_to(folder): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return "files", [
        (str(name), f"{path.stat().st_size / 1e6:.2f} MB")
        for name, path in paths.items()
        if name.parts[0] not in without
    ]


_OF_A_RUN = ("platform.speed", "platform.dt", "scan.range")
_OF_A_FLIGHT = (
    "encounter.aircraft.model",
    "encounter.path.speed",
    "encounter.path.crossing_angle",
    "encounter.control.mode",
    "encounter.rate",
    "encounter.look_ahead",
)


def _main_keys(experiment: Mapping[str, Any]) -> Iterator[tuple[str, object]]:
    """The main keys of an experiment, as far as it has them and they have an effect."""
    flies = value_at(experiment, "encounter") is not None
    for key in (
        "seed",
        "wake.file",
        "wake.time",
        "wake.second",
        "wake.vortex_pair.circulation",
        "wake.texture.rms",
        *(_OF_A_FLIGHT if flies else _OF_A_RUN),
        "scan.thickness",
        "scan.gates",
        "scan.gate_count",
        "lidar.wavelength",
        "lidar.pulse_energy",
        "scattering.phase",
        "scattering.aerosol",
        "render.variant",
        "render.samples_per_beam",
        "render.max_order",
        "retrieval.methods",
    ):
        value = value_at(experiment, key)
        if value is not None and not (flies and key in ("wake.second", "scan.gate_count")):
            yield key, value


def value_at(experiment: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key of a record's experiment; None: it has none."""
    value: Any = experiment
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def _short(value: object) -> str:
    """A value in a line; numbers with the 7 digits that single precision has."""
    if isinstance(value, (float, np.floating)):
        value = f"{value:.7g}"
    text = " ".join(str(value).split())
    return text if len(text) <= 70 else f"{text[:67]}..."
