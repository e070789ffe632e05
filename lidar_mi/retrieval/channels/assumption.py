"""Errors of the speed by wrong assumptions on the line."""

import math
from collections.abc import Sequence

from lidar_mi.errors import InputError
from lidar_mi.retrieval.channels.fit import fit_channels
from lidar_mi.retrieval.channels.model import (
    PARAMETERS,
    ChannelModel,
    mean_and_jacobian,
    parameter_vector,
)
from lidar_mi.retrieval.rings.model import PixelNoise


def assumption_error(
    model: ChannelModel,
    level: float,
    noise: PixelNoise | None = None,
    *,
    assumed: str,
    by: float,
    v_los: float = 0.0,
    temperature: float | None = None,
    aerosol: float = 0.0,
    free: Sequence[str] = ("v_los", "level"),
) -> float:
    """Error of the speed, m/s, where a parameter is assumed ``by`` too large.

    By the fit of signals without noise: not only to first order. The light has ``level`` electrons
    in front of the receiver and, by default, the model's middle temperature; ``by`` is in K, or a
    fraction. The ``free`` ones of `lidar_mi.retrieval.channels.model.PARAMETERS` are fitted.

    Raises InputError: numbers out of range, a parameter that is free.
    """
    if assumed in free or assumed not in ("temperature", "aerosol"):
        raise InputError(f"assumed: {assumed!r} is not allowed; expected one that is not free")
    truth = parameter_vector(model, v_los, level, temperature, aerosol)
    mean = mean_and_jacobian(model, truth)[0]
    values = dict(zip(PARAMETERS[2:], truth[0, 2:].tolist(), strict=True))
    values[assumed] += by
    fit = fit_channels(mean, model, noise, free=free, max_chi_square=math.inf, **values)
    return float(fit.v_los[0]) - v_los
