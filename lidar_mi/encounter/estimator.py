"""From two images of a slab of air to its wind and its vortices, fast enough to be flown with."""

import time
from collections.abc import Sequence
from contextlib import contextmanager

import xarray as xr

from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.winds import window_settings
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST
from lidar_mi.retrieval.velocimetry.wind import retrieve_wind
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.vortices.pair import VortexPairFit


class Estimator:
    """What an aircraft's computer does with every pair of images.

    Without an expected pair the methods start from nothing. With one they start from it: the
    results are the same within a small part of their errors, in a fraction of the time.

    Parameters
    ----------
    experiment : Experiment
        Its `retrieval` has the windows and the method of the wind: the most accurate one listed.
    vectors : bool
        Whether the wind is retrieved besides the vortices.
    """

    def __init__(self, experiment: Experiment, *, vectors: bool = True):
        settings = experiment.retrieval
        methods = [method for method in MOST_ACCURATE_FIRST if method in settings.methods]
        self.method = str(methods[0]) if vectors and methods else None
        self.windows = window_settings(settings)

    def pair_of(
        self,
        image1: xr.DataArray,
        image2: xr.DataArray,
        dt: float,
        noise: float | xr.DataArray | None = None,
        expected: VortexPairFit | None = None,
        *,
        times: Sequence[xr.DataArray] | None = None,
    ) -> tuple[xr.Dataset | None, VortexPairFit, dict[str, float]]:
        """Wind, vortices and the time that each took.

        Parameters
        ----------
        image1, image2 : DataArray, dims (z, y)
        dt : float
            s.
        noise : float or DataArray, optional
            As `fit_vortices` takes it.
        expected : VortexPairFit, optional
            The pair expected at mid-time, with its covariance.
        times : sequence of two DataArray, optional
            Of the pixels, as `fit_vortices` takes them.

        Returns
        -------
        wind : Dataset or None
            As `retrieve_wind` gives it; None without a method of vectors.
        pair : VortexPairFit
            Its `from_start` says whether it was found near the expected one.
        seconds : dict
            Of the parts `vortices` and `wind`.
        """
        seconds: dict[str, float] = {}
        with _timed(seconds, "vortices"):
            pair = fit_vortices(image1, image2, dt, noise, times=times, start=expected)
        wind = None
        if self.method is not None:
            with _timed(seconds, "wind"):
                wind = retrieve_wind(
                    image1, image2, dt, self.method, noise=noise, times=times, **self.windows
                )
        return wind, pair, seconds


@contextmanager
def _timed(seconds: dict[str, float], part: str):
    """Put the time that the block takes under its name."""
    began = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - began
