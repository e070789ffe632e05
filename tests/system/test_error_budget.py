"""The error budget of an experiment. Detects causes switched off in the wrong image, a slab's
depth that is forgotten, winds found again that are not those of the run, and a report that does not
say what limits."""

import gc
import json

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.errors import truth_at_vectors
from lidar_mi.experiment.folder.run_folder import IMAGES
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.run import run
from lidar_mi.experiment.stages.error_budget import budgets
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.stages.winds import attenuated_backscatter_stderr
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.io import exr
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.schema import reading as config

pytestmark = pytest.mark.slow

SMALL = """
name: small
wake:
  vortex_pair:
    {circulation: 100 m^2/s, separation: 16 m, core_radius: 2 m, width: 40 m, height: 24 m}
  texture: {rms: 0.2, outer_scale: 10 m}
detector: {}
lidar: {pulse_energy: 1 mJ}
scattering: {phase: aerosol, aerosol: spheroids}
render: {samples_per_beam: 16, max_order: 1}
retrieval: {methods: [multipass, cc], stride: 2, error_budget: true}
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget")
    (folder / "small.yaml").write_text(SMALL)
    experiment = config.load(folder / "small.yaml")
    metrics = run(experiment, folder / "out", beside=folder).metrics
    yield experiment, folder, metrics
    gc.collect()
    gc.collect()


def test_a_weak_pulse_is_the_largest_cause(ran):
    """1 mJ from air of 0.1 / km by day: sky and photons drown the structure."""
    _, folder, metrics = ran
    for method in ("multipass", "cc"):
        fraction = {
            cause: metrics[f"error_budget.{method}.{cause}.fraction"]
            for cause in ("detector_noise", "monte_carlo", "beam_blur", "window", "method")
        }
        assert (
            max(fraction, key=fraction.get) == "detector_noise" and fraction["detector_noise"] > 0.5
        ), fraction
        # the same vectors as everywhere in the run
        count = metrics[f"backscatter_noisy.{method}.valid_fraction"]
        assert 0 < metrics[f"error_budget.{method}.vectors"] <= round(count * 33 * 17)
    written = json.loads((folder / "out/metrics.json").read_text())
    assert (
        written["error_budget.cc.time_step.fraction"]
        == metrics["error_budget.cc.time_step.fraction"]
    )
    assert (folder / "out/figures/fig23_error_budget.png").is_file()
    page = (folder / "out/report.html").read_text()
    assert "limited by noise of the detector" in page and "curved paths in the time step" in page


def test_winds_of_the_run_are_used_as_they_would_be_retrieved_again(ran):
    experiment, folder, metrics = ran
    scans = [exr.read_scan(folder / "out" / name) for name in IMAGES]
    again = budgets(experiment, make_truth(experiment, folder), scans)
    for method, budget in again.items():
        for key, value in budget.items():
            assert metrics[f"error_budget.{method}.{key}"] == pytest.approx(value, abs=1e-4), key


def noise_free_scans(experiment, truth):
    """What would be rendered of the slab, with hardly any noise."""
    scans = []
    for k, plan in enumerate(call(scan_plans, experiment, truth=truth)):
        image = 0.013 * blur_by_beam(truth.image(k), experiment.lidar, plan.centre, 2.5)
        s0 = image.expand_dims("gate") * 1e-3
        scans.append(xr.Dataset({"Y": image, "S0": s0, "S0_stderr": 1e-6 * s0}))
    return scans


def test_blur_is_corrected_only_where_present(tmp_path):
    """`variational` is given the beam's width, but not for unblurred air: the winds are those of
    `retrieve_wind` told the same."""
    text = SMALL.replace("[multipass, cc]", "[variational]").replace("detector: {}\n", "")
    (tmp_path / "told.yaml").write_text(text.replace("error_budget", "blur: beam, error_budget"))
    experiment = config.load(tmp_path / "told.yaml")
    truth = make_truth(experiment, tmp_path)
    scans = noise_free_scans(experiment, truth)
    budget = budgets(experiment, truth, scans, cores=[], flagged=True)["variational"]
    settings = {"dt": 0.1, "method": "variational", "windows": WindowSizes(stride=2)}
    level = attenuated_backscatter_stderr(scans[0])
    # half of the beam's 1/e^2 radius where the slab's middle is
    width = float(experiment.lidar.radius_at(501.25)) / 2
    observed = retrieve_wind(*(scan["Y"] for scan in scans), noise=level, blur=width, **settings)
    blind = retrieve_wind(*(scan["Y"] for scan in scans), noise=level, **settings)
    air = retrieve_wind(*(truth.image(k) for k in (0, 1)), noise=0.0, **settings)
    for wind, key in ((observed, "rmse_v"), (air, "beam_blur.rmse_v")):
        error = wind["v"] - truth_at_vectors(wind, truth.wind)["v"]
        assert budget[key] == pytest.approx(float((error**2).mean()) ** 0.5, rel=0.05), key
    assert abs(observed["v"] - blind["v"]).max() > 0.01


def test_wind_that_changes_through_the_slab_is_a_cause(tmp_path):
    """v from 0 to 10 m/s through 2.5 m of structured air: images of a slab that moves as one with
    the mean of 5 m/s give it to 10 % of the error."""
    x, y, z = np.arange(0, 4.1, 0.5), np.arange(0.0, 41), np.arange(0.0, 31)
    shape = (len(x), len(y), len(z))
    v = np.broadcast_to(5 + 4 * (x - 2)[:, None, None], shape)
    dims = ("x", "y", "z")
    wake = xr.Dataset(
        {"v": (dims, v, {"units": "m/s"}), "w": (dims, np.zeros(shape), {"units": "m/s"})},
        {
            axis: (axis, values, {"units": "m"})
            for axis, values in zip(dims, (x, y, z), strict=True)
        },
    )
    wake.to_netcdf(tmp_path / "sheared.nc", engine="h5netcdf")
    (tmp_path / "sheared.yaml").write_text(
        "name: sheared\n"
        "wake: {file: sheared.nc, depth: volume, extinction: {tracer: null, aerosol: null},\n"
        "       texture: {rms: 0.3, outer_scale: 5 m}}\n"
        "retrieval: {methods: [multipass], stride: 2}\n"
    )
    experiment = config.load(tmp_path / "sheared.yaml")
    truth = make_truth(experiment, tmp_path)
    assert float(truth.wind["v"].mean()) == pytest.approx(5, abs=1e-6)
    budget = budgets(experiment, truth, noise_free_scans(experiment, truth), flagged=True)
    found = budget["multipass"]
    assert found["rmse_v"] > 0.3
    assert found["slab.fraction_v"] > 0.9
    assert abs(found["monte_carlo.fraction"]) < 0.05 and "detector_noise.fraction" not in found
    # the method on what it was given, a slab that does not move as one
    assert found["method.fraction_v"] > 0.7
