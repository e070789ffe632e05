"""Vortex pairs as a small JSON file, from which a controller can compute the wind ahead."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.json import read_json, write_json
from lidar_mi.retrieval.vortices.model import PARAMETERS, Profile
from lidar_mi.retrieval.vortices.pair import VortexPairFit

FORMAT = "lidar-mi vortex pairs 1"

_FRAME = (
    "y to port, z up, m, from the telescope's axis; circulation > 0 rotates from +y towards +z; "
    "parameters in SI units, log_radius the natural logarithm of the core radius in m; "
    "wind at mid-time of the two images"
)
_NUMBERS = ("chi2", "correlation", "model_error", "model_error_length")


@checked_arguments
def write_vortices(path: str | Path, fits: Mapping[str, VortexPairFit], **about: str) -> None:
    """Write vortex pairs by name, with their covariance and derived quantities.

    Numbers that are not finite become null.

    Parameters
    ----------
    path : path
    fits : mapping of str to VortexPairFit
    **about
        Further attributes of the file, such as ``source``.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> vortices = [300.0, np.log(3.0), 15.0, 0.0, -300.0, np.log(3.0), -15.0, 0.0, 0.0, 0.0]
    >>> chi2, correlation, model_error, model_error_length = 1.0, 1.0, 0.0, 0.0
    >>> pair = lm.VortexPairFit(
    ...     np.array(vortices), np.eye(10), "lamb_oseen",
    ...     chi2, correlation, model_error, model_error_length,
    ... )
    >>> lm.write_vortices("vortex.json", {"mine": pair})
    >>> lm.read_vortices("vortex.json")["mine"].port.circulation
    300.0
    """
    data: dict[str, Any] = {
        "format": FORMAT,
        **about,
        "frame": _FRAME,
        "parameters": list(PARAMETERS),
    }
    data["fits"] = {name: _as_data(fit) for name, fit in fits.items()}
    write_json(path, data)


def _as_data(fit: VortexPairFit) -> dict[str, Any]:
    return {
        "success": fit.success,
        "reasons": list(fit.reasons),
        "profile": fit.profile,
        "parameters": [_number(p) for p in fit.parameters],
        "covariance": [[_number(c) for c in row] for row in fit.covariance],
        **{name: _number(getattr(fit, name)) for name in _NUMBERS},
        "quantities": {
            name: {
                "value": _number(q.value),
                "stderr": _number(q.stderr),
                "units": q.units,
                "long_name": q.long_name,
            }
            for name, q in fit.quantities.items()
        },
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@checked_arguments
def read_vortices(path: str | Path) -> dict[str, VortexPairFit]:
    """Vortex pairs by name, as a run writes them into ``vortex.json``.

    Parameters
    ----------
    path : path

    Returns
    -------
    dict of str to VortexPairFit
        `VortexPairFit.wind` gives the wind of each anywhere, with its standard error.

    Raises
    ------
    InputError
        Not readable, another format, or an invalid covariance.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> vortices = [300.0, np.log(3.0), 15.0, 0.0, -300.0, np.log(3.0), -15.0, 0.0, 0.0, 0.0]
    >>> chi2, correlation, model_error, model_error_length = 1.0, 1.0, 0.0, 0.0
    >>> pair = lm.VortexPairFit(
    ...     np.array(vortices), np.eye(10), "lamb_oseen",
    ...     chi2, correlation, model_error, model_error_length,
    ... )
    >>> lm.write_vortices("vortex.json", {"mine": pair})
    >>> lm.read_vortices("vortex.json")["mine"].port.circulation
    300.0
    """
    data = read_json(path, "a file of vortex pairs")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a file of vortex pairs; expected the format {FORMAT!r}")
    if not isinstance(data.get("fits"), dict):
        raise InputError(f"{path}: fits: missing; expected fits by name")
    return {name: _from_data(fit, f"{path}: fits.{name}") for name, fit in data["fits"].items()}


def _from_data(data: dict[str, Any], where: str) -> VortexPairFit:
    try:
        parameters = np.array(data["parameters"], dtype=float)
        covariance = np.array(data["covariance"], dtype=float)
        stored = {name: data[name] for name in _NUMBERS}
        numbers = {n: math.nan if x is None else float(x) for n, x in stored.items()}
        profile, reasons = data["profile"], tuple(map(str, data["reasons"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {type(error).__name__} {error}; expected parameters, covariance, profile, "
            f"reasons, {', '.join(_NUMBERS)}"
        ) from None
    size = len(PARAMETERS)
    if parameters.shape != (size,) or covariance.shape != (size, size):
        raise InputError(
            f"{where}: {parameters.shape} parameters with {covariance.shape} covariances; expected "
            f"{size} and {size} x {size}"
        )
    if profile not in get_args(Profile):
        raise InputError(
            f"{where}.profile: {profile!r} is not one of {', '.join(get_args(Profile))}"
        )
    if not reasons:
        finite = np.isfinite(parameters).all() and np.isfinite(covariance).all()
        if not finite or not np.allclose(covariance, covariance.T):
            raise InputError(
                f"{where}.covariance: not symmetric and finite; expected that of a fit"
            )
    return VortexPairFit(
        parameters,
        covariance,
        profile,
        **numbers,
        reasons=reasons,
        from_start=False,
        turned=None,
        inclined=None,
        slopes=None,
        slope_covariance=None,
        ambient=None,
        shared=None,
    )
