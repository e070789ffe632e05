"""Vortices of slices of a Doppler lidar: detection, fit, track. Physics tier.

Detects: a vortex at the wrong place, of the wrong sign or strength; standard errors that are too
small or too large; a scan that shows no wake and gets one; scans in the wrong order; bad input that
ends in more than a line.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.flags import VortexFlag
from lidar_mi.retrieval.ground_vortices.detection import detect
from lidar_mi.retrieval.ground_vortices.fit import Assumptions
from lidar_mi.retrieval.ground_vortices.radial_velocities import by_radial_velocities
from lidar_mi.retrieval.ground_vortices.scan_plane import plane_scans
from lidar_mi.retrieval.ground_vortices.vortices import lidar_of
from tests.support.line_wakes import LIDAR, Family, drawn, slices

PAIR = Family()
GROUND = Family(ground=-2.0, heights=(20.0, 40.0), length=50.0)
SINGLE = Family(circulations=(350.0,), core_radii=(3.5,))
NAMES = ("y", "z", "circulation")


def errors(one, found):
    """Errors and standard errors (scans, vortices, 3)."""
    truth = np.stack([np.column_stack([one.at(t), one.circulations]) for t in found["time"].values])
    values = np.stack([found[name].values for name in NAMES], -1)
    return values - truth, np.stack([found[f"{name}_stderr"].values for name in NAMES], -1)


@pytest.mark.parametrize(
    ("family", "options"),
    [
        (PAIR, {}),
        pytest.param(
            replace(PAIR, profile="burnham_hallock"),
            {"profile": "burnham_hallock"},
            marks=pytest.mark.slow,
        ),
        pytest.param(GROUND, {"ground": -2.0}, marks=pytest.mark.slow),
        (SINGLE, {"kind": "single"}),
    ],
    ids=["pair", "burnham_hallock", "ground", "single"],
)
def test_vortices_are_found_within_their_errors(family, options):
    scan = slices(0.0, 10.0) if family is GROUND else None
    normal, relative = [], []
    for seed in range(4):
        one = drawn(family, 900 + seed, scan)
        found = lm.fit_vortices_to_lines(one.lines, **options)
        assert found["flag"].values.tolist() == [0]
        assert float(found["probability"][0]) > 0.99
        error, stderr = errors(one, found)
        normal.append(error / stderr)
        relative.append(np.abs(error[..., 2] / one.circulations))
    square = np.mean(np.square(normal))
    # of about 4 scans x 3 independent numbers
    assert 0.2 < square < 1 + 4 * np.sqrt(2 / 12)
    assert np.median(relative) < 0.08


def test_without_stated_noise_it_is_estimated():
    one = drawn(PAIR, 31)
    unknown = lm.fit_vortices_to_lines(one.lines.drop_vars("radial_velocity_stderr"))
    known = lm.fit_vortices_to_lines(one.lines)
    error, stderr = errors(one, unknown)
    assert int(unknown["flag"][0]) == 0 and np.abs(error / stderr).max() < 4
    for name in NAMES:
        ratio = unknown[f"{name}_stderr"] / known[f"{name}_stderr"]
        assert (ratio > 0.6).all() and (ratio < 1.7).all()


def test_a_scan_of_turbulence_has_no_vortices():
    found = lm.fit_vortices_to_lines(drawn(PAIR, 300, wake=False).lines)
    assert found["flag"].values.tolist() == [VortexFlag.NO_WAKE.value]
    assert np.isnan(found["y"]).all() and float(found["probability"][0]) < 0.5


def test_a_weak_wake_is_uncertain_and_a_strong_one_is_not():
    scores = []
    for strength in (15.0, 60.0, 400.0):
        family = Family(circulations=(-strength, strength))
        (scan,), _ = plane_scans(drawn(family, 5).lines, None)
        scores.append(detect(scan, LIDAR, Assumptions()))
    assert scores[0].score < scores[1].score < scores[2].score
    assert scores[2].false_alarm < 1e-6 < scores[0].false_alarm


def test_a_vortex_at_the_edge_of_the_scan_is_flagged():
    one = drawn(PAIR, 12)
    cut = one.lines.where(one.lines["range"] < one.places[0].mean(0)[0] + 5, drop=True)
    cut["flag"] = cut["flag"].astype(np.uint16)
    found = lm.fit_vortices_to_lines(cut)
    assert int(found["flag"][0]) & (VortexFlag.OUTSIDE | VortexFlag.NOT_IDENTIFIED | 1)


def test_lines_may_lack_gates_and_come_in_any_order():
    one = drawn(PAIR, 14)
    whole = lm.fit_vortices_to_lines(one.lines)
    lines = one.lines.copy(deep=True)
    random = np.random.default_rng(2)
    lost = random.random(lines["flag"].shape) < 0.1
    lines["flag"].values[lost] = 4
    lines["radial_velocity"].values[lost] = 30.0
    found = lm.fit_vortices_to_lines(lines.isel(time=random.permutation(lines.sizes["time"])))
    error, stderr = errors(one, found)
    assert int(found["flag"][0]) == 0 and np.abs(error / stderr).max() < 4
    assert (np.abs(found["y"] - whole["y"]) < 3 * whole["y_stderr"]).all()


@pytest.mark.slow
def test_over_the_top_and_to_the_west_is_the_same_plane():
    one = drawn(PAIR, 16)
    west = one.lines.assign_coords(azimuth=(one.lines["azimuth"] + 180) % 360)
    over = one.lines.assign_coords(
        azimuth=(one.lines["azimuth"] + 180) % 360, elevation=180 - one.lines["elevation"]
    )
    found = [lm.fit_vortices_to_lines(lines) for lines in (one.lines, west, over)]
    np.testing.assert_allclose(found[1]["y"], found[0]["y"], atol=1e-6)
    assert float(found[1]["azimuth"][0]) == pytest.approx(270)
    # lines over the top look to the east again
    np.testing.assert_allclose(np.abs(found[2]["y"]), np.abs(found[0]["y"]), atol=1e-6)


@pytest.mark.slow
def test_track_is_better_than_its_fits():
    fits, tracks, normal = [], [], []
    for seed in (0, 1):
        one = drawn(replace(PAIR, sigma=0.2, heights=(70.0, 100.0)), seed, slices(2, 11, count=5))
        found = lm.fit_vortices_to_lines(one.lines)
        assert found["track_used"].all() and found.sizes["scan"] == 5
        error, _ = errors(one, found)
        smooth = np.stack([found[f"{name}_tracked"].values for name in NAMES], -1)
        stderr = np.stack([found[f"{name}_tracked_stderr"].values for name in NAMES], -1)
        values = np.stack([found[name].values for name in NAMES], -1)
        after = error + smooth - values
        fits.append(error)
        tracks.append(after)
        normal.append(after / stderr)
    assert (np.square(tracks).mean((0, 1, 2)) < np.square(fits).mean((0, 1, 2))).all()
    # scans of one wake share its air: few independent numbers
    assert np.square(normal).mean() < 3


def test_track_goes_on_where_a_scan_shows_nothing():
    one = drawn(replace(PAIR, sigma=0.2, heights=(70.0, 100.0)), 3, slices(2, 11, count=4))
    lines = one.lines.copy(deep=True)
    lines["flag"].values[(lines["sweep"] == 2).values, 8:] = 4
    found = lm.fit_vortices_to_lines(lines)
    assert found["flag"].values[2] and not found["track_used"].values[2]
    error = np.stack([found[f"{k}_tracked"].values for k in "yz"], -1)[2] - one.at(
        found["time"].values[2]
    )
    stderr = np.stack([found[f"{k}_tracked_stderr"].values for k in "yz"], -1)[2]
    assert np.abs(error / stderr).max() < 4


def test_method_of_radial_velocities_finds_a_pair():
    """The peer, in still air: places within a gate, circulations within a tenth."""
    one = drawn(Family(sigma=0.0, snr=0.3), 4)
    (scan,), _ = plane_scans(one.lines, None)
    given = Assumptions()
    guess = detect(scan, LIDAR, given).candidates[0].vortices
    found = by_radial_velocities(scan, LIDAR, given, guess)
    truth = one.at(scan.at(float(np.interp(guess[0, 1] / guess[0, 0], scan.angle, scan.time))))
    np.testing.assert_allclose(found[:, :2], truth, atol=4)
    np.testing.assert_allclose(found[:, 2], one.circulations, rtol=0.15)


@pytest.mark.slow
def test_passes_up_and_down_in_one_sweep_are_two_scans():
    one = drawn(replace(PAIR, heights=(70.0, 100.0)), 8, slices(2, 11, count=2))
    apart = lm.fit_vortices_to_lines(one.lines)
    lines = one.lines.assign_coords(sweep=one.lines["sweep"] * 0)
    # and a third pass that has hardly begun
    more = lines.isel(time=slice(0, 5))
    more = more.assign_coords(time=more["time"] + np.timedelta64(20, "s"))
    together = lm.fit_vortices_to_lines(xr.concat([lines, more], "time"))
    assert together.sizes["scan"] == 2
    assert together.attrs["remarks"] == "5 lines are in no scan of 8 lines and 4 gates"
    np.testing.assert_allclose(together["y"], apart["y"], rtol=1e-6)


def test_a_list_of_scans_is_in_the_order_of_time():
    lines = [drawn(PAIR, seed, slices(2, 14)).lines for seed in (21, 22)]
    lines[0] = lines[0].assign_coords(time=lines[0]["time"] + np.timedelta64(60, "s"))
    found = lm.fit_vortices_to_lines(lines)
    assert found.sizes["scan"] == 2 and np.diff(found["time"].values) > np.timedelta64(0)


@pytest.fixture(scope="module")
def some_lines():
    return drawn(PAIR, 1, slices(2, 14)).lines


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda x: x.drop_vars("elevation"), {}, "elevation is missing"),
        (lambda x: x.assign(flag=x["flag"] + 4), {}, "0 lines and 0 gates with usable"),
        (lambda x: x.isel(range=slice(1)), {}, "1 gates; expected two or more"),
        (lambda x: x.isel(range=slice(3)), {}, "3 gates with usable values in a scan"),
        (
            lambda x: x.assign_coords(azimuth=x["azimuth"] + np.linspace(0, 40, x.sizes["time"])),
            {},
            "leaves the vertical plane",
        ),
        (lambda x: x.assign_coords(elevation=x["elevation"] * 0 + 5), {}, "one direction"),
        (lambda x: x, {"span": -3.0}, "span: -3.0 is not allowed"),
        (lambda x: x, {"false_alarm": 0.0}, "false_alarm: 0.0 is not allowed"),
        (lambda x: x, {"kind": "triple"}, "kind"),
        (lambda x: [], {}, "lines: none"),
    ],
)
def test_bad_input_is_named(some_lines, change, options, message):
    with pytest.raises(lm.InputError, match=message) as caught:
        lm.fit_vortices_to_lines(change(some_lines), **options)
    assert "\n" not in str(caught.value)


def test_gate_and_pulse_are_those_of_the_data_set():
    lines = xr.Dataset(coords={"range": [100.0, 118.0, 136.0]})
    assert lidar_of(lines, None, None).gate_length == 18
    stated = lines.assign_attrs(gate_length=30.0, pulse_length=25.0)
    assert lidar_of(stated, None, None).pulse_length == pytest.approx(25)
    assert lidar_of(stated, 40.0, 20.0).gate_length == 20


@pytest.mark.parametrize(("gate_length", "remarked"), [(30.0, True), (15.0, False)])
def test_overlapping_gates_are_named_as_a_cause_of_misfit(monkeypatch, gate_length, remarked):
    """Gates every 15 m, and a limit that every fit exceeds."""
    monkeypatch.setattr("lidar_mi.retrieval.ground_vortices.vortices._MISFIT", 2.0)
    lines = drawn(PAIR, 3, slices(2.0, 11.0)).lines
    found = lm.fit_vortices_to_lines(lines, gate_length=gate_length)
    assert int(found["flag"][0]) & VortexFlag.MISFIT.value
    assert ("noise that neighbours have in common" in found.attrs["remarks"]) == remarked


@pytest.mark.parametrize(("gate_length", "remarked"), [(90.0, False), (120.0, True)])
def test_gates_whose_errors_were_not_tested_are_said(some_lines, gate_length, remarked):
    found = lm.fit_vortices_to_lines(some_lines, gate_length=gate_length, pulse_length=30.0)
    assert ("compared with true ones" in found.attrs["remarks"]) == remarked
