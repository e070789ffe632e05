"""Extinction in fog by inverting the renderer, and what it refuses.

Detects: scattered light taken for extinction, a result that the simplified derivative decides, a
stated error that leaves out the renderer's noise, bad input that is not refused.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.inversion import extinction as inversion
from lidar_mi.inversion.extinction import LayeredAir, invert_extinction
from lidar_mi.rendering.backscatter import ScanRenderer
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.retrieval.extinction.klett import klett

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True),
]

GATES = 12
LIDAR = BackscatterLidar(
    beam_radius=0.02,
    beam_cut=0.05,
    divergence_full="1 mrad",
    aperture_radius=0.1,
    fov_half="15 mrad",
)
PLAN = ScanPlan(np.zeros(1), np.zeros(1), 100.0, 220.0, "spherical", GATES, 0.0)
FOG = {"type": "hg", "g": 0.85}


def middles(count):
    faces = np.linspace(100, 220, count + 1)
    return (faces[1:] + faces[:-1]) / 2


AIR = LayeredAir(middles(GATES), FOG)
BACKGROUND = 2.0


def settings(variant, samples, orders=4, fraction=0.1):
    return RenderSettings(
        variant=variant,
        samples_per_beam=samples * GATES,
        max_order=orders,
        monte_carlo_fraction=fraction,
    )


def plume():
    """Optical depth 1, in steps of 1 m."""
    x = middles(120)
    profile = 0.5 + 1.5 * np.exp(-(((x - 150) / 15) ** 2))
    return x, profile / profile.sum()


@pytest.fixture(scope="module")
def signal():
    """S0 of the plume, all orders and single scattering, of many samples."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    x, profile = plume()
    field = np.broadcast_to(profile[:, None, None], (x.size, 2, 2)).copy()
    sides = np.array([-120.0, 120.0])
    air = xr.DataArray(field, dims=("x", "y", "z"), coords={"x": x, "y": sides, "z": sides})
    renderer = ScanRenderer(
        air, PLAN, LIDAR, ScatteringAir(1e-6, FOG, 1.0), settings("llvm_ad_mono", 80_000)
    )
    scan = renderer.render(air, PLAN, 77)
    return scan["S0"].values.astype(float), scan["order1.S0"].values.astype(float)


def true_layers():
    return plume()[1].reshape(GATES, -1).mean(1)


def rms(found):
    return float(np.sqrt(((found / true_layers() - 1) ** 2).mean()))


def test_fog_is_recovered_where_single_scattering_fails(variant, signal):
    """A third of the far light is scattered several times. Counts of 1 to 5 % noise."""
    all_orders, single = signal
    assert 0.2 < 1 - (single / all_orders)[-1].item() < 0.5
    per_signal = 1e4 / all_orders.max()
    counts = np.random.default_rng(1).poisson(per_signal * all_orders + BACKGROUND)
    rounds = []
    found = invert_extinction(
        counts,
        PLAN,
        LIDAR,
        AIR,
        per_signal,
        settings(variant, 16_000),
        BACKGROUND,
        reference=(true_layers()[-1], 0.1),
        progress=lambda *round_: rounds.append(round_),
    )
    assert rms(found["extinction"].values) < 0.05
    assert found.attrs["reason"].startswith("no change above 0.1") and rounds
    assert found.attrs["monte_carlo_fraction"] < 0.1
    error = np.log(found["extinction"].values / true_layers())
    normalised = error / np.sqrt(np.diag(found["log_covariance"].values))
    # 12 layers with some 6 independent errors
    assert 0.15 < (normalised**2).mean() < 2.5
    # Klett's with the true extinction at the far end
    profile = (counts - BACKGROUND).ravel()
    assert rms(klett(profile, AIR.x, true_layers()[-1])) > 0.1


@pytest.mark.slow
def test_solution_has_the_full_model_whatever_the_derivative(variant, signal, monkeypatch):
    """Without noise: with attenuation as in single scattering, or of three quarters of it."""
    counts = 1e4 / signal[0].max() * signal[0]
    solutions = []
    for factor in (1.0, 0.75):
        monkeypatch.setattr(inversion, "attenuation_factor", lambda *_, q=factor: q)
        found = invert_extinction(
            counts,
            PLAN,
            LIDAR,
            AIR,
            1e4 / signal[0].max(),
            settings(variant, 8_000, fraction=0.5),
            reference=(true_layers()[-1], 0.1),
        )
        solutions.append(found)
        assert rms(found["extinction"].values) < 0.05
    one, other = (np.log(s["extinction"].values) for s in solutions)
    stated = np.sqrt(np.diag(solutions[0]["log_covariance"].values))
    assert np.sqrt((((one - other) / stated) ** 2).mean()) < 1


@pytest.mark.slow
def test_oblique_beams_share_the_profile(variant, signal):
    """Two beams to both sides, each with the counts of the one on axis."""
    sides = 170 * np.tan(np.deg2rad([-2.0, 2.0]))
    plan = ScanPlan(sides, np.zeros(1), 100.0, 219.5, "spherical", GATES, 0.0)
    per_signal = 1e4 / signal[0].max()
    counts = np.concatenate([per_signal * signal[0]] * 2, axis=2)
    reference = (true_layers()[-1], 0.1)
    given = plan, LIDAR, AIR, per_signal, settings(variant, 8_000, fraction=0.5)
    found = invert_extinction(counts, *given, reference=reference)
    # gates of 9.96 m and beams oblique by 2 degrees: 0.4 % and 0.06 % of the way
    assert found["ratio"].shape == (GATES, 1, 2)
    assert rms(found["extinction"].values) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"counts": np.ones((3, 1, 1))}, r"counts: shape \(3, 1, 1\) or values are not allowed"),
        ({"counts": np.full((GATES, 1, 1), 2.0)}, "counts: 24 in all gates is not above the back"),
        ({"counts": "many"}, "counts: 'many' is not allowed; expected numbers"),
        ({"counts_per_signal": 0.0}, "counts_per_signal: 0.0 is not allowed"),
        ({"background": -1.0}, "background: -1.0 is not allowed; expected 0 counts or more"),
        ({"calibration_error": 1.0}, "calibration_error: 1.0 is not allowed"),
        ({"reference": (0.01, 0.0)}, "reference: 0.01 m.* relative error of 0 is not allowed"),
        ({"air": LayeredAir(np.array([1.0, 2.0]), FOG)}, "air.x: 2 places are not allowed"),
        ({"air": LayeredAir(middles(4), FOG, environment=0)}, "air.environment: 0 is not allowed"),
        ({"start": np.zeros(GATES)}, "start: shape .* an extinction above 0 in each of 12 layers"),
        ({"settings": RenderSettings()}, "samples_per_beam: auto is not allowed for an inversion"),
        (
            {"plan": ScanPlan(np.zeros(1), np.zeros(1), 100.0, 220.0, "planar", GATES, 0.0)},
            "scan.gates: planar is not allowed",
        ),
        ({"air": LayeredAir(middles(4) + 500, FOG)}, "gates: the one from .* receives no light"),
    ],
)
def test_bad_input_is_refused(variant, changed, message):
    given = {
        "counts": np.full((GATES, 1, 1), 100.0),
        "plan": PLAN,
        "lidar": LIDAR,
        "air": AIR,
        "counts_per_signal": 1e12,
        "settings": settings(variant, 100),
        "background": BACKGROUND,
    }
    with pytest.raises(InputError, match=message):
        invert_extinction(**(given | changed))
