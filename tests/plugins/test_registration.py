"""Plugins register themselves. Unit tier.

Detects: a plugin that no entry point names; one that a second import or a change of variant loses
or alters; plugins that are missing when Mitsuba is imported before, after or without the package.

Mitsuba 3.10 imports the modules named by entry points when the first variant is set and reloads
each after every later change (its page "Distributing Python plugins"); `AS_MITSUBA_3_10` does the
same on older versions.
"""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from lidar_mi.plugins import PLUGINS

ROOT = Path(__file__).parents[2]

AS_MITSUBA_3_10 = """
import importlib, sys
import mitsuba as mi
import numpy as np

modules = []

def set_variant(name):
    mi.set_variant(name)
    if modules:
        for module in modules:
            importlib.reload(module)
    else:
        modules.extend(importlib.import_module(name) for name in sys.argv[1:])

def picture():
    scene = mi.load_dict({
        "type": "scene",
        "air": {"type": "homogeneous", "albedo": 1.0, "sigma_t": 1e-3,
                "phase": {"type": "rayleigh_polarized"}},
        "lidar": {"type": "scanning_lidar", "gate_start": 100.0, "gate_stop": 110.0,
                  "azimuth_min_deg": -1.0, "azimuth_max_deg": 1.0,
                  "elevation_min_deg": -1.0, "elevation_max_deg": 1.0,
                  "medium": {"type": "ref", "id": "air"}, "laser": {"type": "laser"},
                  "film": {"type": "hdrfilm", "width": 3, "height": 2}},
        "integrator": {"type": "gated_volpath", "max_order": 1}})
    return np.array(mi.render(scene, spp=16, seed=1))

pictures = []
for variant in ("llvm_ad_mono", "scalar_rgb", "llvm_ad_mono_polarized", "llvm_ad_mono"):
    set_variant(variant)
    if not variant.startswith("scalar"):
        pictures.append(picture())
assert pictures[0].max() > 0
assert np.array_equal(pictures[0], pictures[2])
"""


def python(code, *arguments):
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def entry_points():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())
    return stated["project"]["entry-points"]["mitsuba"]


def test_every_plugin_is_announced_by_its_name():
    expected = {plugin.NAME: f"lidar_mi.plugins.{plugin.NAME}" for plugin in PLUGINS}
    assert entry_points() == expected


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_plugins_serve_mitsuba_3_10(tmp_path):
    done = python(AS_MITSUBA_3_10, *entry_points().values())
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "imports",
    [
        pytest.param("import lidar_mi; import mitsuba as mi; mi.set_variant(V)", id="before"),
        pytest.param("import mitsuba as mi; mi.set_variant(V); import lidar_mi", id="after"),
        pytest.param(
            "import lidar_mi, importlib.util; importlib.util.find_spec('mitsuba'); "
            "import mitsuba as mi; mi.set_variant(V)",
            id="after-a-search",
        ),
        pytest.param(
            "import lidar_mi as lm; lm.register_plugins(); import mitsuba as mi; mi.set_variant(V)",
            id="by-hand",
        ),
        pytest.param(
            "import mitsuba as mi; import lidar_mi as lm; mi.set_variant('llvm_ad_rgb'); "
            "mi.set_variant(V); lm.register_plugins()",
            id="by-hand-later",
        ),
    ],
)
def test_order_of_imports_does_not_matter(imports):
    done = python(f"V = 'llvm_ad_mono'; {imports}; mi.load_dict({{'type': 'laser'}})")
    assert done.returncode == 0, done.stderr
