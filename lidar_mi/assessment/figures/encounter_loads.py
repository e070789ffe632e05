"""The figure of the loads of the structure, and of the controls against them."""

from collections.abc import Callable

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.panels import Captioned

Lines = Callable[[Axes, xr.Dataset, str, float], None]
"""Draws a variable of all flights, times a factor."""


def load_factor(series: xr.Dataset, lines: Lines) -> Captioned:
    """Load factor, bending of the wing root, pitch rate and deflections over time."""
    figure = Figure(figsize=(10.5, 9.0), layout="compressed")
    load, bending, rate, controls = figure.subplots(4, 1, sharex=True, height_ratios=(3, 2, 2, 2))
    port, starboard = series["port_bending"], series["starboard_bending"]
    loads = series.assign(bending=(port + starboard) / 2)
    degrees = float(np.degrees(1))
    lines(load, series, "load_factor", 1.0)
    lines(bending, loads, "bending", 1e-3)
    lines(rate, series, "pitch_rate", degrees)
    lines(controls, series, "elevator_deflection", degrees)
    load.set_ylabel("load factor")
    bending.set_ylabel("bending / kN m")
    rate.set_ylabel("pitch rate / degrees s$^{-1}$")
    controls.set(ylabel="elevator / degrees", xlabel="time of flight / s")
    load.legend(fontsize=9, loc="best")
    return figure, (
        "Load factor at the centre of gravity; bending moment of the wing root, mean of both "
        "wings, change from the trim; pitch rate, nose up; elevator, which moves the nose down."
    )
