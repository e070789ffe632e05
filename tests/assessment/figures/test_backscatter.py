"""Scales of figures. Detects colours that hide what there is, and axes without numbers."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.backscatter import _bright
from lidar_mi.assessment.figures.panels import by_factors
from lidar_mi.assessment.figures.sensor import _colours


def test_winds_of_one_direction_are_coloured_over_their_own_range():
    both = _colours(np.array([-1.0, 3.0, np.nan]))
    assert both["vmin"] == -both["vmax"] and both["vmax"] == pytest.approx(3, rel=0.01)
    wind = np.linspace(6, 8, 201)
    for sign in (1, -1):
        one = _colours(sign * wind)
        assert one["vmin"] < one["vmax"]
        assert sorted(abs(one[key]) for key in ("vmin", "vmax")) == pytest.approx([6, 8], abs=0.02)
    nothing = _colours(np.array([np.nan]))
    assert (nothing["vmin"], nothing["vmax"]) == (-1, 1)


def test_colours_begin_at_zero_unless_all_pixels_are_bright():
    ramp = xr.DataArray(np.linspace(0.0, 1.0, 1001))
    assert _bright([ramp]).vmin == 0 and _bright([ramp]).vmax == pytest.approx(1, abs=2e-3)
    lit = _bright([1 + ramp, 1.5 + ramp])
    assert (lit.vmin, lit.vmax) == pytest.approx((1, 2.5), abs=2e-3)


@pytest.mark.parametrize(("values", "scale"), [((0.43, 0.5), "linear"), ((0.05, 5, np.nan), "log")])
def test_axes_go_by_factors_where_values_do(values, scale):
    figure = Figure()
    axes = figure.subplots()
    axes.plot(values)
    by_factors(axes)
    figure.draw_without_rendering()
    assert axes.get_yscale() == scale
    low, high = axes.get_ylim()
    shown = [t.get_text() for t in axes.get_yticklabels() if low <= t.get_position()[1] <= high]
    assert len(shown) >= 2 and all("e" not in text and "^" not in text for text in shown)
