"""What limits the wind. Detects a share that goes to the wrong cause, 5 % in a share, noise drawn
anew instead of taken away, a chord or a window's mean off by 1 %, other vectors with a cause than
without."""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from lidar_mi.assessment.figures.error_budget import draw_all
from lidar_mi.assessment.metrics.error_budget import (
    CAUSES,
    chord_wind,
    error_budget,
    image_scale,
    images_without,
    moved_rigidly,
    window_mean,
)
from lidar_mi.assessment.report.error_budget import budget_chapter, limit_sentence
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array, plane_waves, texture

DT, H = 0.1, 0.5


def field(values):
    rows, columns = values.shape
    return data_array(values, *axes(columns, rows, H))


def flow(v, w, columns=81, rows=61):
    y, z = np.meshgrid(*axes(columns, rows, H))
    return xr.Dataset({"v": field(v(y, z) + 0 * y), "w": field(w(y, z) + 0 * y)})


def winds(v, w, method="variational", flag=None, template=8):
    """As retrieved: vectors at the nodes."""
    found = xr.Dataset({"v": field(v), "w": field(w)})
    found["flag"] = found["v"].dims, np.zeros(v.shape, np.uint8) if flag is None else flag
    z, y = np.meshgrid(found["z"], found["y"], indexing="ij")
    found = found.assign_coords(y_vector=(("z", "y"), y), z_vector=(("z", "y"), z))
    return found.assign_attrs(method=method, template=template, dt=DT)


# --- images


def pairs(count, seed=1):
    rng = np.random.default_rng(seed)
    return [[field(rng.random((20, 30))) for _ in range(2)] for _ in range(count)]


def test_each_cause_is_taken_away_and_all_else_stays():
    air, blur, photons, counts, shear = pairs(5)
    blurred = [a + b for a, b in zip(air, blur, strict=True)]
    rendered = [a + b for a, b in zip(blurred, photons, strict=True)]
    observed = [a + b for a, b in zip(rendered, counts, strict=True)]
    advected = [a + b for a, b in zip(blurred, shear, strict=True)]
    found = images_without(observed, blurred, air, rendered, advected)
    for k in (0, 1):
        expected = {
            "detector_noise": air[k] + blur[k] + photons[k],
            "monte_carlo": air[k] + blur[k] + counts[k],
            "beam_blur": air[k] + photons[k] + counts[k],
            "slab": air[k] + blur[k] + photons[k] + counts[k] + shear[k],
        }
        assert set(found) == set(expected) < set(CAUSES)
        for cause, image in expected.items():
            np.testing.assert_allclose(found[cause][k], image, rtol=1e-12)


def test_without_detector_and_depth_there_are_two_causes():
    air, blurred, observed = pairs(3)
    found = images_without(observed, blurred, air)
    assert set(found) == {"monte_carlo", "beam_blur"}
    np.testing.assert_allclose(found["monte_carlo"][1], blurred[1], rtol=1e-12)


def test_image_scale_fits_gain_and_offset_with_nonuniform_noise():
    rng = np.random.default_rng(2)
    (air,) = pairs(1)
    noise = [field(1e-9 * (1 + 50 * rng.random((20, 30)))) for _ in range(2)]
    image = [3e-6 * a + 2e-7 + rng.normal(0, n) for a, n in zip(air, noise, strict=True)]
    gain, offset = image_scale(air, image, noise)
    # weighted: the 5 % of pixels with noise below 3.5e-9 alone would give 2e-9 for the gain
    assert gain == pytest.approx(3e-6, abs=4e-9) and offset == pytest.approx(2e-7, abs=4e-9)
    even = [field(np.full((20, 30), 2.0))] * 2
    assert image_scale(even, [3 * e for e in even], noise) == pytest.approx((3.0, 0.0))


# --- what a vector means


def test_chord_of_a_solid_rotation():
    """Closed form: wind at the chord's middle times tan(a) / a, a half the angle turned in dt."""
    rate = 8.0
    truth = flow(lambda y, z: -rate * z, lambda y, z: rate * y)
    y, z = np.array([[3.0, -7.0], [0.5, np.nan]]), np.array([[1.0, 4.0], [0.0, 1.0]])
    v, w = chord_wind(truth, y, z, DT)
    stretch = np.tan(rate * DT / 2) / (rate * DT / 2)
    assert stretch == pytest.approx(1.057, abs=1e-3)
    np.testing.assert_allclose(v, -rate * z * stretch + 0 * y, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(w, rate * y * stretch, rtol=1e-4, atol=1e-6)


def test_chords_agree_with_their_series_in_time():
    """Second order in the time step, h = dt / 2: u + h^2 (j / 6 - (a . grad) u / 2) of the
    acceleration a = (u . grad) u and j = (u . grad) a, by differences; the rest is of fourth
    order."""
    pair = (Vortex(400.0, 3.0, -8.0, 0.5), Vortex(-400.0, 3.0, 8.0, 0.0))
    axis = np.arange(-100, 101) * 0.2
    y, z = np.meshgrid(axis, axis)
    truth = xr.Dataset(
        {
            n: xr.DataArray(x, {"z": axis, "y": axis}, ("z", "y"))
            for n, x in zip("vw", velocity(pair, y, z), strict=True)
        }
    )
    places = np.meshgrid(np.linspace(-12, 12, 25), np.linspace(-6, 6, 13))

    def along(of, by, y, z, step=1e-3):
        """(by . grad) of, by central differences."""
        ahead, behind = (of(y + s * by[0], z + s * by[1]) for s in (step, -step))
        return (ahead - behind) / (2 * step)

    def u(y, z):
        return np.stack(velocity(pair, y, z))

    def a(y, z):
        return along(u, u(y, z), y, z)

    h = DT / 2
    j = along(a, u(*places), *places)
    series = h**2 * (j / 6 - along(u, a(*places), *places) / 2)
    found = np.stack(chord_wind(truth, *places, DT)) - u(*places)
    rms = np.sqrt((series**2).mean())
    assert rms > 0.05
    # in the middle of a core, which turns by 0.44 in h, the next term is 0.4 * 0.44^2 of this one
    assert np.sqrt(((found - series) ** 2).mean()) < 0.08 * rms


def test_window_means_of_a_curved_wind():
    """A parabola over n pixels: the box adds h^2 (n^2 - 1) / 12 of half its curvature, a Gaussian
    its variance."""
    truth = flow(lambda y, z: y**2, lambda y, z: 0.5 * z**2 + y * z)
    box = window_mean(truth, 8, "cc").interp(y=3.0, z=-2.0)
    assert float(box["v"]) == pytest.approx(9 + H**2 * 63 / 12, rel=0.01)
    assert float(box["w"]) == pytest.approx(2 - 6 + H**2 * 63 / 24, rel=0.05)
    bell = window_mean(truth, 6, "multipass").sel(y=3.0, z=-2.0)
    assert float(bell["v"]) == pytest.approx(9 + (2 * H) ** 2, rel=1e-3)
    assert window_mean(truth, 8, "variational") is None
    np.testing.assert_allclose(window_mean(truth, 8, "cc")["z"].diff("z"), H)


# --- shares


def test_fractions_of_independent_errors_are_those_of_their_variances():
    """Errors of variance 4, 1 and 0.25 (v): shares 4/5.25 and 1/5.25; 4 sigma of 4941 vectors."""
    rng = np.random.default_rng(3)
    parts = {
        name: scale * rng.standard_normal((2, 61, 81))
        for name, scale in (("detector_noise", 2.0), ("monte_carlo", 1.0), ("rest", 0.5))
    }
    truth = flow(lambda y, z: 5 + 0 * y, lambda y, z: -2 + 0 * y)
    total = sum(parts.values())
    shift = np.array([5.0, -2.0])[:, None, None]
    found = winds(*(total + shift))
    without = {n: winds(*(total - parts[n] + shift)) for n in ("detector_noise", "monte_carlo")}
    budget = error_budget(found, without, truth, [Core(-5.0, 0.0, 3.0, 300.0)])
    assert budget["vectors"] == 61 * 81 > budget["outside_cores.vectors"] > 0.8 * 61 * 81
    for place in ("", "outside_cores."):
        assert budget[f"{place}rmse_v"] == pytest.approx(5.25**0.5, rel=0.04)
        for cause, fraction in (("detector_noise", 4 / 5.25), ("monte_carlo", 1 / 5.25)):
            for key in ("fraction_v", "fraction_w", "fraction"):
                assert budget[f"{place}{cause}.{key}"] == pytest.approx(fraction, abs=0.06)


def test_a_cause_that_reduces_errors_has_a_negative_fraction_and_vectors_are_the_same():
    v, w = np.full((10, 12), 1.0), np.zeros((10, 12))
    flag = np.zeros((10, 12), np.uint8)
    flag[0] = 4
    found = winds(v, w - 1, flag=flag)
    worse = winds(v + 1, w - 1)
    worse["v"][1] = np.nan
    truth = flow(lambda y, z: 0 * y, lambda y, z: 0 * y, 12, 10)
    budget = error_budget(found, {"beam_blur": worse}, truth, [])
    assert budget["vectors"] == 8 * 12
    assert budget["beam_blur.fraction_v"] == pytest.approx(1 - 4)
    assert budget["beam_blur.fraction_w"] == pytest.approx(0)
    assert budget["beam_blur.fraction"] == pytest.approx(1 - 5 / 2)
    assert not any(key.startswith("outside_cores") for key in budget)
    everything = error_budget(found, {"beam_blur": worse}, truth, [], flagged=True)
    assert everything["vectors"] == 9 * 12
    none = error_budget(found.assign(flag=found["flag"] + 1), {}, truth, [])
    assert none == {}


def test_the_cause_method_is_its_error_on_perfect_images():
    truth = flow(lambda y, z: y, lambda y, z: z)
    y, z = np.meshgrid(truth["y"], truth["z"])
    rng = np.random.default_rng(5)
    noise = 0.1 * rng.standard_normal(y.shape)
    budget = error_budget(
        winds(0.8 * y + noise, 0.8 * z + noise), {}, truth, [], perfect=winds(0.8 * y, 0.8 * z)
    )
    left = np.sqrt(np.mean(noise**2))
    assert budget["method.rmse_v"] == pytest.approx(left, rel=1e-9)
    assert budget["method.fraction"] > 0.98


# --- through the retrieval


WAVES = plane_waves(7, 3.0, H)


def advected(move, columns=81, rows=61):
    """Images at t1 and t2; `move` takes places dt back."""
    grid = np.meshgrid(*axes(columns, rows, H))
    return [field(texture(WAVES, *at)) for at in (grid, move(*grid))]


@pytest.mark.parametrize("method", ["cc", pytest.param("multipass", marks=pytest.mark.slow)])
def test_fraction_of_noise_is_the_scatter_of_winds_over_noise_draws(method):
    """Noise taken away as it fell, or drawn anew six times: its fraction of the error is the same.

    The difference of the two scatters by 0.02 over sets of six draws; four times that is allowed.
    """
    sharp = advected(lambda y, z: (y - 0.7 * H, z + 0.4 * H))
    blurred = [i.copy(data=gaussian_filter(i.values, 1.0, mode="nearest")) for i in sharp]
    rng = np.random.default_rng(29)
    noisy = [[i + 0.04 * rng.standard_normal(i.shape) for i in blurred] for _ in range(6)]
    truth = flow(lambda y, z: 0.7 * H / DT + 0 * y, lambda y, z: -0.4 * H / DT + 0 * y)
    windows = WindowSizes(stride=4)
    settings = {"dt": DT, "method": method, "windows": windows, "noise": 0.04}
    without = {"detector_noise": retrieve_wind(*blurred, **settings | {"noise": 0.0})}
    found = [retrieve_wind(*pair, **settings) for pair in noisy]
    budgets = [error_budget(one, without, truth, [], flagged=True) for one in found]
    error = np.array([b["rmse_v"] ** 2 + b["rmse_w"] ** 2 for b in budgets])
    fraction = np.average([b["detector_noise.fraction"] for b in budgets], weights=error)
    scatter = sum(np.nanmean(np.nanvar([one[n] for one in found], axis=0, ddof=1)) for n in "vw")
    assert fraction > 0.3
    assert fraction == pytest.approx(scatter / error.mean(), abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("shear", [pytest.param(0.0, marks=pytest.mark.slow), 4.0])
def test_shear_within_the_window(shear):
    """A simple shear (closed form) of 4 / s deforms a window of 8 px by 1.6 px on either side. With
    windows that move as one, correlation errs as in an even wind, by 0.13 px or
    0.65 m/s."""
    sharp = advected(lambda y, z: (y - DT * (5 + shear * z), z), 57, 41)
    rng = np.random.default_rng(4)
    observed = [i + 0.02 * rng.standard_normal(i.shape) for i in sharp]
    truth = flow(lambda y, z: 5 + shear * z, lambda y, z: 0 * y, 57, 41)
    found = retrieve_wind(*observed, DT, "cc", windows=WindowSizes(search=24))
    stiff = moved_rigidly(
        found,
        observed,
        sharp,
        truth,
        lambda pair, stride: retrieve_wind(
            *pair, DT, "cc", windows=WindowSizes(search=24, stride=stride)
        ),
    )
    budget = error_budget(found, {"shear": stiff}, truth, [], flagged=True)
    if shear:
        assert budget["rmse_v"] > 2 and budget["shear.fraction"] > 0.6
        assert budget["shear.rmse_v"] < 0.9
    else:
        # the same images but for the interpolation between pixels
        assert budget["shear.fraction"] == pytest.approx(0, abs=0.1)
        assert np.nanmedian(abs(stiff["v"] - found["v"])) < 0.02
    assert (
        moved_rigidly(found.assign_attrs(method="multipass"), observed, sharp, truth, None) is None
    )


# --- the report


def described(place="", **fractions):
    keys = {f"{place}rmse_v": 0.3, f"{place}rmse_w": 0.4}
    keys |= {f"{place}{cause}.{q}": 0.1 for cause in fractions for q in ("rmse_v", "rmse_w")}
    keys |= {f"{place}{cause}.fraction": x for cause, x in fractions.items()}
    return keys


def test_the_sentence_names_the_largest_causes_in_turn():
    metrics = described(beam_blur=0.2, detector_noise=0.7, window=0.01, method=-0.4)
    assert limit_sentence(metrics, "cc") == (
        "The wind by cross-correlation has an rms error of 0.35 m/s, limited by noise of the "
        "detector (70 % of the mean square error), then width of the beam (20 %)."
    )
    # beyond the cores where there are any; that noise of the simulation is not the lidar's is
    # reported
    both = described(beam_blur=0.9, detector_noise=0.1, monte_carlo=0.1)
    both |= described("outside_cores.", beam_blur=0.1, detector_noise=0.2, monte_carlo=0.5)
    text = limit_sentence(both, "cc")
    assert "beyond two core radii, limited by noise of the simulation (50 %" in text
    assert "render.samples_per_beam" in text


def test_a_budget_without_large_causes_is_reported():
    assert "no single cause has 10 %" in limit_sentence(described(beam_blur=0.05), "cc")
    assert "no vector is valid" in limit_sentence({}, "cc")


def test_causes_that_a_method_lacks_have_no_row():
    """A fit of whole images has no window, and so no row for what happens within one."""
    budgets = {"cc": described(beam_blur=0.2, window=0.1), "variational": described(beam_blur=0.2)}
    chapter = budget_chapter(budgets, [])
    correlated, fitted = ({row[0] for row in rows} for _, _, rows in chapter.numbers.tables)
    assert correlated - fitted == {"without: averaging over the window"}
    assert len(chapter.lead) == 2


def test_a_chapter_without_vectors_has_no_figure_and_dashes(tmp_path):
    assert draw_all(tmp_path, {"cc": {}}, None) == []
    chapter = budget_chapter({"cc": {}}, [])
    ((title, heads, rows),) = chapter.numbers.tables
    assert title == "cross-correlation" and len(heads) == 6
    assert rows == [("with all causes", "", ["-"] * 6)]
    found = budget_chapter({"cc": described(beam_blur=-0.001)}, []).numbers.tables[0][2]
    assert found[1] == ("without: width of the beam", "", ["0.100", "0.100", "0 %", "-", "-", "-"])


def test_a_row_that_does_not_apply_says_so():
    """An error that more than doubles without a cause has no fraction that is due to it."""
    budget = described(detector_noise=-22.08, beam_blur=-0.4)
    ((_, heads, rows),) = budget_chapter({"variational": budget}, []).numbers.tables
    shown = {label: values[heads.index("fraction")] for label, _, values in rows}
    assert shown["without: noise of the detector"] == "larger without"
    assert "40" in shown["without: width of the beam"]
