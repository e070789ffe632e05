"""Hypothesis strategies for calls from Python, from the signatures of the public functions."""

import inspect
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr
from hypothesis import strategies as st

import lidar_mi as lm
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from tests.support.cases import Case
from tests.support.hostile_experiments import BASE, as_yaml
from tests.support.hostile_files import exr_file, image_file

NOT_CALLED = ("run", "doctor", "register_plugins")
"""Public functions that are tried as `accepted.runs`, or that take no input."""

WRONG = ("None", "'a'", "3", "-1", "nan", "[]", "{}", "object()", "b'a'", "True", "'\\x1b[31m'")

IMAGES = (
    "pattern(1)",
    "pattern(2)",
    "pattern(1, fill=nan)",
    "pattern(1, fill=inf)",
    "pattern(1, fill=0)",
    "pattern(1, rows=1)",
    "pattern(1, rows=3)",
    "pattern(1, rows=0)",
    "pattern(1, spacing=nan)",
    "pattern(1, spacing=-1.0)",
    "pattern(1, spacing=0.0)",
    "pattern(1, spacing=1e300)",
    "pattern(1, dims=('a', 'b'))",
    "pattern(1, dims=('y', 'z'))",
    "pattern(1) * 0",
    "pattern(1) * 1e300",
    "pattern(1) * 1e-300",
    "pattern(1) - 5",
    "pattern(1).values",
    "pattern(1).drop_vars('y')",
    "pattern(1).astype(int)",
    "pattern(1).astype(complex)",
    "pattern(1).astype(str)",
    "pattern(1).astype(object)",
    "pattern(1).to_dataset(name='a')",
    "pattern(1).expand_dims('t')",
    "xr.DataArray(3.0)",
    "volume(1)",
    "volume(1) * nan",
)

# valid first
BY_TYPE: dict[typing.Any, tuple[str, ...]] = {
    xr.DataArray: IMAGES,
    float: ("0.1", "1", "0.0", "-1.0", "nan", "inf", "-inf", "1e-320", "1e308", "10**400", "'1 s'"),
    int: ("8", "1", "2", "0", "-1", "3", "10", "31", "10**9", "10**400", "2.5", "nan"),
    str: ("'a'", "'cc'", "'cpu'", "'cuda:9'", "'variational'", "'multipass'", "'ws'", "'Y'", "''"),
    bool: ("True", "False", "2"),
    Path: ("'a.exr'", "'a.png'", "'none'", "'.'", "'/dev/zero'", "''", "'a' * 5000", "'a\\0'"),
    xr.Dataset: (
        "vectors()",
        "xr.Dataset()",
        "vectors().isel(y=slice(2))",
        "vectors().isel(y=0)",
        "vectors().drop_vars('y')",
        "vectors().expand_dims('t')",
        "vectors() * nan",
        "vectors() * 0",
        "vectors() * inf",
        "vectors() * 1e200",
        "vectors().assign(v_stderr=0)",
        "vectors().assign(v_stderr=1, w_stderr=1, vw_correlation=2)",
        "vectors().assign(flag='a')",
        "vectors().assign(v=pattern(1))",
        "vectors().assign_coords(y=nan)",
        "vectors().rename(v='a')",
        "vectors().astype(str)",
        "vectors().astype(complex)",
    ),
    lm.WindowSizes: (
        "lm.WindowSizes(4, 8, 4)",
        "lm.WindowSizes(1)",
        "lm.WindowSizes(search=10**9)",
        "lm.WindowSizes('a')",
        "lm.WindowSizes(stride=-1)",
    ),
    lm.VectorValidation: (
        "lm.VectorValidation()",
        "lm.VectorValidation(nan)",
        "lm.VectorValidation(min_texture=-1.0)",
        "lm.VectorValidation(min_isotropy=inf)",
        "lm.VectorValidation(median_size=10**9)",
        "lm.VectorValidation(median_threshold=None)",
        "lm.VectorValidation(median_epsilon=0.0)",
    ),
    lm.Experiment: ("lm.load_experiment('a.yaml')",),
    tuple: ("(15.0, 12.0)", "(nan, 1.0)", "(1.0,)", "(inf, inf)", "(1e30, -1e30)"),
}

VALID = {"method": "'cc'", "device": "'cpu'", "windows": "lm.WindowSizes(4, 8, 4)"}
NAMED = {
    "image1": "pattern(1)",
    "image2": "pattern(1).roll(y=1)",
    "volume1": "volume(1)",
    "volume2": "volume(2)",
    "image": "pattern(1).values",
    "path": "'a.exr'",
    "name": "'a.yaml'",
    "fits": "{}",
}


def pattern(
    seed: int,
    rows: int = 24,
    columns: int = 30,
    dims: tuple[str, str] = ("z", "y"),
    spacing: float = 0.5,
    fill: float | None = None,
) -> xr.DataArray:
    """An image of noise, a corner of which may be filled with something else."""
    values = np.random.default_rng(seed).random((rows, columns))
    if fill is not None:
        values[: rows // 2, :5] = fill
    axes = {
        name: (name, spacing * np.arange(n), {"units": "m"})
        for name, n in zip(dims, (rows, columns), strict=True)
    }
    return xr.DataArray(values, axes, dims)


def volume(seed: int) -> xr.DataArray:
    """A volume of noise."""
    values = np.random.default_rng(seed).random((10, 24, 24))
    axes = {
        n: (n, np.arange(k) * 1.0, {"units": "m"}) for n, k in zip("xzy", (10, 24, 24), strict=True)
    }
    return xr.DataArray(values, axes, ("x", "z", "y"))


def vectors() -> xr.Dataset:
    """The wind of a vortex pair, 1 m/s of noise, without errors."""
    y, z = np.arange(-20.0, 21.0, 2.0), np.arange(-14.0, 15.0, 2.0)
    wind = velocity(vortex_pair(200.0, separation=16.0, core_radius=2.0), y, z[:, None])
    noise = np.random.default_rng(1).normal(size=(2, z.size, y.size))
    data = {name: (("z", "y"), part) for name, part in zip("vw", wind + noise, strict=True)}
    return xr.Dataset(data, {"z": z, "y": y})


def functions() -> dict[str, Callable]:
    """Public functions by name."""
    found = {name: getattr(lm, name) for name in lm.__all__}
    return {
        name: one
        for name, one in found.items()
        if inspect.isfunction(one) and name not in NOT_CALLED
    }


def candidates(annotation: typing.Any) -> tuple[str, ...]:
    """Expressions for what a parameter is annotated with, right ones first."""
    origin = typing.get_origin(annotation)
    # the arguments of a callable
    if isinstance(annotation, list):
        return ()
    if annotation in BY_TYPE:
        return BY_TYPE[annotation]
    if origin is typing.Literal:
        return tuple(map(repr, typing.get_args(annotation)))
    if origin is tuple:
        return BY_TYPE[tuple]
    return tuple(text for part in typing.get_args(annotation) for text in candidates(part))


def annotations(function: typing.Callable[..., typing.Any]) -> dict[str, typing.Any]:
    """Those of a public function; xarray's are in quotes where a module loads it late."""
    return typing.get_type_hints(function, localns={"xr": xr})


@st.composite
def calls(draw: st.DrawFn) -> Case:
    """A public function with one or two arguments that are unusual or wrong."""
    name = draw(st.sampled_from(sorted(functions())))
    function = functions()[name]
    hints = annotations(function)
    parameters = inspect.signature(function).parameters
    given = {}
    for key, one in parameters.items():
        if one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL):
            continue
        if key in NAMED or one.default is one.empty or key in VALID:
            right = NAMED.get(key) or VALID.get(key)
            given[key] = right or (candidates(hints.get(key)) or WRONG)[0]
    if parameters:
        for key in draw(st.sets(st.sampled_from(sorted(parameters)), min_size=1, max_size=2)):
            given[key] = draw(st.sampled_from((*candidates(hints.get(key)), *WRONG)))
    text = ", ".join(f"{key}={value}" for key, value in given.items())
    files = {"a.exr": exr_file(), "a.png": image_file(".png", "L"), "a.yaml": as_yaml(BASE)}
    named = {file: content for file, content in files.items() if file in text}
    return Case("call", ("python", f"lm.{name}({text})"), named)
