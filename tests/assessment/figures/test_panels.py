"""Parts of figures. Detects a colour bar whose ticks are all the same number."""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.figures.panels import image_panel, sheet


@pytest.mark.parametrize(("spread", "uniform"), [(1e-4, True), (0.0, True), (0.5, False)])
def test_a_field_of_one_value_is_called_uniform(spread, uniform):
    axis = np.arange(3.0)
    field = xr.DataArray(
        2 + spread * np.linspace(0, 1, 9).reshape(3, 3), {"z": axis, "y": axis}, ("z", "y")
    )
    figure, axes = sheet(1, 1)
    image_panel(axes[0, 0], field, "title", "extinction")
    figure.canvas.draw()
    bar = figure.axes[1]
    assert bar.get_ylabel() == ("extinction, uniform" if uniform else "extinction")
    ticks = [text.get_text() for text in bar.get_yticklabels()]
    assert len(ticks) == len(set(ticks))
    if uniform:
        assert ticks == ["2"]
