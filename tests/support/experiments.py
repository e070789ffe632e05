"""Small experiments and wakes of the system tests, and what the demo writes."""

from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO

import numpy as np
import OpenEXR
import pytest
import xarray as xr
from matplotlib import rc_context, rcParamsDefault
from matplotlib.backends.backend_agg import FigureCanvasAgg

from lidar_mi import __version__
from lidar_mi.experiment import pipeline
from lidar_mi.io import png
from lidar_mi.schema import reading as config

_PNG = png._png
FIXED = {"axes.titley": 1.0, "legend.loc": "upper right"}
SOURCES = ("extinction", "extinction_without_texture", "extinction_blurred", "backscatter")

FIGURES = set(
    (
        "fig00_overview fig05_extinction fig06_wind_from_extinction fig07_deviation_from_truth "
        "fig08_backscatter fig09_backscatter_against_extinction fig10_wind_from_backscatter "
        "fig11_deviation_from_extinction_winds fig12_error_by_texture fig12b_error_and_bound "
        "fig14_depolarization fig15_multiple_scattering"
    ).split()
)


def small(name="small", **wake):
    """A vortex pair seen by 61 x 41 beams in single scattering, as a dictionary; no molecules."""
    wake["extinction"] = {"molecules": 0} | wake.get("extinction", {})
    pair = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
    return {
        "name": name,
        "wake": {"vortex_pair": pair, **wake},
        "render": {"samples_per_beam": 8, "max_order": 1},
        "retrieval": {"methods": ["cc"]},
    }


def check(data):
    return config.check(data, "test")


def write_wake(path, tracer, v=10.0, w=5.0, x=None):
    """A uniform wind that carries ``tracer(y, z)`` or ``tracer(x, y, z)``; even aerosol; 1 m."""
    axes = {"y": np.arange(-20, 20.5, 1.0), "z": np.arange(-15, 15.5, 1.0)}
    if x is not None:
        axes = {"x": x, **axes}
    grid = np.meshgrid(*axes.values(), indexing="ij")
    fields = {
        "v": (v, "m s-1"),
        "w": (w, "m s-1"),
        "aerosol": (1.0, "1"),
        "tracer": (tracer(*grid), "1"),
    }
    data = xr.Dataset(
        {
            name: (tuple(axes), np.broadcast_to(values, grid[0].shape).copy(), {"units": unit})
            for name, (values, unit) in fields.items()
        },
        coords={name: (name, values, {"units": "m"}) for name, values in axes.items()},
    )
    data.to_netcdf(path, engine="h5netcdf")
    return path.name


def blob(y0, z0, sigma=1.5):
    return lambda y, z: np.exp(-((y - y0) ** 2 + (z - z0) ** 2) / (2 * sigma**2))


def as_seen(path):
    """The image as any EXR program has it: row 0 at the top, column 0 at the left."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.array(file.channels()["Y"].pixels)


def leave_out_figures(patch):
    """Take the backscatter lidar's figures and its texture sweep out of all runs."""
    patch.setattr("lidar_mi.assessment.figures.backscatter.draw_all", lambda *_: [])
    patch.setattr("lidar_mi.experiment.stages.texture.LEVELS", ())


@contextmanager
def sketched_figures():
    """Figures drawn once, at 40 dots per inch, every artist where it stands by default.

    A file of a whole figure takes two drawings, of which the first finds room for labels.
    """

    def sketch(figure, **_):
        figure.set_layout_engine("none")
        figure.set_dpi(40)
        buffer = BytesIO()
        software = {"Software": f"lidar-mi {__version__}"}
        FigureCanvasAgg(figure).print_png(buffer, metadata=software)
        return buffer.getvalue()

    # places that would be searched for at every drawing
    with pytest.MonkeyPatch.context() as patch, rc_context(FIXED):
        patch.setattr("lidar_mi.io.png._png", sketch)
        yield


@contextmanager
def whole_figures():
    """Figures as a user's run draws them, also within `sketched_figures`."""
    with (
        pytest.MonkeyPatch.context() as patch,
        rc_context({key: rcParamsDefault[key] for key in FIXED}),
    ):
        patch.setattr("lidar_mi.io.png._png", _PNG)
        yield


def replace_stages(patch, **computes):
    """Let stages of all runs compute something else; None: leave the stage out."""
    left = [stage for stage in pipeline.STAGES if computes.get(stage.name, True) is not None]
    changed = [replace(s, compute=computes[s.name]) if s.name in computes else s for s in left]
    patch.setattr(pipeline, "STAGES", tuple(changed))


@contextmanager
def without_figures():
    """Runs without figures and texture sweep, most of a small run's time: the demo has them."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_figures(patch)
        yield


QUICK_DOPPLER = {
    "v_los": ["70 m/s"],
    "camera": {"pixel": "29.6 um", "width": 240, "height": 195},
    "ccd": {"full_well": 1e6},
    "retrieval": {"methods": ["annular"], "averaged": [1], "images": 2, "slow_images": 0},
    "path_samples": 0,
    "render": {"samples_per_pixel": 16},
}
"""A Doppler lidar whose images take no time: as many photons on a sixteenth of the pixels."""
