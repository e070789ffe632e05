"""Errors of line-of-sight winds: standard deviation and bias, with their standard errors."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lidar_mi.assessment.metrics.names import ring_key
from lidar_mi.retrieval.method_names import RingCentre, RingMethod

if TYPE_CHECKING:
    import xarray as xr


READERS: Mapping[str, str] = {
    RingMethod.ANNULAR: "all rings, full model",
    RingMethod.PIXELS: "all rings, every pixel",
    RingMethod.CA: "CA, peak in r",
    RingMethod.CA_R2: "CA, peak in r²",
    RingMethod.ML: "ML, peak in r",
    RingMethod.SG: "Savitzky-Golay, peak in r",
}
"""Names of the methods in figures and tables."""

PEAK_READERS = (RingMethod.CA, RingMethod.CA_R2, RingMethod.ML, RingMethod.SG)
"""Methods that use the peak of the innermost ring."""

CENTRES: Mapping[str, str] = {RingCentre.FREE: "centre found", RingCentre.KNOWN: "centre known"}


def velocity_metrics(velocities: "xr.Dataset") -> dict[str, float]:
    """Error measures of every method, centre and number of averaged images.

    Keys ``doppler.METHOD.centre_CENTRE.averaged_N.`` and, all but the first in m/s,

    retrieved_fraction  fraction of the images from which a wind was retrieved
    bias            mean over the speeds of each speed's mean error
    bias_stderr     standard error of the bias
    bias_lowest, bias_highest   mean error of the speed at which it is lowest, highest
    std             standard deviation about each speed's own mean, pooled over all speeds
    std_stderr      its standard error, std / sqrt(2 degrees of freedom), for normal errors
    expected_std    root mean square of the random standard deviations as stated
    expected_systematic   of the systematic ones, common to all images

    Undetermined measures are absent.

    velocities: ``v`` and ``v_std`` with dims (algorithm, centre, averaged, v_los, image), NaN where
        there is none, ``v_systematic`` likewise, and ``tried`` (algorithm), the images of every
        case.
    """
    metrics = {}
    for algorithm in velocities["algorithm"].values:
        tried = int(velocities["tried"].sel(algorithm=algorithm))
        for centre in velocities["centre"].values:
            for averaged in velocities["averaged"].values:
                case = velocities.sel(algorithm=algorithm, centre=centre, averaged=averaged)
                error = (case["v"] - case["v_los"]).transpose("v_los", "image").values
                measures = _spread(error, tried)
                for name, part in (("std", "v_std"), ("systematic", "v_systematic")):
                    expected = case[part].values if part in case else np.empty(0)
                    expected = expected[np.isfinite(expected)]
                    if expected.size:
                        measures[f"expected_{name}"] = float(np.sqrt((expected**2).mean()))
                for name, value in measures.items():
                    metrics[ring_key(algorithm, centre, averaged, name)] = value
    return metrics


def _spread(error: np.ndarray, tried: int) -> dict[str, float]:
    """Measures of errors (speeds, images)."""
    finite = np.isfinite(error)
    count = finite.sum(1)
    measures = {}
    if tried:
        measures["retrieved_fraction"] = float(count.sum() / (tried * len(error)))
    measured = count > 0
    if not measured.any():
        return measures
    means = np.nansum(error[measured], 1) / count[measured]
    measures |= {
        "bias": float(means.mean()),
        "bias_lowest": float(means.min()),
        "bias_highest": float(means.max()),
    }
    # the mean of each speed takes a degree of freedom
    freedom = int((count[measured] - 1).sum())
    if freedom:
        std = math.sqrt(np.nansum((error[measured] - means[:, None]) ** 2) / freedom)
        # of a mean over speeds, each mean of variance std^2 / n
        measures["bias_stderr"] = std * math.sqrt((1 / count[measured]).sum()) / measured.sum()
        measures["std"] = std
        measures["std_stderr"] = std / math.sqrt(2 * freedom)
    return {name: float(value) for name, value in measures.items()}
