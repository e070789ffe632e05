"""Stated errors of v and w against true ones, over planes of a simulated wake.

Detects standard errors that are wrong by a seventh on air as a lidar sees it: textured to the
shortest waves that pixels hold, far brighter in the vortices than around them.
"""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.stages.winds import window_settings
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.schema.reading import load

SCENES = Path(str(files("lidar_mi.scenes")))
SIMULATION = Path(__file__).parents[4] / "shared" / "data" / "wake_les_40s.nc"
# Variance of an image's noise in units of the extinction (m^-1) by its powers: what simulation and
# detector leave in the images of the wake_sensor experiment.
NOISE = 7.3e-13, 2.1e-9, 2.7e-8


def reduced_errors(seed, amount, **changes):
    """Errors of v and w over their standard errors, good vectors, and the errors (m/s)."""
    overrides = [f"{key}={value}" for key, value in changes.items()] + [f"seed={seed}"]
    experiment = load(SCENES / "wake_sensor.yaml", overrides)
    truth = make_truth(experiment, SCENES)
    plans = call(scan_plans, experiment, truth=truth)
    images = [blur_by_beam(truth.image(k), experiment.lidar, plans[k].centre) for k in (0, 1)]
    noise = images[0].copy(data=np.sqrt(amount * np.polyval(NOISE[::-1], images[0].values)))
    random = np.random.default_rng(seed)
    noisy = [
        p + np.sqrt(amount * np.polyval(NOISE[::-1], p.values)) * random.standard_normal(p.shape)
        for p in images
    ]
    wind = retrieve_wind(
        *noisy,
        experiment.platform.dt,
        "variational",
        noise=noise,
        **window_settings(experiment.retrieval, None),
    )
    good = wind["flag"].values == 0
    # in some planes a fifth of the air, around the vortices, has no texture
    assert good.mean() > 0.75
    reduced, errors = [], []
    for name in ("v", "w"):
        true = truth.wind[name].interp(z=wind["z"], y=wind["y"]).transpose("z", "y").values
        errors.append((wind[name].values - true)[good])
        reduced.append(errors[-1] / wind[f"{name}_stderr"].values[good])
    return np.concatenate(reduced), np.concatenate(errors)


def check(reduced, allowed=0.05):
    assert np.mean(abs(reduced) < 1) == pytest.approx(0.683, abs=allowed)
    assert np.mean(abs(reduced) < 1.96) == pytest.approx(0.95, abs=allowed)
    assert np.mean(reduced**2) == pytest.approx(1, abs=0.3)


@pytest.mark.slow
def test_coverage_on_the_shipped_wake():
    reduced, errors = zip(*(reduced_errors(seed, 1.0) for seed in (1, 2)), strict=True)
    # neighbours share their errors: the fractions of one pair of images scatter by 2.5 points
    check(np.concatenate(reduced), 0.05 + 2 * 0.025 / np.sqrt(2))
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.1


@pytest.mark.slow
@pytest.mark.skipif(not SIMULATION.is_file(), reason="needs the simulated box")
@pytest.mark.parametrize("amount", [1.0, 10.0])
def test_coverage_over_planes_of_the_simulation(amount):
    """Planes 6 m apart, of other small eddies, each with an aerosol of its own."""
    places = np.arange(2.5, 40, 6)
    check(
        np.concatenate(
            [
                reduced_errors(seed, amount, **{"wake.file": SIMULATION, "wake.x": x})[0]
                for seed, x in enumerate(places, 11)
            ]
        ),
        # as above, of seven pairs
        0.05 + 2 * 0.025 / np.sqrt(len(places)),
    )
