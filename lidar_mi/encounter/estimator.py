"""From two images of a slab of air to its wind and its vortices, fast enough to be flown with."""

import time
from collections.abc import Sequence
from contextlib import contextmanager

import torch
import xarray as xr

from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.winds import window_settings
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST, ImageMethod
from lidar_mi.retrieval.velocimetry.next_flow import Flow
from lidar_mi.retrieval.velocimetry.slabs import wind_of_slab
from lidar_mi.retrieval.velocimetry.wind import retrieve_wind
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.vortices.model import wind as model_wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit


class Estimator:
    """What an aircraft's computer does with every pair of images.

    Without an expected pair the methods start from nothing. With one they start from it, and the
    wind from the last one as well: errors are the same in a fraction of the time.

    Parameters
    ----------
    experiment : Experiment
        Its `retrieval` has the windows and the method of the wind: the most accurate one listed.
        Only "variational" has a fast form.
    vectors : bool
        Whether the wind is retrieved besides the vortices.
    """

    def __init__(self, experiment: Experiment, *, vectors: bool = True):
        settings = experiment.retrieval
        methods = [method for method in MOST_ACCURATE_FIRST if method in settings.methods]
        self._method = methods[0] if vectors and methods else None
        self._windows = window_settings(settings)
        # the last slab's flow and pair, from which the next wind starts
        self._last: tuple[Flow, VortexPairFit] | None = None

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
            As `retrieve_wind` gives it; None without a method of vectors. By "variational" its
            attribute `from_start` says whether it was found from the last one.
        pair : VortexPairFit
            Its `from_start` says whether it was found from the expected one.
        seconds : dict
            Of the parts `vortices` and `wind`.
        """
        seconds: dict[str, float] = {}
        with _timed(seconds, "vortices"):
            pair = fit_vortices(image1, image2, dt, noise, times=times, start=expected)
        if self._method is None:
            return None, pair, seconds
        with _timed(seconds, "wind"):
            options = self._windows | {"noise": noise, "times": times}
            if self._method == ImageMethod.VARIATIONAL:
                start = self._expected(image1, dt, pair) if expected is not None else None
                wind, flow = wind_of_slab(image1, image2, dt, start, **options)
                self._last = (flow, pair) if flow is not None and pair.success else None
            else:
                wind = retrieve_wind(image1, image2, dt, str(self._method), **options)
        return wind, pair, seconds

    def _expected(self, image: xr.DataArray, dt: float, pair: VortexPairFit) -> Flow | None:
        """The last flow, moved with the pair and changed as the winds of both pairs differ."""
        if self._last is None or not pair.success:
            return None
        flow, before = self._last
        if image.shape != flow.windows.shape:
            return None
        y, z = (torch.as_tensor(image[name].values.astype(float)) for name in ("y", "z"))
        step = [float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (z, y)]
        now, then = (torch.as_tensor(fit.parameters) for fit in (pair, before))
        shift = [float((now - then)[places].mean()) for places in ([3, 7], [2, 6])]
        moved = then.clone()
        moved[[3, 7]] += shift[0]
        moved[[2, 6]] += shift[1]
        places = torch.meshgrid(z, y, indexing="ij")[::-1]
        v, w = (
            a - b
            for a, b in zip(
                *(model_wind(theta, *places, pair.profile) for theta in (now, moved)), strict=True
            )
        )
        change = torch.stack([w * dt / step[0], v * dt / step[1]])
        return flow.moved([by / size for by, size in zip(shift, step, strict=True)], change)


@contextmanager
def _timed(seconds: dict[str, float], part: str):
    """Put the time that the block takes under its name."""
    began = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - began
