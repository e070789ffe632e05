"""Extinction against the formula worked by hand: detects 1e-9 relative and any loss of order."""

from importlib.resources import files

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.extinction import extinction_from_speed, extinction_from_tracer
from lidar_mi.errors import InputError
from lidar_mi.io.wake_file import read_wake


@pytest.fixture
def wake():
    dims = ("x", "y", "z")
    return xr.Dataset(
        {
            "v": (dims, np.array([[[3.0, 0.0], [-6.0, 0.0]]])),
            "w": (dims, np.array([[[4.0, 0.0], [8.0, 5.0]]])),
            "tracer": (dims, np.array([[[0.0, 0.1], [0.2, 0.4]]])),
            "aerosol": (dims, np.array([[[1.0, 0.8], [1.2, 1.0]]])),
        }
    )


def test_tracer_and_aerosol_by_hand(wake):
    # x = 0, 1/4, 1/2, 1: stretched 0, 7/16, 3/4, 1.
    expected = [[[1e-4, 0.8e-4 + 1.7e-3 * 7 / 16], [1.2e-4 + 1.7e-3 * 0.75, 1.8e-3]]]
    result = extinction_from_tracer(wake)
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    assert result.attrs["units"] == "m-1" and result.dims == ("x", "y", "z")


@pytest.mark.parametrize("stretch", [1.0, 1.5, 2.0, 4.0])
def test_stretch_is_monotone_with_its_slope_for_thin_tracer(stretch):
    tracer = np.concatenate([[0.0, 1e-7], np.linspace(1e-3, 1, 500)])
    wake = xr.Dataset({"tracer": ("y", tracer)})
    fraction = (extinction_from_tracer(wake, 0.0, 1.0, stretch, aerosol=None)).values
    assert (np.diff(fraction) > 0).all()
    assert fraction[0] == 0 and fraction[-1] == 1
    assert fraction[1] == pytest.approx(stretch * 1e-7, rel=1e-6)


def test_either_part_may_be_left_out(wake):
    np.testing.assert_allclose(extinction_from_tracer(wake, tracer=None), 1e-4 * wake.aerosol)
    no_tracer = wake.drop_vars("tracer")
    np.testing.assert_allclose(extinction_from_tracer(no_tracer, tracer=None), 1e-4 * wake.aerosol)
    alone = extinction_from_tracer(wake.drop_vars("aerosol"), aerosol=None)
    assert (float(alone.min()), float(alone.max())) == pytest.approx((1e-4, 1.8e-3))
    with pytest.raises(InputError, match="both left out"):
        extinction_from_tracer(wake, tracer=None, aerosol=None)


def test_one_reference_puts_two_times_on_one_scale(wake):
    thinner = wake.copy()
    thinner["tracer"] = wake.tracer * 0.9
    same = extinction_from_tracer(thinner, reference=0.4, aerosol=None)
    expected = 1e-4 + 1.7e-3 * (1 - (1 - 0.9) ** 2)
    assert float(same.max()) == pytest.approx(expected, rel=1e-12)
    with pytest.raises(InputError, match=r"extinction.reference: 0.3 .*0.4"):
        extinction_from_tracer(wake, reference=0.3)


def test_speed_by_hand(wake):
    result = extinction_from_speed(wake)
    np.testing.assert_allclose(
        result, 1e-4 + 1.7e-3 * np.array([[[0.5, 0.0], [1.0, 0.5]]]), rtol=1e-12
    )


def test_sample_covers_the_papers_range():
    wake = read_wake(files("lidar_mi.scenes") / "wake_slab_40s.nc", time=40.0)
    result = extinction_from_tracer(wake)
    at_peak = result.values[wake.tracer.values == wake.tracer.values.max()]
    # The tracer's peak gets `maximum`, but for the aerosol's deviation from 1 (within 40 %).
    assert at_peak == pytest.approx(1.8e-3, abs=0.4e-4)
    assert float(result.min()) == pytest.approx(1e-4 * float(wake.aerosol.min()), rel=0.05)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"background": -1e-4}, "background"),
        ({"background": np.nan}, "background"),
        ({"maximum": 1e-4}, "maximum"),
        ({"maximum": np.inf}, "maximum"),
        ({"stretch": 0.5}, "stretch"),
        ({"tracer": "smoke"}, "tracer.*'smoke'.*v, w, tracer, aerosol"),
        ({"aerosol": "dust"}, "aerosol.*'dust'"),
        ({"tracer": "v"}, "minimum of -6"),
        ({"reference": 0.0}, "tracer: 0 "),
    ],
)
def test_bad_input(wake, arguments, words):
    with pytest.raises(InputError, match=words):
        extinction_from_tracer(wake, **arguments)


def test_bad_input_for_speed(wake):
    with pytest.raises(InputError, match="stretch"):
        extinction_from_speed(wake, stretch=0)
    with pytest.raises(InputError, match="'w'"):
        extinction_from_speed(wake.drop_vars("w"))
    with pytest.raises(InputError, match="speed: 0 "):
        extinction_from_speed(wake * 0.0)


def test_negative_or_missing_values_are_refused(wake):
    wake["tracer"] = wake.tracer.where(wake.tracer < 0.4)
    wake["aerosol"] = -wake.aerosol
    with pytest.raises(InputError, match=r"aerosol.*minimum of -1.2"):
        extinction_from_tracer(wake)


def test_a_wake_without_any_tracer_is_reported():
    wake = xr.Dataset({"tracer": ("y", np.zeros(4)), "aerosol": ("y", np.ones(4))})
    with pytest.raises(
        InputError, match=r"extinction.tracer: 0 everywhere, so there is no contrast"
    ):
        extinction_from_tracer(wake)
    # of two times, of which neither has any
    with pytest.raises(InputError, match="0 everywhere"):
        extinction_from_tracer(wake, reference=0.0)
    assert float(extinction_from_tracer(wake, tracer=None).max()) == pytest.approx(1e-4)
