"""Whole experiments, from the wake to the verdict, through the public `run`.

Detects: any axis turned or mirrored between wake, picture and wind (a blob's place and way, the
sense of the vortices), a picture wrong by 0.1 % of a pixel against an independent blur, winds worse
than the published figures for this wake, NaN or changed keys in the metrics, half-written files,
results of another experiment taken for this one's, and runs that do not repeat."""

import base64
import gc
import io
import json
import re
from contextlib import contextmanager
from html.parser import HTMLParser
from importlib.resources import files
from itertools import product
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import xarray as xr
import yaml
from matplotlib.image import imread as plt_imread
from PIL import Image
from scipy import ndimage
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import norm, qmc

from lidar_mi.assessment.report.digits import percent
from lidar_mi.atmosphere.wake import read_wake
from lidar_mi.errors import InputError
from lidar_mi.experiment import reading as config
from lidar_mi.experiment import run_folder
from lidar_mi.experiment import truth as truth_module
from lidar_mi.experiment.run import run
from lidar_mi.experiment.run_folder import IMAGES
from lidar_mi.experiment.stages import backscatter as backscatter_chain
from lidar_mi.experiment.truth import blur_by_beam, make_truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.io.exr import read_scan
from lidar_mi.io.vortex_file import read_vortices
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.velocimetry.common_grid import on_one_grid
from lidar_mi.retrieval.velocimetry.wind import retrieve_wind
from lidar_mi.retrieval.vortices.fit import fit_vortices

SOURCES = ("extinction", "extinction_without_texture", "extinction_blurred", "backscatter")
SCENES = Path(str(files("lidar_mi.scenes")))

FIGURES = {
    "fig00_overview",
    "fig05_extinction",
    "fig06_wind_from_extinction",
    "fig07_deviation_from_truth",
    "fig08_backscatter",
    "fig09_backscatter_against_extinction",
    "fig10_wind_from_backscatter",
    "fig11_deviation_from_extinction_winds",
    "fig12_error_by_texture",
    "fig12b_error_and_bound",
    "fig14_depolarization",
    "fig15_multiple_scattering",
}
STATISTICS = [
    f"{statistic}_{name}"
    for statistic in ("rmse", "bias", "p50", "p90")
    for name in ("v", "w", "speed", "direction")
]


@pytest.fixture(scope="module", autouse=True)
def free_scenes():
    """Scenes hold reference cycles, and every live one takes part in later kernels."""
    yield
    gc.collect()
    gc.collect()


@contextmanager
def without_figures():
    """Runs without figures and texture sweep, most of a small run's time: the demo has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backscatter_chain.figures, "draw_all", lambda *_: [])
        patch.setattr(backscatter_chain, "TEXTURE_SWEEP", ())
        yield


@pytest.fixture
def quick():
    with without_figures():
        yield


def small(name="small", **wake):
    """A vortex pair seen by 61 x 41 beams in single scattering, as a dictionary."""
    pair = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
    return {
        "name": name,
        "wake": {"vortex_pair": pair, **wake},
        "render": {"samples_per_beam": 8, "max_order": 1},
        "retrieval": {"methods": ["cc"]},
    }


def check(data):
    return config.check(data, "test")


def write_wake(path, tracer, v=10.0, w=5.0, x=None):
    """A uniform wind that carries ``tracer(y, z)`` or ``tracer(x, y, z)``; even aerosol; 1 m."""
    axes = {"y": np.arange(-20, 20.5, 1.0), "z": np.arange(-15, 15.5, 1.0)}
    if x is not None:
        axes = {"x": x, **axes}
    grid = np.meshgrid(*axes.values(), indexing="ij")
    fields = {
        "v": (v, "m s-1"),
        "w": (w, "m s-1"),
        "aerosol": (1.0, "1"),
        "tracer": (tracer(*grid), "1"),
    }
    data = xr.Dataset(
        {
            name: (tuple(axes), np.broadcast_to(values, grid[0].shape).copy(), {"units": unit})
            for name, (values, unit) in fields.items()
        },
        coords={name: (name, values, {"units": "m"}) for name, values in axes.items()},
    )
    data.to_netcdf(path, engine="h5netcdf")
    return path.name


def blob(y0, z0, sigma=1.5):
    return lambda y, z: np.exp(-((y - y0) ** 2 + (z - z0) ** 2) / (2 * sigma**2))


def as_seen(path):
    """The picture as any EXR program has it: row 0 at the top, column 0 at the left."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.array(file.channels()["Y"].pixels)


def leftovers(folder):
    """Temporary names: hidden or partial files."""
    return [p for p in folder.rglob("*") if p.name.startswith(".") or p.suffix == ".part"]


# ---------------------------------------------------------------- the demo's files


def test_everything_a_run_leaves(demo):
    names = {str(p.relative_to(demo.folder)) for p in demo.folder.rglob("*") if p.is_file()}
    assert names == {
        "experiment.yaml",
        "image_t1.exr",
        "image_t2.exr",
        "wind.nc",
        "metrics.json",
        "report.html",
        "log.txt",
        *(f"figures/{name}.png" for name in FIGURES),
    }
    log = (demo.folder / "log.txt").read_text().splitlines()
    assert "seed 1" in log[0] and log[-1].endswith("done")


def test_the_record_is_enough_to_repeat_the_run(demo):
    record = yaml.safe_load((demo.folder / "experiment.yaml").read_text())
    assert config.check(record["experiment"], "record") == demo.experiment
    assert record["experiment"]["seed"] == 1
    assert {"lidar-mi", "python", "mitsuba", "drjit", "numpy", "torch"} <= set(record["versions"])
    assert len(record["files"]["wake.file"]) == 64  # SHA-256


def test_the_record_is_an_experiment_file(demo):
    assert config.load(demo.folder / "experiment.yaml") == demo.experiment
    changed = config.load(demo.folder / "experiment.yaml", ["seed=7"])
    assert changed.seed == 7 and changed.wake == demo.experiment.wake


def test_every_variable_of_the_winds_is_in_the_user_guide(demo):
    guide = (Path(__file__).parents[2] / "docs" / "user_guide.md").read_text()
    table = guide[guide.index("`wind.nc`, CF") :].partition("`source`:")[0]
    listed = set(re.findall(r"`(\w+)`", "".join(re.findall(r"(?m)^\|([^|]*)\|", table))))
    with xr.open_dataset(demo.folder / "wind.nc") as winds:
        assert listed == set(winds.data_vars)


def test_the_wake_is_read_once(tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(
        truth_module, "read_wake", lambda *a, **k: read.append(a) or read_wake(*a, **k)
    )
    monkeypatch.setattr(backscatter_chain.figures, "draw_all", lambda *_: [])
    data = small()
    data["wake"] = {"file": write_wake(tmp_path / "w.nc", blob(8, -4))}
    metrics = run(check(data), tmp_path / "run", tmp_path)
    assert len(read) == 1 and "texture_sweep.40_percent.rmse_v" in metrics


def test_progress_names_every_step_and_stays_within_bounds(demo):
    texts = " | ".join(text for text, _ in demo.told)
    for step in (
        "reading the wake",
        "rendering scan 1 of 2",
        "rendering scan 2 of 2",
        "retrieving winds from backscatter",
        "drawing",
        "done",
    ):
        assert step in texts
    assert all(share is None or 0 <= share <= 1 for _, share in demo.told)


def test_metrics_are_finite_and_their_keys_are_the_agreed_ones(demo):
    def refuse(constant):
        pytest.fail(f"metrics.json holds {constant}")

    text = (demo.folder / "metrics.json").read_text()
    metrics = json.loads(text, parse_constant=refuse)
    assert metrics == demo.metrics
    assert all(isinstance(value, float) and np.isfinite(value) for value in metrics.values())
    expected = {
        f"{source}.{method}.{key}"
        for source, method in product(SOURCES, ("cc", "ws"))
        for key in (
            "valid_fraction",
            "found_fraction",
            *(f"{part}{s}" for part in ("", "outside_cores.", "all.") for s in STATISTICS),
        )
    }
    # the noise of a picture that was rendered is known, and so how well a wind can be found in it
    expected |= {
        f"backscatter.{method}.{q}_{name}"
        for method in ("cc", "ws")
        for q in ("bound", "efficiency")
        for name in "vw"
    }
    expected |= {
        "backscatter.mc_relative_error",
        "backscatter.multiple_scattering_fraction",
        "backscatter.depolarization",
        "backscatter.depolarization_stderr",
    }
    expected |= {
        f"wake.{side}_core.{q}"
        for side in ("port", "starboard")
        for q in ("y", "z", "radius", "circulation")
    }
    expected |= {
        f"texture_sweep.{level}_percent.{q}"
        for level in (0, 2, 5, 10, 20, 40)
        for q in ("rmse_v", "rmse_w", "valid_fraction")
    }
    expected |= {f"true_wind.{part}rms_{q}" for part in ("", "outside_cores.") for q in "vw"}
    expected |= {f"timing.{step}_s" for step in ("truth", "render", "retrieve", "figures")}
    assert set(metrics) == expected


def test_wind_file_is_cf(demo):
    with xr.open_dataset(demo.folder / "wind.nc") as wind:
        assert wind.attrs["Conventions"].startswith("CF-")
        assert wind["v"].dims == ("source", "algorithm", "z", "y")
        assert wind["source"].values.tolist() == list(SOURCES)
        assert wind["algorithm"].values.tolist() == ["cc", "ws"]
        for name, variable in wind.variables.items():
            if variable.dtype.kind == "f":
                assert variable.attrs["units"] in ("m", "m s-1", "1"), name
                assert variable.attrs.get("long_name") or name in wind.coords, name
        for name in ("v", "w", "v_true", "w_true"):
            assert wind[name].attrs["units"] == "m s-1"
        for name in ("y", "z", "y_vector", "z_vector"):
            assert wind[name].attrs["units"] == "m"
        masks = wind["flag"].attrs["flag_masks"]
        assert len(wind["flag"].attrs["flag_meanings"].split()) == len(masks)
        assert not (wind["flag"].values & ~np.bitwise_or.reduce(masks)).any()
        # 219 x 139 pixels hold 204 x 124 regions of 16; a template's centre is between pixels
        assert dict(wind.sizes) == {"source": 4, "algorithm": 2, "z": 124, "y": 204}
        assert float(wind["y"][0]) == pytest.approx(-54.5 + (4 + 3.5) * 0.5)
        valid = (wind["flag"] == 0).values
        for name in ("v", "w", "y_vector", "z_vector", "v_true", "w_true"):
            assert np.isfinite(wind[name].values[valid]).all(), name


def test_metrics_follow_from_the_wind_file(demo):
    with xr.open_dataset(demo.folder / "wind.nc") as wind:
        one = wind.sel(source="backscatter", algorithm="cc")
        error = (one["w"] - one["w_true"]).values[one["flag"].values == 0]
    assert demo.metrics["backscatter.cc.rmse_w"] == pytest.approx(
        np.sqrt(np.mean(error.astype(float) ** 2)), rel=1e-5
    )


def test_pictures_say_what_they_show(demo):
    for index, name in enumerate(IMAGES):
        scan = read_scan(demo.folder / name)
        start = 500.0 - 15.0 * index
        assert (scan.attrs["gate_start"], scan.attrs["gate_stop"]) == (start, start + 2.5)
        assert scan.attrs["wavelength"] == pytest.approx(532e-9)
        assert (scan.attrs["platform_speed"], scan.attrs["dt"]) == (150.0, pytest.approx(0.1))
        assert scan.attrs["seed"] == 1 + index * 2**16  # scans must not share their photons
        assert scan.attrs["samples_per_beam"] == 64
        assert scan.sizes == {"gate": 1, "z": 139, "y": 219}
        for axis, end in (("y", 54.5), ("z", 34.5)):
            values = scan[axis].values
            np.testing.assert_allclose(values[[0, -1]], [-end, end], atol=1e-4)
        assert (scan["S0"].values > 0).all() and (scan["S0_stderr"].values > 0).all()


# ---------------------------------------------------------------- figures and report


def axes_in(path):
    """The pictures inside a figure file, largest two: blocks of pixels that are not white. A thin
    frame joins nothing to them, colour bars are smaller."""
    pixels = plt_imread(path)[..., :3]
    inked, _ = ndimage.label(ndimage.binary_opening((pixels < 0.97).any(-1), np.ones((9, 9))))
    blocks = ndimage.find_objects(inked)
    area = np.bincount(inked.ravel())[1:]
    largest = sorted(np.argsort(area)[-2:], key=lambda k: blocks[k][1].start)
    return [pixels[blocks[k]] for k in largest]


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_figures_are_readable_and_not_blank(demo, name):
    pixels = plt_imread(demo.folder / "figures" / f"{name}.png")
    height, width = pixels.shape[:2]
    assert 900 <= width <= 2000 and 400 <= height <= 2000
    # ink in every quarter
    for rows in np.array_split(pixels[..., :3], 2, axis=0):
        for part in np.array_split(rows, 2, axis=1):
            assert part.std() > 0.05


@pytest.mark.parametrize(
    "figure, of", [("fig08_backscatter", "backscatter"), ("fig05_extinction", "extinction")]
)
def test_figures_show_what_the_pilot_sees(demo, figure, of):
    """Brightness of the drawn pictures against the data: port (+y) on the left, up at the top.
    Mirrored either way or turned by 180 degrees they do not match."""
    if of == "backscatter":
        data = [read_scan(demo.folder / name)["Y"] for name in IMAGES]
    else:
        data = [make_truth(demo.experiment, SCENES).image(k) for k in (0, 1)]
    for drawn, field in zip(axes_in(demo.folder / "figures" / f"{figure}.png"), data, strict=True):
        brightness = drawn.sum(-1)  # cividis grows brighter with the value
        assert drawn.shape[1] / drawn.shape[0] == pytest.approx(219 / 139, rel=0.03)
        rows, columns = (
            ((np.arange(n) + 0.5) * size / n).astype(int)
            for n, size in zip(field.shape, brightness.shape)
        )
        seen = brightness[np.ix_(rows, columns)].ravel()
        values = field.transpose("z", "y").values
        right, *wrong = (
            np.corrcoef(seen, turned.ravel())[0, 1]
            for turned in (values[::-1, ::-1], values[:, ::-1], values[::-1], values)
        )
        assert right > 0.97 and max(wrong) < 0.92, (right, wrong)


class Links(HTMLParser):
    """What a page refers to, and its visible text."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.words = [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        assert tag not in ("link", "iframe")
        assert tag != "script" or "src" not in dict(attributes)
        self.targets += [
            value
            for key, value in attributes
            if key in ("src", "href") and not value.startswith("#")
        ]

    def handle_data(self, data):
        self.words.append(data)


def test_report_needs_nothing_else(demo):
    page = (demo.folder / "report.html").read_text()
    links = Links(page)
    assert len(links.targets) == len(FIGURES)
    for target, path in zip(links.targets, sorted((demo.folder / "figures").iterdir())):
        kind, _, code = target.partition(",")
        assert kind == "data:image/webp;base64"
        with Image.open(io.BytesIO(base64.b64decode(code))) as held, Image.open(path) as drawn:
            assert held.tobytes() == drawn.convert("RGB").tobytes()
    assert len(page) < 6e6
    assert "url(" not in page and "@import" not in page


def test_report_tells_the_numbers(demo):
    words = " ".join(Links((demo.folder / "report.html").read_text()).words)
    assert "wake_backscatter" in words and "seed: 1" in words
    for text in ("wake_slab_40s.nc at 40 s", "532 nm, 1 mJ", "mitsuba 3.", "64 photons a beam"):
        assert text in words
    assert f"{demo.metrics['backscatter.cc.rmse_v']:.3f}" in words
    assert f"backscatter.cc.rmse_v: {demo.metrics['backscatter.cc.rmse_v']:.4g} m/s" in words
    assert (
        f"wake.port_core.circulation: {demo.metrics['wake.port_core.circulation']:.4g} m²/s"
        in words
    )
    assert f"{demo.metrics['true_wind.rms_v']:.3g}" in words and "no skill" in words
    noise = (
        f"simulation {percent(demo.metrics['backscatter.mc_relative_error'])} (64 photons a beam)"
    )
    assert noise in words and "no detector" in words
    assert "cross-correlation" in words and "weight shift" in words


# ---------------------------------------------------------------- how good the winds are


def test_the_pictures_alone_tell_of_the_vortices(demo):
    """The paper's case: circulation to 5 % of what the simulation's file says, places to 1 m."""
    scans = [read_scan(demo.folder / name) for name in IMAGES]
    (pair, noise), *_ = backscatter_chain.rendered_pairs(demo.experiment, scans).values()
    fit = fit_vortices(*pair, demo.experiment.platform.dt, noise)
    assert fit.success, fit.reasons
    for side, circulation in (("port", 439.99), ("starboard", -438.41)):
        found = fit.quantities[f"{side}_circulation_5_15"]
        assert found.value == pytest.approx(circulation, rel=0.05)
        assert abs(found.value - circulation) < 4 * found.stderr
        for axis in "yz":
            true = demo.metrics[f"wake.{side}_core.{axis}"]
            assert fit.quantities[f"{side}_{axis}"].value == pytest.approx(true, abs=1.0)


def test_the_readme_tells_the_demo_s_numbers(demo):
    """Within 0.02 m/s and 1 %, by which another order of rounding may change them; two digits are
    printed of the larger ones."""
    rows = {
        "the extinction field itself": "extinction.cc.rmse",
        "the same, blurred by the beam's width": "extinction_blurred.cc.rmse",
        "rendered backscatter, all orders, 64 photons a beam": "backscatter.cc.rmse",
        "the extinction field without sub-grid texture": "extinction_without_texture.cc.rmse",
        "*(rms of the true wind)*": "true_wind.rms",
    }
    found = 0
    for line in (Path(__file__).parents[2] / "README.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if cells[0] not in rows:
            continue
        found += 1
        source, _, statistic = rows[cells[0]].rpartition(".")
        keys = [f"{source}.{part}{statistic}_{q}" for part in ("", "outside_cores.") for q in "vw"]
        for key, cell in zip(keys, cells[1:5], strict=True):
            rounding = 0.5 * 10.0 ** -len(cell.partition(".")[2])
            assert float(cell) == pytest.approx(demo.metrics[key], abs=0.02 + rounding), key
        if cells[5]:
            share = float(cells[5].removesuffix("%")) / 100
            assert share == pytest.approx(demo.metrics[f"{source}.valid_fraction"], abs=0.015)
    assert found == len(rows)


@pytest.mark.parametrize(
    "texture, v, w", [(0, 4.1, 4.3), (5, 1.8, 1.7), (20, 0.66, 0.62)], ids=lambda x: str(x)
)
def test_winds_from_extinction_are_as_good_as_published(demo, texture, v, w):
    """All vectors of a plain cross-correlation (8 in 16) on this slab, as published with it. The
    textures differ by their seeds: over eight of them the rmse at 20 % scatters by 0.03 (v) and
    0.02 m/s (w), at 5 % by 0.13 and 0.04 m/s. Three times that is allowed."""
    scatter = {0: (0, 0), 5: (0.13, 0.04), 20: (0.03, 0.02)}[texture]
    assert demo.metrics[f"texture_sweep.{texture}_percent.rmse_v"] <= v + 3 * scatter[0]
    assert demo.metrics[f"texture_sweep.{texture}_percent.rmse_w"] <= w + 3 * scatter[1]


def test_more_texture_never_makes_winds_worse(demo):
    levels = (0, 2, 5, 10, 20, 40)
    for name, sign in (("rmse_v", -1), ("rmse_w", -1), ("valid_fraction", 1)):
        values = [demo.metrics[f"texture_sweep.{level}_percent.{name}"] for level in levels]
        assert (sign * np.diff(values) > 0).all(), (name, values)


def test_winds_from_backscatter(demo):
    for name in ("v", "w"):
        assert demo.metrics[f"backscatter.cc.rmse_{name}"] < 1.0
        # 0.1 px of 5 m/s: the bias must be small against it
        assert abs(demo.metrics[f"backscatter.cc.bias_{name}"]) < 0.1
        beyond = demo.metrics[f"backscatter.cc.outside_cores.rmse_{name}"]
        assert beyond < demo.metrics[f"backscatter.cc.rmse_{name}"]
    assert demo.metrics["backscatter.cc.valid_fraction"] > 0.75


def test_every_step_of_the_instrument_costs(demo):
    """Extinction, the same blurred by the beam, with photon noise: each is a poorer image of the
    same air, so over all vectors each gives worse winds. The noise costs little at 64 photons:
    0.5 % a pixel against a texture of 10 %."""
    for name in ("v", "w"):
        ideal, blurred, seen = (
            demo.metrics[f"{source}.cc.all.rmse_{name}"]
            for source in ("extinction", "extinction_blurred", "backscatter")
        )
        assert ideal < blurred < seen < 1.1 * blurred
        assert demo.metrics[f"extinction_without_texture.cc.all.rmse_{name}"] > 2 * seen


def test_noise_of_the_pictures(demo):
    """16 photons a beam are to give 1 % a pixel, so 64 give 0.5 %; a tenth more for the slab's
    structure within the beam."""
    assert demo.metrics["backscatter.mc_relative_error"] < 0.0055


def test_multiple_scattering_is_a_small_share(demo):
    """Light scattered twice has met another 0.1 / km on 500 m: a share of 0.05 if all of it came
    back through the field of view, which takes in 2.5 m of those 500 m."""
    assert 0 < demo.metrics["backscatter.multiple_scattering_fraction"] < 0.05


def test_the_cores_are_those_of_the_wake(demo):
    """y = +-23.4 m at z = -60.4 m, which lies 0.4 m below the domain's middle."""
    for side, sign in (("port", 1), ("starboard", -1)):
        core = {q: demo.metrics[f"wake.{side}_core.{q}"] for q in ("y", "z", "circulation")}
        assert core["y"] == pytest.approx(sign * 23.4, abs=0.5)
        assert core["z"] == pytest.approx(-0.4, abs=0.5)
        assert np.sign(core["circulation"]) == sign


def test_the_air_between_the_vortices_moves_down(demo):
    """Seen in the pictures, not in the truth: the port vortex (y > 0) has omega_x > 0, so air
    sinks inboard, rises outboard and drifts to starboard above the core."""
    with xr.open_dataset(demo.folder / "wind.nc") as wind:
        seen = wind.sel(source="backscatter", algorithm="cc")
        seen = seen.where(seen["flag"] == 0)

        def mean(name, y, z):
            return float(seen[name].sel(y=slice(*y), z=slice(*z)).mean())

        assert mean("w", (-10, 10), (-10, 10)) < -4  # -4 w0 = -6.2 m/s midway, at age 0
        assert mean("w", (30, 40), (-5, 5)) > 2
        assert mean("w", (-40, -30), (-5, 5)) > 2
        assert mean("v", (19, 27), (6, 14)) < -3
        assert mean("v", (-27, -19), (6, 14)) > 3


def test_swapped_pictures_turn_the_wind_round(demo):
    pair = on_one_grid(*(read_scan(demo.folder / name)["Y"] for name in IMAGES))
    forth = retrieve_wind(*pair, dt=0.1, stride=4)
    back = retrieve_wind(*pair[::-1], dt=0.1, stride=4)
    both = ((forth["flag"] == 0) & (back["flag"] == 0)).values
    for name in ("v", "w"):
        one, other = forth[name].values[both], back[name].values[both]
        # independent errors of 0.9 m/s on winds of 3 m/s leave a correlation of 0.92
        assert np.corrcoef(one, other)[0, 1] < -0.9
        assert np.sqrt(np.mean((one + other) ** 2)) < np.sqrt(2) * 0.9


# ---------------------------------------------------------------- the picture against a blur


def footprint_mean(image, lidar, distance, count=4096):
    """The image seen by beams, by brute force: photons of the laser's profile and divergence,
    the air linear between nodes. Shares nothing with the package."""
    u = qmc.Sobol(4, seed=1).random(count)
    inside = 1 - np.exp(-2 * (lidar.beam_cut / lidar.beam_radius) ** 2)
    r = lidar.beam_radius * np.sqrt(-0.5 * np.log1p(-u[:, 0] * inside))
    # 1/e^2 half angle of a Gaussian = two standard deviations
    spread = lidar.divergence_full / 4 * distance
    dy = r * np.cos(2 * np.pi * u[:, 1]) + spread * norm.ppf(u[:, 2])
    dz = r * np.sin(2 * np.pi * u[:, 1]) + spread * norm.ppf(u[:, 3])
    y, z = image["y"].values, image["z"].values
    air = RegularGridInterpolator((z, y), image.values)
    zz, yy = np.meshgrid(z[6:-6], y[6:-6], indexing="ij")
    return sum(air((zz + b, yy + a)) for a, b in zip(dy, dz)) / count


@pytest.fixture
def rough():
    rng = np.random.default_rng(3)
    y, z = np.arange(40) * 0.5, np.arange(30) * 0.5
    return xr.DataArray(1 + 0.2 * rng.random((30, 40)), {"z": z, "y": y}, ("z", "y"))


@pytest.mark.parametrize(
    "lidar, distance",
    [
        (BackscatterLidar(), 501.25),
        (BackscatterLidar(), 100.0),
        (BackscatterLidar(divergence_full="0.5 mrad", beam_radius=0.3, beam_cut=0.6), 300.0),
    ],
)
def test_blur_by_beam_is_the_mean_over_the_footprint(rough, lidar, distance):
    """White structure, the hardest case. 4096 quasi-random photons average it to about 2e-4; the
    aperture is no Gaussian, which costs as much where it is as wide as the cells."""
    blurred = blur_by_beam(rough, lidar, distance).values[6:-6, 6:-6]
    np.testing.assert_allclose(blurred, footprint_mean(rough, lidar, distance), atol=6e-4)
    assert np.std(blurred) < 0.9 * np.std(rough.values)


def test_blur_by_beam_keeps_even_and_linear_air(rough):
    linear = rough.copy(data=2 + 0.3 * rough["y"].values - 0.1 * rough["z"].values[:, None])
    blurred = blur_by_beam(linear, BackscatterLidar(), 501.25)
    np.testing.assert_allclose(blurred.values[6:-6, 6:-6], linear.values[6:-6, 6:-6], rtol=1e-12)


def test_picture_is_the_blurred_extinction_within_its_standard_errors():
    """Single scattering by the textured wake against theory, at both times, pixel by pixel.

    Y = 3/(8 pi) x extinction seen by the beam x exp(-2 (extinction - environment) x way in the
    slab). Expected deviations: the pixels' own standard errors. Those are honest on average but
    small where the value came out small (rare null collisions), so the ratio of sums is taken:
    its scatter is (2/25000)^(1/2) = 0.01. What the theory leaves out (smear of oblique beams over
    the depth, attenuation by structure) is 0.05 % of a pixel, 0.01 of the noise's square here. A
    mirrored axis gives a ratio of 1e4, blur by the bare Gaussian 20.
    """
    use_variant("llvm_ad_mono_polarized")
    plan_of, lidar, environment = Scan(), BackscatterLidar(), 1e-4
    truth = make_truth(config.load(SCENES / "wake_backscatter.yaml"), SCENES)
    axes = (truth.wind["y"].values, truth.wind["z"].values)
    plans = plan_scans(plan_of, *axes, (0.0, 15.0))
    solids = [
        extrude(field.isel(x=0).transpose("z", "y"), plans[0], lidar) for field in truth.extinction
    ]
    way = float(solids[0]["x"].attrs["cell_width"]) / 2
    seeds = range(4)
    sums, squares = [0, 0], [0, 0]
    for seed in seeds:
        settings = RenderSettings(samples_per_beam=64, max_order=1)
        phase = {"type": "rayleigh_polarized"}
        scans = render_scans(solids, plans, lidar, environment, phase, 1.0, settings, seed)
        for k, scan in enumerate(scans):
            relative = (scan["S0_stderr"] / scan["S0"]).values[0]
            sums[k] = sums[k] + scan["Y"].values / len(seeds)
            squares[k] = squares[k] + (scan["Y"].values * relative / len(seeds)) ** 2
    inner = (slice(6, -6), slice(6, -6))
    for k in (0, 1):
        air = blur_by_beam(truth.image(k), lidar, plans[k].centre).values
        theory = 3 / (8 * np.pi) * air * np.exp(-2 * (air - environment) * way)
        z_square = ((sums[k] / theory - 1) ** 2)[inner]
        noise = (squares[k] / theory**2)[inner]
        assert z_square.sum() / noise.sum() == pytest.approx(1, abs=0.05)
        # and no offset: standard error of the mean over all pixels is 2e-5
        assert (sums[k] / theory)[inner].mean() == pytest.approx(1, abs=2e-4)


# ---------------------------------------------------------------- a blob on its way


@pytest.fixture(scope="module")
def blob_run(tmp_path_factory):
    """A bright blob at y = 8.25 m, z = -3.75 m (port, below; the middle of a template, between
    pixels), carried by v = 10, w = 5 m/s."""
    beside = tmp_path_factory.mktemp("blob")
    name = write_wake(beside / "a <b>blob & more.nc", blob(8.25, -3.75))
    data = {
        "name": "blob",
        "wake": {"file": name, "texture": {"rms": 0}},
        "render": {"samples_per_beam": 256, "max_order": 1},
    }
    with without_figures():
        run(check(data), beside / "run", beside)
    return beside / "run"


def test_blob_is_where_it_should_be_in_the_exr(blob_run):
    """Top row = largest z (15 m), left column = largest y (20 m), 0.5 m a pixel; t2 one metre to
    port and half a metre up. 0.05 px allowed; noise moves the centroid by less than 0.01 px."""
    for name, (y, z) in zip(IMAGES, ((8.25, -3.75), (9.25, -3.25))):
        picture = as_seen(blob_run / name)
        assert picture.shape == (61, 81)
        bright = picture - np.median(picture)
        bright[bright < 0.02 * bright.max()] = 0
        row, column = ndimage.center_of_mass(bright)
        assert 20 - 0.5 * column == pytest.approx(y, abs=0.025)
        assert 15 - 0.5 * row == pytest.approx(z, abs=0.025)


@pytest.mark.parametrize("source", ["extinction", "extinction_blurred", "backscatter"])
def test_blob_moves_as_it_should_in_the_wind_file(blob_run, source):
    """0.05 px = 0.25 m/s for v and w. Weight shift: every vector on the blob. Cross-correlation:
    their mean, and the vector on the blob's middle; one beside it is off by up to 0.25 px, because
    a template that holds a slope alone has a lopsided correlation peak (three-point fit)."""
    with xr.open_dataset(blob_run / "wind.nc") as wind:
        for method in ("cc", "ws"):
            one = wind.sel(source=source, algorithm=method)
            distance = np.hypot(one["y_vector"] - 8.75, one["z_vector"] + 3.5).values
            valid = (one["flag"] == 0).values
            on_blob, middle = valid & (distance < 2.0), valid & (distance < 0.2)
            assert on_blob.sum() > 30 and middle.any()
            for name, true in (("v", 10.0), ("w", 5.0)):
                values = one[name].values
                assert values[on_blob].mean() == pytest.approx(true, abs=0.25)
                np.testing.assert_allclose(
                    values[on_blob if method == "ws" else middle], true, atol=0.25
                )
                np.testing.assert_allclose(one[f"{name}_true"].values[on_blob], true, atol=1e-6)


def test_air_without_structure_is_flagged(blob_run):
    """Far from the blob there is nothing to follow, not even in noise."""
    with xr.open_dataset(blob_run / "wind.nc") as wind:
        far = wind.sel(algorithm="cc", y=slice(None, -5.0))
        assert (far["flag"] != 0).all()


def test_names_of_files_are_escaped_in_the_report(blob_run):
    page = (blob_run / "report.html").read_text()
    assert "a &lt;b&gt;blob &amp; more.nc" in page
    assert "<b>" not in page


def test_no_vortex_no_core_metrics(blob_run):
    metrics = json.loads((blob_run / "metrics.json").read_text())
    assert not [key for key in metrics if key.startswith("wake.") or "outside_cores" in key]


# ---------------------------------------------------------------- other experiments


@pytest.fixture(scope="module")
def variation(tmp_path_factory):
    """The demo with some keys changed, single scattering and cross-correlation alone: folder and
    metrics."""

    def vary(*overrides):
        folder = tmp_path_factory.mktemp("variation") / "run"
        changed = config.load(
            SCENES / "wake_backscatter.yaml",
            ["retrieval.methods=[cc]", "render.max_order=1", *overrides],
        )
        with without_figures():
            return folder, run(changed, folder, SCENES)

    return vary


@pytest.fixture(scope="module")
def plain(variation):
    """What the variations are compared with."""
    return variation()


def test_second_snapshot_agrees_with_advection(plain, variation):
    """The state computed at 40.1 s against the one advected from 40.0 s. Without texture the
    change of the simulated extinction is known to follow -u grad(tracer) to a correlation of
    0.975 in all three dimensions; the plane lacks the part along x. Texture (and noise, 0.5 % a
    pixel) rides on top in the pictures."""
    changes = []
    for second in ("advect", "40.1 s"):
        bare = config.load(
            SCENES / "wake_backscatter.yaml", [f"wake.second={second}", "wake.texture.rms=0"]
        )
        truth = make_truth(bare, SCENES)
        changes.append((truth.image(1) - truth.image(0)).values.ravel())
    assert np.corrcoef(*changes)[0, 1] > 0.95
    assert np.polyfit(*changes, 1)[0] == pytest.approx(1, abs=0.1)

    folder, metrics = variation("wake.second=40.1 s")
    first = [as_seen(path / IMAGES[0]) for path in (plain[0], folder)]
    second = [as_seen(path / IMAGES[1]) for path in (plain[0], folder)]
    np.testing.assert_array_equal(*first)
    assert np.corrcoef(*((b - a).ravel() for a, b in zip(first, second)))[0, 1] > 0.98
    for name in ("v", "w"):
        key = f"backscatter.cc.rmse_{name}"
        assert metrics[key] == pytest.approx(plain[1][key], rel=0.1)


def test_detector_adds_a_noisy_picture_and_its_winds(variation):
    """Weak pulses by day: noise of the stated size in the pictures, worse winds, and a wide
    field of view lets in more sky than signal; strong pulses give the noise-free winds back."""
    weak = ["detector={}", "lidar.pulse_energy=1 mJ", "render.samples_per_beam=256"]
    folder, metrics = variation(*weak)
    for index in (0, 1):
        scan = read_scan(folder / IMAGES[index])
        z = (scan["S0_noisy"] - scan["S0"]) / scan["S0_noise_std"]
        # variance of 30 441 standard normal numbers: 1 +- 0.008
        assert float(z.var()) == pytest.approx(1, abs=0.04)
        assert abs(float(z.mean())) < 4 / np.sqrt(z.size)
        np.testing.assert_allclose(
            scan["Y_noisy"] / scan["Y"], (scan["S0_noisy"] / scan["S0"])[0], rtol=1e-4
        )
    assert metrics["detector.noise.all"] > 0.005
    for name in ("v", "w"):
        key = f"cc.rmse_{name}"
        assert metrics[f"backscatter_noisy.{key}"] > 1.02 * metrics[f"backscatter.{key}"]
    strong, again = variation("detector={}", "lidar.pulse_energy=1 J", "scan.aim=angles")
    assert again["detector.noise.all"] < 1e-3
    for name in ("v", "w"):
        key = f"cc.rmse_{name}"
        assert again[f"backscatter_noisy.{key}"] == pytest.approx(
            again[f"backscatter.{key}"], rel=0.01
        )
    with xr.open_dataset(strong / "wind.nc", engine="h5netcdf") as wind:
        assert wind["source"].values.tolist() == [*SOURCES, "backscatter_noisy"]


def test_aiming_by_angles_is_as_good(plain, variation):
    """The top row's beams are 0.7 m higher at t2 than at t1 (7 m/s if ignored); resampling must
    make up for it. 5 %: the seed alone moves the rmse by 2 %."""
    folder, metrics = variation("scan.aim=angles")
    top = [read_scan(folder / name)["z"].values[-1] for name in IMAGES]
    distances = (501.25, 486.25)
    np.testing.assert_allclose(
        top, [d * np.tan(np.radians(a)) for d, a in zip(distances, (3.9, 4.1))], rtol=1e-6
    )
    assert top[1] - top[0] == pytest.approx(0.68, abs=0.01)
    for name in ("v", "w"):
        key = f"backscatter.cc.rmse_{name}"
        assert metrics[key] == pytest.approx(plain[1][key], rel=0.05)
        assert abs(metrics[f"backscatter.cc.bias_{name}"]) < 0.1


def test_vortex_pair(tmp_path):
    """No file at all: analytic flow, even air, texture only. With figures, whose sweep meets air
    without any structure and so without any vector."""
    metrics = run(check(small()), tmp_path / "run")
    drawn = {path.stem for path in (tmp_path / "run" / "figures").iterdir()}
    assert drawn == FIGURES - {"fig15_multiple_scattering"}
    # Lamb-Oseen: 1 - e^-1.2564 of 150 m^2/s at the core radius of 2 m
    for side, sign in (("port", 1), ("starboard", -1)):
        assert metrics[f"wake.{side}_core.y"] == pytest.approx(8 * sign, abs=0.1)
        assert metrics[f"wake.{side}_core.radius"] == pytest.approx(2, abs=0.13)
        assert metrics[f"wake.{side}_core.circulation"] == pytest.approx(
            sign * 150 * (1 - np.exp(-1.2564)), rel=0.01
        )
    assert metrics["texture_sweep.0_percent.valid_fraction"] == 0
    assert "texture_sweep.0_percent.rmse_v" not in metrics
    # beyond the steep cores (angular velocity 12 s^-1) good texture gives 0.1 px = 0.5 m/s
    for name in ("v", "w"):
        assert metrics[f"extinction.cc.outside_cores.rmse_{name}"] < 0.5
        assert metrics[f"backscatter.cc.outside_cores.rmse_{name}"] < 1.0


def test_extinction_from_speed_and_spherical_gates(tmp_path, quick):
    data = small(extinction={"source": "speed"}, texture={"rms": 0})
    data["scan"] = {"gates": "spherical"}
    run(check(data), tmp_path / "run")
    scan = read_scan(tmp_path / "run" / IMAGES[0])
    assert scan.attrs["gate_kind"] == "spherical"
    image = make_truth(check(data)).image(0)
    assert float(image.max() / image.min()) > 3
    # Y = 3/(8 pi) x extinction but for 0.4 % lost in the slab; noise 1.5 % a pixel at 8 photons
    ratio = scan["Y"].values / blur_by_beam(image, BackscatterLidar(), 501.25).values
    assert ratio.mean() == pytest.approx(3 / (8 * np.pi), rel=0.005)
    assert ratio.std() < 0.03 * ratio.mean()


def test_volume_shows_the_planes_in_the_gate(tmp_path, quick):
    """Planes of 1 m: a port blob for x > 6 m, a starboard one for x < 4 m. A gate of 2.5 m around
    x = 8 m holds only the first, around x = 2 m only the second."""
    x = np.arange(0.5, 10, 1.0)
    port, starboard = blob(8.0, 3.0), blob(-8.0, -3.0)
    name = write_wake(
        tmp_path / "volume.nc",
        lambda x, y, z: (x > 6) * port(y, z) + (x < 4) * starboard(y, z),
        x=x,
    )
    for plane, (row, column) in ((8.0, (24, 24)), (2.0, (36, 56))):
        data = small()
        data["wake"] = {"file": name, "depth": "volume", "x": plane, "texture": {"rms": 0}}
        folder = tmp_path / f"run{plane:g}"
        run(check(data), folder, tmp_path)
        picture = as_seen(folder / IMAGES[0])
        dark = np.median(picture)
        peak = np.unravel_index(picture.argmax(), picture.shape)
        assert np.hypot(peak[0] - row, peak[1] - column) < 2
        assert picture[row, column] > 5 * dark
        # the other blob, mirrored through the middle, is not there
        assert picture[60 - row, 80 - column] < 1.3 * dark
        with xr.open_dataset(folder / "wind.nc") as wind:
            one = wind.sel(source="extinction", algorithm="cc")
            valid = (one["flag"] == 0).values
            assert one["v"].values[valid].mean() == pytest.approx(10.0, abs=0.25)
            assert one["w"].values[valid].mean() == pytest.approx(5.0, abs=0.25)


def test_volume_needs_a_plane_when_one_is_to_be_extruded(tmp_path):
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 4))
    data = small()
    data["wake"] = {"file": name}
    with pytest.raises(InputError, match=r"wake\.x: missing; v\.nc has 4 planes"):
        run(check(data), tmp_path / "run", tmp_path)


def test_gates_that_reach_beyond_the_wake(tmp_path):
    """The first of four planes of 1 m in the middle of 2.5 m gates: they begin 0.75 m before it."""
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 4))
    data = small()
    data["wake"] = {"file": name, "depth": "volume", "x": 0.5, "texture": {"rms": 0}}
    with pytest.raises(InputError, match="gates from 500 to 502.5 m .* fill 500.75 to 504.75 m"):
        run(check(data), tmp_path / "run", tmp_path)
    assert not (tmp_path / "run").exists()


def test_volume_picture_is_the_mean_over_the_gate(tmp_path, quick):
    """As for the plane, in three dimensions: structure that differs from plane to plane (texture
    of 20 %), gates of 2.5 m across planes of 1 m. Equal weights for the two planes inside the
    gates give a ratio of 22."""
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 8))
    data = small() | {"render": {"samples_per_beam": 256, "max_order": 1}}
    data["wake"] = {"file": name, "depth": "volume", "texture": {"rms": 0.2, "outer_scale": "4 m"}}
    run(check(data), tmp_path / "run", tmp_path)
    truth = make_truth(check(data), tmp_path)
    scan = read_scan(tmp_path / "run" / IMAGES[0])
    air = blur_by_beam(truth.image(0), BackscatterLidar(), 501.25).values
    # the whole of the slab before the gates' middle, 4 m of 8
    before = truth.extinction[0].isel(x=slice(0, 4)).mean("x").transpose("z", "y").values
    theory = 3 / (8 * np.pi) * air * np.exp(-2 * (before - 1e-4) * 4)
    inner = (slice(6, -6), slice(6, -6))
    relative = (scan["S0_stderr"] / scan["S0"]).values[0][inner]
    error = (scan["Y"].values / theory - 1)[inner]
    # scatter of the ratio 0.03; oblique beams cross the planes up to 0.05 m beside their nodes
    assert (error**2).sum() / (relative**2).sum() == pytest.approx(1, abs=0.15)
    assert error.mean() == pytest.approx(0, abs=2e-3)


@pytest.mark.slow
def test_whole_simulation_as_a_volume(tmp_path, quick):
    """40 m of the simulation the sample plane was cut from, structure in all three dimensions:
    winds as good as from the plane."""
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not (data / "wake_les_40s.nc").is_file():
        pytest.skip("wake_les_40s.nc, 40 m of the wake, is not here")
    volume = {
        "name": "volume",
        "wake": {"file": "wake_les_40s.nc", "time": "40 s", "depth": "volume"},
        "retrieval": {"methods": ["cc"]},
    }
    metrics = run(check(volume), tmp_path / "run", data)
    for name in ("v", "w"):
        assert metrics[f"extinction.cc.rmse_{name}"] < 0.8
        assert metrics[f"backscatter.cc.rmse_{name}"] < 1.0
    assert metrics["wake.port_core.y"] == pytest.approx(23.4, abs=0.5)
    assert metrics["wake.starboard_core.y"] == pytest.approx(-23.4, abs=0.5)


# ---------------------------------------------------------------- going on, and repeating


def pictures_of(folder):
    return [(folder / name).stat().st_mtime_ns for name in IMAGES]


def layers(folder):
    return [read_scan(folder / name).drop_attrs() for name in IMAGES]


def without_timing(metrics):
    return {key: value for key, value in metrics.items() if not key.startswith("timing.")}


def test_a_rerun_uses_the_pictures(tmp_path, quick):
    folder = tmp_path / "run"
    before = run(check(small()), folder)
    stamps = pictures_of(folder)
    (folder / "wind.nc").unlink()
    after = run(check(small()), folder)
    assert pictures_of(folder) == stamps
    assert "using 2 of 2 pictures" in (folder / "log.txt").read_text()
    assert (folder / "wind.nc").is_file()
    assert without_timing(after) == without_timing(before)


def test_a_missing_picture_is_rendered_again_and_the_same(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    stamps, before = pictures_of(folder), layers(folder)
    (folder / IMAGES[1]).unlink()
    run(check(small()), folder)
    assert pictures_of(folder)[0] == stamps[0] and pictures_of(folder)[1] != stamps[1]
    for one, other in zip(before, layers(folder)):
        xr.testing.assert_identical(one, other)


def test_another_experiment_is_kept_out(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    stamps = pictures_of(folder)
    other = small() | {"seed": 2}
    with pytest.raises(InputError, match="another experiment"):
        run(check(other), folder)
    assert pictures_of(folder) == stamps
    run(check(other), folder, overwrite=True)
    assert all(new != old for new, old in zip(pictures_of(folder), stamps))
    assert yaml.safe_load((folder / "experiment.yaml").read_text())["experiment"]["seed"] == 2


def test_pictures_of_another_version_are_kept_out(tmp_path, quick):
    folder = tmp_path / "run"
    run(check(small()), folder)
    record = yaml.safe_load((folder / "experiment.yaml").read_text())
    record["versions"]["mitsuba"] = "3.5.0"
    (folder / "experiment.yaml").write_text(yaml.safe_dump(record))
    stamps = pictures_of(folder)
    with pytest.raises(InputError, match="a run of mitsuba 3.5.0, this is 3.*; expected"):
        run(check(small()), folder)
    assert pictures_of(folder) == stamps
    run(check(small()), folder, overwrite=True)
    assert pictures_of(folder) != stamps
    record["versions"]["numpy"] = "1.0"  # which makes no pictures
    run(check(small()), folder)


def test_a_changed_wake_file_is_another_experiment(tmp_path, quick):
    """Same name, other content: the old pictures must not be taken for it."""
    data = small()
    data["wake"] = {"file": write_wake(tmp_path / "w.nc", blob(8, -4)), "texture": {"rms": 0}}
    run(check(data), tmp_path / "run", tmp_path)
    run(check(data), tmp_path / "run", tmp_path)
    write_wake(tmp_path / "w.nc", blob(8, 4))
    with pytest.raises(InputError, match="another experiment"):
        run(check(data), tmp_path / "run", tmp_path)


def test_overwriting_leaves_nothing_of_the_old_run(tmp_path, quick):
    """Stopped right after it began, the folder must not show the old winds as its own."""
    folder = tmp_path / "run"
    run(check(small()), folder)

    def stop(text, share):
        if "rendering" in text:
            raise KeyboardInterrupt

    with pytest.raises(BaseException):  # noqa: B017 - Dr.Jit wraps what is raised inside
        run(check(small() | {"seed": 2}), folder, overwrite=True, notice=stop)
    assert not {"wind.nc", "metrics.json", "report.html"} & {p.name for p in folder.iterdir()}


@pytest.mark.parametrize("content", ["my_thesis.txt", "experiment.yaml"])
def test_a_folder_that_is_no_run_folder_is_refused(tmp_path, content):
    (tmp_path / content).write_text("name: mine\n")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="run folder|not written by a run"):
            run(check(small()), tmp_path, overwrite=overwrite)
    assert [p.name for p in tmp_path.iterdir()] == [content]


def test_a_file_in_the_folders_place_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(InputError, match="no run folder"):
        run(check(small()), tmp_path / "run")


@pytest.mark.parametrize(
    "step", ["reading the wake", "rendering scan 1", "rendering scan 2", "retrieving winds"]
)
def test_stopped_anywhere_it_goes_on(tmp_path, quick, step):
    """An interrupt at any step leaves whole files only, and the next start ends as if nothing had
    happened."""
    folder = tmp_path / "run"

    def stop(text, share):
        if step in text:
            raise KeyboardInterrupt

    with pytest.raises(BaseException) as caught:
        run(check(small()), folder, notice=stop)
    causes, error = [], caught.value
    while error is not None:
        causes.append(type(error))
        error = error.__cause__ or error.__context__
    assert KeyboardInterrupt in causes
    done = [folder / name for name in IMAGES if (folder / name).is_file()]
    for path in done:
        read_scan(path)
    assert leftovers(folder) == [] and not (folder / "metrics.json").exists()
    stamps = [path.stat().st_mtime_ns for path in done]
    metrics = run(check(small()), folder)
    assert [path.stat().st_mtime_ns for path in done] == stamps
    expected = {
        "reading the wake": 0,
        "rendering scan 1": 0,
        "rendering scan 2": 1,
        "retrieving winds": 2,
    }[step]
    assert len(done) == expected
    assert without_timing(metrics) == without_timing(run(check(small()), tmp_path / "whole"))


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    data = xr.Dataset({"v": ("y", [1.0, 2.0])})
    run_folder.write_netcdf(data, tmp_path / "wind.nc")

    def half(self, path, **_):
        path.write_bytes(b"half a fi")
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_netcdf", half)
    with pytest.raises(KeyboardInterrupt):
        run_folder.write_netcdf(data * 2, tmp_path / "wind.nc")
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["wind.nc"]
    with xr.open_dataset(tmp_path / "wind.nc") as kept:
        assert kept["v"].values.tolist() == [1.0, 2.0]


def test_the_seed_decides(tmp_path, quick):
    runs = {}
    for name, seed in (("one", 1), ("again", 1), ("other", 2)):
        metrics = run(check(small() | {"seed": seed}), tmp_path / name)
        runs[name] = (without_timing(metrics), layers(tmp_path / name))
    assert runs["one"][0] == runs["again"][0]
    for same, again, other in zip(*(runs[name][1] for name in ("one", "again", "other"))):
        xr.testing.assert_identical(same, again)
        # other texture and other photons
        assert not np.array_equal(same["S0"], other["S0"])
    assert runs["one"][0] != runs["other"][0]


def test_a_run_that_fails_says_so_in_its_log(tmp_path, quick, monkeypatch):
    """And one that is stopped does not; see `test_stopped_anywhere_it_goes_on`."""
    folder = tmp_path / "run"

    def broken(*_):
        raise InputError("wind: 7 is not allowed;\nexpected 8")

    with monkeypatch.context() as patch:
        patch.setattr(backscatter_chain, "winds", broken)
        with pytest.raises(InputError):
            run(check(small()), folder)
    assert run_folder.failure(folder) == "wind: 7 is not allowed; expected 8"
    run(check(small()), folder)
    assert run_folder.failure(folder) is None


def test_beams_wider_than_a_template_are_told_of(tmp_path, quick):
    """At 5 km the paper's beam is 10 m wide, a template 4 m: nothing is left to follow, and the
    report says so."""
    told = []
    data = small() | {"scan": {"range": "5 km"}}
    metrics = run(check(data), tmp_path / "run", notice=lambda text, _: told.append(text))
    warnings = [text for text in told if text.startswith("warning: ")]
    assert len(warnings) == 2
    assert "beams are 10 m wide at 5001" in warnings[0] and "template of 4 m" in warnings[0]
    assert "backscatter, cc: no vector is valid; " in warnings[1] and "flag low_" in warnings[1]
    assert metrics["backscatter.cc.valid_fraction"] == 0
    page = (tmp_path / "run" / "report.html").read_text()
    log = (tmp_path / "run" / "log.txt").read_text()
    for text in warnings:
        assert text.removeprefix("warning: ") in page and text in log


def test_air_without_vortices_is_told_of(tmp_path, quick):
    """Nothing turns: the report says that, and shows the rest."""
    data = small(texture={"rms": 0.3, "outer_scale": "5 m"})
    data["wake"]["vortex_pair"]["circulation"] = 1e-3
    data["retrieval"] = {"methods": ["vortex_fit"]}
    metrics = run(check(data), tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Warning: no vortex pair from the images: " in page
    assert "No pair from the images: " in page and "How well the vortices are known" in page
    assert not [key for key in metrics if key.startswith("vortex.")]
    assert read_vortices(tmp_path / "run" / "vortex.json") == {}
    assert "vortex fit" in page


def test_true_wind_is_as_strong_as_it_is(tmp_path, quick):
    """A uniform wind of 10 and 5 m/s: an error of as much is no skill."""
    data = small()
    data["wake"] = {"file": write_wake(tmp_path / "w.nc", blob(8, -4)), "texture": {"rms": 0}}
    metrics = run(check(data), tmp_path / "run", tmp_path)
    assert metrics["true_wind.rms_v"] == pytest.approx(10)
    assert metrics["true_wind.rms_w"] == pytest.approx(5)
    assert "true_wind.outside_cores.rms_v" not in metrics


@pytest.mark.parametrize(
    "change, words",
    [
        ({"lidar": {"divergence_full": "0.4 rad"}, "scan": {"range": "50 km"}}, "scan.range: 500"),
        ({"lidar": {"pulse_duration": "10 ns"}, "detector": {"line_width": "1 MHz"}}, "line_width"),
        ({"scattering": {"phase": "table", "table": "no.txt"}}, "scattering.table: .*no.txt"),
        ({"retrieval": {"template": 30, "search": 60}}, "search: 60 px"),
        ({"scattering": {"albedo": 0}}, "albedo"),
        ({"wake": small(extinction={"background": 0})["wake"]}, "wake.extinction: 0 everywhere"),
        ({"wake": {"file": "no.nc"}}, "wake.file: no.nc not found"),
        ({"wake": {"file": "text.nc"}}, "text.nc: is not NetCDF"),
    ],
)
def test_bad_input_is_told_before_anything_is_written(tmp_path, change, words):
    (tmp_path / "text.nc").write_text("no NetCDF")
    with pytest.raises(InputError, match=words) as caught:
        run(check(small() | change), tmp_path / "run", tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()
