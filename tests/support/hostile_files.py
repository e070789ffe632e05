"""Hypothesis strategies for files, from their contracts."""

import copy
import io
import json
import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import OpenEXR
import xarray as xr
from hypothesis import strategies as st

from lidar_mi.io.exr import QUANTITIES
from lidar_mi.retrieval.vortices.model import PARAMETERS
from tests.support.cases import Case
from tests.support.hostile_experiments import BASE, as_yaml, scenes
from tests.support.hostile_values import ANYTHING, NUMBERS, TEXTS, UNITS, damaged
from tests.support.image_files import made

ROWS, COLUMNS = 24, 30


def image(seed: int = 0) -> np.ndarray:
    """A smooth pattern, (ROWS, COLUMNS), between 0 and 1."""
    noise = np.random.default_rng(seed).random((ROWS, COLUMNS))
    smooth = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    return np.round(8 * smooth) / 8  # so that cases are small files


def stored(write, suffix: str) -> bytes:
    """Bytes of a file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        write(path)
        return path.read_bytes()


LAYERS = ("Y", *(f"gate000.{name}" for name in QUANTITIES))
AXES = {
    "y": np.linspace(-1, 1, COLUMNS, dtype=np.float32),
    "z": np.linspace(-1, 1, ROWS, dtype=np.float32),
}
# what a header can hold
ATTRIBUTES = st.one_of(
    TEXTS.filter(lambda text: "\0" not in text),
    NUMBERS.filter(lambda number: abs(number) < 3e38).map(float),
    st.integers(-5, 5),
    st.lists(st.floats(width=32), min_size=1, max_size=4).map(lambda v: np.array(v, np.float32)),
    st.sampled_from(list(AXES.values())),
)


@st.composite
def exr_files(draw: st.DrawFn) -> bytes:
    """A scan's file with layers and attributes that are wrong, missing or of another kind."""
    layers = draw(st.sets(st.sampled_from(LAYERS), min_size=1) | st.just(set(LAYERS)))
    layers |= draw(
        st.sets(
            st.sampled_from(
                (
                    "R",
                    "gate001.S0",
                    "gate000.x",
                    "gate99999999999.S0",
                    "Y_noisy",
                    "\x1b[31m",
                    "gate",
                )
            ),
            max_size=2,
        )
    )
    attributes = dict(AXES)
    for name in draw(st.sets(st.sampled_from(("y", "z", "dt", "seed", "scene", "e\x1b[31m")))):
        attributes[name] = draw(ATTRIBUTES)
    pixels = {}
    for name in sorted(layers):
        values = image(1).astype(draw(st.sampled_from(("f4", "f4", "f2", "u4"))))
        fill = draw(st.sampled_from((None, None, None, 0, np.nan, np.inf, -1)))
        if fill is not None and values.dtype.kind == "f":
            values[: draw(st.integers(1, ROWS))] = fill
        pixels[name] = values
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(path):
        OpenEXR.File(header | attributes, pixels).write(str(path))

    try:
        content = stored(write, ".exr")
    except Exception:  # a header that the library does not write
        content = exr_file()
    return draw(damaged(content)) if draw(st.booleans()) else content


@cache
def exr_file() -> bytes:
    """A scan as our files hold it."""
    pixels = {name: image(k).astype("f4") for k, name in enumerate(LAYERS)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    return stored(lambda path: OpenEXR.File(header | AXES, pixels).write(str(path)), ".exr")


def looked_at(kind: str, name: str, content: bytes, *, spacing: bool) -> st.SearchStrategy:
    """An image given to every command that reads one."""
    pair = ["retrieve", name, name, "--dt", "0.1", "-o", "w.nc", "--template", "4", "--search", "8"]
    pair += ["--spacing", "0.5"] if spacing else []
    calls = [tuple(pair), ("rings", name, "-o", "r.png")] + [("info", name)] * 2
    return st.sampled_from(calls).map(
        lambda call: Case(kind, call, {name: content}, ("w.nc", "w.png", "r.png"))
    )


def exr_cases() -> st.SearchStrategy:
    """EXR images."""
    return st.tuples(exr_files(), st.booleans()).flatmap(
        lambda made: looked_at("exr", "a.exr", made[0], spacing=made[1])
    )


@cache
def image_file(suffix: str, mode: str) -> bytes:
    """An image of another kind."""
    from astropy.io import fits
    from PIL import Image

    values = image(2)
    if suffix == ".fits":
        return stored(lambda path: fits.PrimaryHDU(values.astype("f4")).writeto(path), suffix)
    made = Image.fromarray((255 * values).astype("u1")).convert(mode)
    buffer = io.BytesIO()
    made.save(buffer, {".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper()))
    return buffer.getvalue()


@cache
def drawn_file(seed: int) -> tuple[str, bytes]:
    """Name and content of an image file of any sort."""
    drawn = made(np.random.default_rng(seed))
    return drawn.name, drawn.content


def image_cases() -> st.SearchStrategy:
    """Damaged image files of every sort."""
    kinds = st.sampled_from(
        [
            (".png", "L"),
            (".png", "RGBA"),
            (".png", "P"),
            (".tif", "F"),
            (".tif", "L"),
            (".bmp", "RGB"),
            (".jpg", "L"),
            (".jpg", "CMYK"),
            (".fits", ""),
        ]
    )
    files = kinds.map(lambda kind: (f"a{kind[0]}", image_file(*kind)))
    files |= st.integers(0, 10_000).map(drawn_file)
    return files.flatmap(
        lambda file: damaged(file[1]).flatmap(
            lambda content: looked_at("image", file[0], content, spacing=True)
        )
    )


WAKE = ("u", "v", "w", "tracer", "aerosol")
LENGTHS = {"time": 2, "x": 3, "y": 12, "z": 10}
SEEN = ["time", "x", "y", "z"]


@st.composite
def wake_files(draw: st.DrawFn) -> bytes:
    """A wake with variables, dimensions, units and attributes that are wrong or missing."""
    names = draw(st.sets(st.sampled_from(WAKE)) | st.just(set(WAKE)))
    data = xr.Dataset()
    for name in sorted(names):
        dims = draw(st.just(SEEN) | st.lists(st.sampled_from(SEEN), unique=True))
        values = np.random.default_rng(len(name)).random([LENGTHS[d] for d in dims])
        values = values.astype(draw(st.sampled_from(("f8", "f4", "f4", "i2", "u1", "S3"))))
        if values.dtype.kind == "f" and values.ndim and draw(st.booleans()):
            values[0] = draw(st.sampled_from((np.nan, np.inf, -1.0, 1e30, 0)))
        data[name] = dims, values, {"units": "m s-1" if name in "uvw" else "1"}
    for name in draw(st.sets(st.sampled_from(SEEN)) | st.just(set(SEEN))):
        values = np.arange(LENGTHS[name], dtype=float)
        change = draw(st.sampled_from((None, None, "nan", "uneven", "reversed", "same", "text")))
        if change == "nan":
            values[0] = np.nan
        elif change == "uneven":
            values[-1] += 3
        elif change == "reversed":
            values = values[::-1]
        elif change == "same":
            values[:] = 1
        elif change == "text":
            values = values.astype("S4")
        data[name] = name, values, {"units": "s" if name == "time" else "m"}
    for name in draw(st.sets(st.sampled_from(sorted(data.variables) or ["u"]), max_size=2)):
        if name in data.variables:
            key = draw(st.sampled_from(("units", "_FillValue", "scale_factor", "calendar", "x")))
            value = draw(UNITS | NUMBERS | st.just([1.0, 2.0]))
            data[name].attrs[key] = value
    data.attrs["title"] = draw(TEXTS.filter(lambda text: "\0" not in text))
    engine = draw(st.sampled_from(("h5netcdf", "scipy")))
    try:
        content = stored(lambda path: data.to_netcdf(path, engine=engine), ".nc")
    except Exception:  # attributes that the format does not hold
        content = wake_file(engine)
    return draw(damaged(content)) if draw(st.booleans()) else content


@cache
def wake_file(engine: str) -> bytes:
    """A wake as it should be."""
    rng = np.random.default_rng(0)
    shape = [LENGTHS[d] for d in SEEN]
    data = xr.Dataset(
        {
            name: (SEEN, rng.random(shape), {"units": "m s-1" if name in "uvw" else "1"})
            for name in WAKE
        },
        {
            d: (d, np.arange(LENGTHS[d], dtype=float), {"units": "s" if d == "time" else "m"})
            for d in SEEN
        },
    )
    return stored(lambda path: data.to_netcdf(path, engine=engine), ".nc")


@st.composite
def wake_cases(draw: st.DrawFn) -> Case:
    """NetCDF files, checked and used as a wake."""
    data = BASE | {"wake": {"file": "a.nc", "time": 1, "x": 1}, "retrieval": {"search": 10}}
    asked = ({}, {}, {"time": 0}, {"depth": "volume"}, {"second": 1}, {"second": "advect_3d"})
    data["wake"] = data["wake"] | draw(st.sampled_from(asked))
    files = {"a.nc": draw(wake_files()), "a.yaml": as_yaml(data)}
    return Case("netcdf", draw(st.sampled_from((("info", "a.nc"), ("check", "a.yaml")))), files)


@st.composite
def scene_cases(draw: st.DrawFn) -> Case:
    """Mitsuba scenes with elements and attributes that are wrong, missing, moved or doubled."""
    shipped = {name: text for name, text in scenes().items() if not name.endswith((".nc", ".yaml"))}
    name = draw(st.sampled_from(sorted(n for n in shipped if n.endswith(".xml"))))
    root = ET.fromstring(small_film(shipped[name].decode()))
    for _ in range(draw(st.integers(1, 3))):
        parent = draw(st.sampled_from(list(root.iter())))
        action = draw(st.sampled_from(("set", "set", "set", "drop", "twice", "type", "inside")))
        if action in ("set", "type") and parent.attrib:
            key = draw(st.sampled_from(sorted(parent.attrib)))
            text = draw(ANYTHING.map(str) | NUMBERS.map(repr))
            parent.set(key, "".join(c for c in text if c.isprintable() or c == "\x1b")[:2000])
        elif len(parent):
            child = draw(st.sampled_from(list(parent)))
            if action == "drop":
                parent.remove(child)
            elif action == "twice":
                parent.append(child)
            elif draw(st.booleans()):
                child.append(ET.Element(child.tag, child.attrib))
            else:
                child.append(copy.deepcopy(parent))
    text = ET.tostring(root)
    if draw(st.sampled_from((True, False, False))):
        text = draw(damaged(text))
    files = {n: shipped[n] for n in ("cone.txt", "fringes_lens.txt", "puff.vol")}
    call = ("render", "a.xml", "-s", "2", "-o", "o.exr")
    return Case("xml", call, files | {"a.xml": text}, ("o.exr", "o.png"))


def small_film(text: str) -> str:
    """A scene of few pixels."""
    root = ET.fromstring(text)
    for film in root.iter("film"):
        for part in film:
            if part.get("name") in ("width", "height"):
                part.set("value", "5")
    return ET.tostring(root, encoding="unicode")


def text_cases() -> st.SearchStrategy:
    """Damaged scattering tables, vortex pairs and requirement tables."""
    table = scenes()["aerosol_soot_532nm.txt"]
    number = len(PARAMETERS)
    fit = {
        "success": True,
        "reasons": [],
        "profile": "lamb_oseen",
        "parameters": [300.0, 1.0, 15.0, 0.0, -300.0, 1.0, -15.0, 0.0, 0.0, 0.0],
        "covariance": np.eye(number).tolist(),
        "chi2": 1.0,
        "correlation": 1.0,
        "model_error": 0.0,
        "model_error_length": 0.0,
    }
    pairs = {"format": "lidar-mi vortex pairs 1", "fits": {"a": fit}}
    broken = st.tuples(st.sampled_from(sorted(fit)), ANYTHING).map(
        lambda change: json.dumps(pairs | {"fits": {"a": fit | dict([change])}}).encode()
    )
    whole = json.dumps(pairs).encode()
    requirements = b"wing: {title: a, cruise: {range: {min: 50 m}, error_v: {max: 1 m/s}}}\n"
    from tests.support.hostile_experiments import BOTH

    asked = as_yaml(BOTH | {"sensor": BOTH["sensor"] | {"requirements": "r.yaml"}})
    scattered = as_yaml(BASE | {"scattering": {"phase": "table", "table": "t.txt"}})
    return st.one_of(
        damaged(table).map(lambda text: Case("table", ("info", "t.txt"), {"t.txt": text})),
        damaged(table).map(
            lambda text: Case("table", ("check", "a.yaml"), {"t.txt": text, "a.yaml": scattered})
        ),
        (damaged(whole) | broken).map(
            lambda text: Case("vortices", ("info", "v.json"), {"v.json": text})
        ),
        damaged(requirements).map(
            lambda text: Case(
                "requirements", ("check", "a.yaml"), {"r.yaml": text, "a.yaml": asked}
            )
        ),
    )


def folder_cases() -> st.SearchStrategy:
    """Folders of runs and of studies, in which one file is damaged."""
    record = as_yaml(
        {
            "experiment": {**BASE, "doppler": {"retrieval": {"averaged": [1]}}},
            "versions": {"a": "1"},
        }
    )
    run = {
        "experiment.yaml": record,
        "metrics.json": b'{"backscatter.mc_relative_error": 0.1, "backscatter.cc.rmse_v": 1.0}',
        "log.txt": b"2026-01-01 00:00:00 failed: a\n2026-01-01 00:00:00 done\n",
    }
    study = {"study.yaml": b"name: s\nvariants: [a, b]\n", "metrics.json": b'{"a.x": 1.0}'}
    study |= {f"a/{name}": content for name, content in run.items()}

    def broken(files: dict[str, bytes]) -> st.SearchStrategy:
        return st.sampled_from(sorted(files)).flatmap(
            lambda name: damaged(files[name], 3).map(
                lambda content: Case(
                    "folder",
                    ("info", "r"),
                    {f"r/{n}": c for n, c in (files | {name: content}).items()},
                )
            )
        )

    return broken(run) | broken(study)
