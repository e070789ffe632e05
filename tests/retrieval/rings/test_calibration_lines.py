"""The gap from frames of two lines, made without the program, of an instrument with all defects.

Detects: a whole order that is wrong or not said to be ambiguous, a gap or a fractional order off by
4 standard errors, errors of half or twice their size (slow), a line of another wavelength, a lens
that is not achromatic, and frames of another camera taken for the same instrument's.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.stats import chi2

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.calibration import calibrated, calibration_of
from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings
from lidar_mi.retrieval.rings.calibration_lines import combined
from lidar_mi.retrieval.rings.likelihood_fit import fit_rings
from tests.support.calibrations import DEFECTS, NOISE, SMALL, SPEED, air_model, laser_model
from validation.fringe_reference import air_frame, exposures, laser_frame

LASER, MERCURY = SMALL.wavelength, 404.7708e-9
NOMINAL, TRUE = 13.7e-3, 13.7031234e-3
WITHOUT_WARMING = replace(DEFECTS, warming=0.0)


def instrument(wavelength, gap=TRUE):
    return replace(SMALL, wavelength=wavelength, gap=gap, order=2 * gap / wavelength)


def model(nominal, wavelength):
    return replace(nominal, wavelength=wavelength, order_at_centre=2 * NOMINAL / wavelength)


def line(wavelength, seed, told=None, defects=WITHOUT_WARMING, count=3):
    """The calibration of one line, whose wavelength is taken for ``told``."""
    mean = laser_frame(instrument(wavelength), defects, 2e6)
    frames = exposures(mean, count, [*np.atleast_1d(seed), int(1e9 * wavelength)], NOISE.read_noise)
    nominal = model(laser_model(), told or wavelength)
    return calibrate_rings(torch.from_numpy(frames.astype(np.float32)), nominal, NOISE)


def both(lines, tolerance=10e-6, **options):
    return combined(lines, NOMINAL, tolerance, mirror_orders=(0.0,) * len(lines), **options)


@pytest.fixture(scope="module")
def lines():
    return line(LASER, 1), line(MERCURY, 1)


@pytest.mark.slow
def test_the_whole_order(lines):
    """17 orders from the nominal gap's."""
    found = both(lines)
    order = 2 * TRUE / LASER
    assert found.whole_orders == (int(order),) and int(order - 2 * NOMINAL / LASER) == 17
    ((gap, std),) = found.gaps
    assert abs(gap - TRUE) < 4 * std
    # of wavelengths known to 1e-8, twice: 0.1 nm
    assert 0.9e-8 / math.sqrt(2) < std / TRUE < 1.3e-8 / math.sqrt(2)
    zero = math.sqrt(found.systematic[0, 0]) / (299792458.0 / 2 / order)
    assert abs(found.order_at_centre - order) < 4 * zero < 2e-3
    text = " ".join(map(str, found.tables()[0].rows))
    assert str(int(order)) in text and "13.7031" in text and "for this gap" in text


def test_the_shared_instrument_is_sharper(lines):
    found = both(lines)
    true = SMALL.focal_length * DEFECTS.focal_length
    assert abs(found.focal_length / true - 1) < 4 * found.std["focal_length"]
    # as much light again
    for name in ("focal_length", "tilt_x", "tilt_y", "distortion", "blur"):
        assert 0.5 < found.std[name] / lines[0].std[name] < 0.85, name
    # what is the line's own
    assert found.std["damping"] == pytest.approx(lines[0].std["damping"], rel=0.1)
    scale = np.sqrt(np.diag(found.systematic))
    assert np.linalg.eigvalsh(found.systematic / np.outer(scale, scale)).min() > 0
    own = both(lines, achromatic=False)
    assert own.std["focal_length"] > 1.05 * found.std["focal_length"]
    assert own.whole_orders == found.whole_orders


def test_an_ambiguous_order_is_told(lines):
    """Fractions alone: with 10 times poorer wavelengths other orders agree within 130 um, too."""
    found = both(lines, tolerance=130e-6, wavelength_accuracy=3e-7)
    assert found.whole_orders == () and len(found.gaps) > 1
    assert min(abs(gap - TRUE) for gap, _ in found.gaps) < 1e-7
    # the nominal order is kept: of the first line alone
    assert found.order_at_centre == pytest.approx(lines[0].order_at_centre, abs=0.01)
    text = " ".join(map(str, found.tables()[0].rows))
    assert "ambiguous" in text and "nominal gap" in text


def test_file_and_speeds(lines, tmp_path):
    """The file holds it; speeds with it are right to the scale of the true gap."""
    both(lines).to_dataset().to_netcdf(tmp_path / "etalon.nc")
    with xr.open_dataset(tmp_path / "etalon.nc") as data:
        found = calibration_of(data.load())
    assert found.whole_orders == both(lines).whole_orders and found.lines == (LASER, MERCURY)
    air = air_frame(instrument(LASER), WITHOUT_WARMING, SPEED, 2.4e7)
    frames = torch.from_numpy(exposures(air, 4, 9, NOISE.read_noise).astype(np.float32))
    fit = fit_rings(
        frames,
        calibrated(model(air_model(), LASER), found),
        NOISE,
        centre=found.centre,
        response=torch.from_numpy(found.response),
    )
    allowed = math.hypot(float(fit.v_los_std.mean()) / 2, float(fit.v_los_systematic.mean()))
    assert abs(float(fit.v_los.mean()) - SPEED) < 4 * allowed < 4
    with pytest.raises(InputError, match="another gap"):
        calibrated(replace(air_model(), order_at_centre=70000.5), found)


def refused(message, lines, **options):
    with pytest.raises(InputError, match=message) as error:
        both(lines, **options)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_unknown_lines(lines):
    """Of another wavelength: seen by the width of its rings (0.1 %), or by its fraction (1e-6)."""
    refused(r"line of 405.1756 nm: .* true wavelength", (lines[0], line(MERCURY, 1, 405.1756e-9)))
    near = line(MERCURY, 1, MERCURY * (1 + 2e-6))
    refused("gap: none from 13.6965 to 13.7035 mm agrees", (lines[0], near), tolerance=3.5e-6)


@pytest.mark.slow
def test_lenses_that_are_not_achromatic(lines):
    other = line(MERCURY, 3, defects=replace(WITHOUT_WARMING, focal_length=1.003))
    refused("not achromatic", (lines[0], other))
    assert both((lines[0], other), achromatic=False).whole_orders == both(lines).whole_orders


def test_options_that_cannot_be(lines):
    refused("gap_tolerance: 0.001 m is not allowed", lines, tolerance=1e-3)
    refused("gap_tolerance: 0 m is not allowed", lines, tolerance=0.0)
    refused("wavelength_accuracy: -1 is not allowed", lines, wavelength_accuracy=-1.0)


@pytest.mark.slow
def test_errors_hold():
    """30 calibrations of both lines: mean square errors over those stated, between the quantiles of
    1e-4 and 1 - 1e-4, of what both lines share and of the gap (without errors of wavelengths)."""
    runs, squares = 30, []
    for seed in range(runs):
        pair = line(LASER, [30, seed]), line(MERCURY, [30, seed])
        try:
            found = both(pair, wavelength_accuracy=0.0)
        except InputError:  # true fractions disagree by chance in 0.3 %
            continue
        ((gap, std),) = found.gaps
        per_order = 299792458.0 / 2 / found.order_at_centre
        focal = SMALL.focal_length * DEFECTS.focal_length
        off = {
            "gap": (gap - TRUE) / std,
            "order": (found.order_at_centre - 2 * TRUE / LASER)
            / (math.sqrt(found.systematic[0, 0]) / per_order),
            "focal_length": (found.focal_length / focal - 1) / found.std["focal_length"],
            "tilt_x": (found.tilt[0] + DEFECTS.tilt[1]) / found.std["tilt_x"],
            "distortion": (found.distortion - DEFECTS.distortion) / found.std["distortion"],
        }
        squares.append({name: value**2 for name, value in off.items()})
    assert len(squares) >= runs - 1
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs - 1) / (runs - 1)
    means = {name: float(np.mean([one[name] for one in squares])) for name in squares[0]}
    assert all(low < value < high for value in means.values()), (low, high, means)
