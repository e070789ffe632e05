"""Calibration from laser frames, made without the program, of an instrument with all defects.

Detects: a tilt, distortion, blur, focal length, centre or finesse that is off by 5 standard errors,
covariances of half or twice their size (slow: over independent calibrations), a file that loses a
number, frames of something else that give a calibration.
"""

import json
import math
import re
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.stats import chi2

from lidar_mi.assessment.figures.calibration import draw_calibration
from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.calibration import calibrated, calibration_of
from lidar_mi.retrieval.rings.calibration_fit import TOLERANCES, calibrate_rings
from lidar_mi.retrieval.rings.likelihood_fit import difference, fit_rings
from lidar_mi.retrieval.rings.model import INSTRUMENT
from tests.support import figure_rules
from tests.support.calibrations import (
    DEFECTS,
    NOISE,
    SMALL,
    SPEED,
    air_frames,
    air_model,
    air_of,
    laser_frames,
    laser_model,
    normalised_errors,
)
from validation.fringe_reference import Defects, air_frame, laser_frame


@pytest.fixture(scope="module")
def found():
    defects = replace(DEFECTS, hot_pixels=20, hot_electrons=2000.0, dead_pixels=10, seed=2)
    return calibrate_rings(laser_frames(5, 1, defects), laser_model(), NOISE)


@pytest.mark.slow
def test_the_instrument_is_recovered(found):
    errors = normalised_errors(found)
    assert max(map(abs, errors.values())) < 5, errors
    # of 0.4 and 0.3 deg, 0.2 %, 0.1 % and 1 px: it is not the prior that says so
    assert found.std["tilt_x"] < 3e-3 and found.std["distortion"] < 1e-4
    assert found.std["focal_length"] < 1e-4 and found.std["blur"] < 0.02
    assert found.undetermined == ()
    assert abs(found.chi_square - 1) < 0.05
    # lower by 5 % of the mirrors' and by line and roughness: 8.19 of the nominal instrument
    assert 7.7 < found.finesse < 7.95


def test_the_figure(found):
    assert figure_rules.faults(draw_calibration(found)) == []


def test_bad_pixels_are_found(found):
    places = np.random.default_rng(2).permutation(math.prod(SMALL.shape))[:30]
    left_out = found.response.flat[places] == 0
    # dead pixels between rings are as dark as others there
    assert left_out[:20].all() and left_out[20:].any()
    bad = np.zeros(SMALL.shape, bool)
    bad.flat[places] = True
    # of 46800 good ones, none is 6 standard deviations off
    assert (found.response[~bad] == 0).sum() <= 2


def test_the_warmed_etalon_is_in_the_order(found):
    """Of the fraction of an order that 0.3 K are, 0.0116: the rest is noise."""
    expected = SMALL.order * (1 + SMALL.expansion * DEFECTS.warming)
    std = math.sqrt(found.systematic[0, 0]) / (299792458.0 / 2 / SMALL.order)
    assert abs(found.order_at_centre - expected) < 5 * std < 2e-3


def test_speeds_with_the_calibrated_instrument(found):
    """Absolute and to the laser shot; without calibration they are 37 and 0.4 m/s off."""
    response = torch.from_numpy(found.response)
    air = fit_rings(air_frames(8, 5), air_of(found), NOISE, centre=found.centre, response=response)
    emitted = fit_rings(
        laser_frames(8, 6, photons=2.4e7),
        calibrated(laser_model(), found),
        NOISE,
        centre=found.centre,
        response=response,
    )
    for v, std, systematic in (
        (air.v_los, air.v_los_std, air.v_los_systematic),
        difference(air, emitted),
    ):
        error = float(v.mean()) - SPEED
        allowed = math.hypot(float(std.mean()) / math.sqrt(8), float(systematic.mean()))
        assert abs(error) < 4 * allowed and allowed < 0.4
        assert float(v.std()) == pytest.approx(float(std.mean()), rel=4 / math.sqrt(2 * 7))
    # what both have in common cancels
    assert float(difference(air, emitted)[2].mean()) < float(air.v_los_systematic.mean())


@pytest.mark.slow
def test_frames_drift(found):
    """Half of the frames at 10 m/s more: the drift is found, and part of later errors."""
    still = laser_frames(3, 7)
    moved = SMALL.order * 20 / 299792458.0 / SMALL.order
    warm = replace(DEFECTS, warming=DEFECTS.warming + moved / SMALL.expansion)
    both = calibrate_rings(torch.cat([still, laser_frames(3, 8, warm)]), laser_model(), NOISE)
    assert found.drift < 0.5
    step = both.frame_speed[3:].mean() - both.frame_speed[:3].mean()
    std = math.sqrt((both.frame_speed_std**2).sum()) / 3
    assert step == pytest.approx(10, abs=4 * std)
    # standard deviation of +-5 with five degrees of freedom
    assert both.drift == pytest.approx(5 * math.sqrt(6 / 5), abs=4 * std)
    assert both.systematic[0, 0] > both.drift**2


def test_file_round_trip(found, tmp_path):
    found.to_dataset().to_netcdf(tmp_path / "etalon.nc")
    with xr.open_dataset(tmp_path / "etalon.nc") as data:
        again = calibration_of(data.load())
    for name in (f.name for f in fields(found)):
        one, other = getattr(found, name), getattr(again, name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other, err_msg=name)
        else:
            assert one == other, name


def without(name):
    def change(data):
        return data.drop_vars(name)

    return change


def altered(**changes):
    def change(data):
        single = {**json.loads(data.attrs["calibration"]), **changes}
        return data.assign_attrs(calibration=json.dumps(single))

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (without("systematic"), "systematic"),
        (without("response"), "response"),
        (lambda data: data.assign_attrs(calibration="{"), "expected the file of a calibration"),
        (lambda data: data.drop_attrs(), "calibration"),
        (altered(shape=[10, 10]), "sizes or numbers that cannot be"),
        (altered(focal_length=-1.0), "sizes or numbers that cannot be"),
        (altered(pixel="wide"), "sizes or numbers that cannot be"),
        (lambda data: data.assign(systematic=data.systematic * np.nan), "cannot be"),
    ],
)
def test_files_that_are_none(found, change, message):
    with pytest.raises(InputError, match=message) as error:
        calibration_of(change(found.to_dataset()))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"shape": (196, 240)}, "calibration: sizes 195 x 240 and 196 x 240 px"),
        ({"pixel": 7.4e-6}, "calibration: pixel 2.96e-05 m is not that of the model, 7.4e-06 m"),
        ({"wavelength": 532e-9}, "calibration: wavelength 3.547e-07 m is not that"),
        ({"order_at_centre": 70000.5}, "calibration: order 77248.5 at the centre .* another gap"),
    ],
)
def test_calibration_of_another_instrument(found, change, message):
    with pytest.raises(InputError, match=message):
        calibrated(replace(air_model(), **change), found)


def refused(frames, message, **options):
    with pytest.raises(InputError, match=message) as error:
        calibrate_rings(frames, options.pop("model", laser_model()), NOISE, **options)
    assert "\n" not in str(error.value)


def test_frames_that_cannot_be():
    frames = laser_frames(3, 9)
    refused(frames[:, :-1], "frames: sizes 194 x 240 and 195 x 240 px")
    refused(frames[:1], "frames: 1 is not allowed; expected 2 or more")
    clipped = frames.clone()
    clipped[1].clamp_(max=float(frames[1].quantile(0.97)))
    refused(clipped, r"frames\[1\]: saturated, \d+ pixels share the highest value")
    broken = frames.clone()
    broken[2, 5, 5] = math.nan
    refused(broken, r"frames\[2\]: 1 pixel\(s\) of NaN")
    refused(frames, "tolerances.blur: 0 is not allowed", tolerances={**TOLERANCES, "blur": 0})
    refused(torch.rand(3, *SMALL.shape) * 40, "no rings detected|rings")


@pytest.mark.slow
def test_lamp_with_two_lines():
    """A second line half an order away: no instrument of one line has such rings."""
    second = replace(SMALL, order=SMALL.order + 0.45)
    frames = laser_frames(3, 10, Defects()) + laser_frames(3, 11, Defects(), instrument=second)
    refused(frames, "frames: the calibration does not converge|frames: chi-square")


def test_one_ring():
    small = replace(SMALL, shape=(60, 60))
    model = replace(laser_model(), shape=(60, 60), centre=(29.5, 29.5))
    refused(laser_frames(3, 12, Defects(), 5e5, small), "ring", model=model)


def test_wrong_focal_length():
    """By 30 %: the nominal instrument is another one."""
    refused(laser_frames(2, 13, replace(DEFECTS, focal_length=1.3)), "check focal length")


@pytest.mark.slow
def test_covariance_is_that_of_independent_calibrations():
    """40 of them: mean square errors over those stated, each parameter between its quantiles of
    1e-4 and 1 - 1e-4; errors of later speeds, of air and of the difference to the laser."""
    runs = 40
    air, emitted = (
        torch.from_numpy(frame.mean)
        for frame in (air_frame(SMALL, DEFECTS, SPEED, 2.4e7), laser_frame(SMALL, DEFECTS, 2.4e7))
    )
    squares = []
    for seed in range(runs):
        found = calibrate_rings(laser_frames(3, [20, seed]), laser_model(), NOISE)
        given = {"centre": found.centre, "response": torch.from_numpy(found.response)}
        # without noise: what the calibration leaves
        fits = [
            fit_rings(one, model, NOISE, **given)
            for one, model in ((air, air_of(found)), (emitted, calibrated(laser_model(), found)))
        ]
        v, _, systematic = difference(*fits)
        errors = normalised_errors(found)
        errors["speed"] = float((fits[0].v_los - SPEED) / fits[0].v_los_systematic)
        errors["difference"] = float((v - SPEED) / systematic)
        squares.append({name: value**2 for name, value in errors.items()})
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs) / runs
    means = {name: np.mean([one[name] for one in squares]) for name in squares[0]}
    assert all(low < value < high for value in means.values()), (low, high, means)


def test_systematic_covariance_is_one(found):
    size = 1 + len(INSTRUMENT)
    assert found.systematic.shape == (size, size)
    np.testing.assert_allclose(found.systematic, found.systematic.T, rtol=1e-9, atol=1e-18)
    scale = np.sqrt(np.diag(found.systematic))
    assert np.linalg.eigvalsh(found.systematic / np.outer(scale, scale)).min() > 0
    for k, name in enumerate(INSTRUMENT, 1):
        assert scale[k] == pytest.approx(found.std[name])


def test_table_names_what_is_not_determined(found):
    table = replace(found, undetermined=("blur",)).tables()[0]
    assert "blur" in table.note and found.tables()[0].note == ""
    text = " ".join(value for _, value in table.rows)
    assert re.search(r"\d", text) and "nan" not in text
