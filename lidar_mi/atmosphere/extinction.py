"""Extinction coefficient (m^-1) from the tracer and aerosol fields of a flow simulation."""

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError


def _check(background: float, maximum: float, stretch: float) -> None:
    if not (np.isfinite(background) and background >= 0):
        raise InputError(
            f"extinction.background: {background} m^-1 is not allowed; it must be >= 0"
        )
    if not (np.isfinite(maximum) and maximum > background):
        raise InputError(
            f"extinction.maximum: {maximum} m^-1 is not allowed; "
            f"it must exceed the background {background} m^-1"
        )
    if not (np.isfinite(stretch) and stretch >= 1):
        raise InputError(f"extinction.stretch: {stretch} is not allowed; it must be >= 1")


def _variable(wake: xr.Dataset, name: str, key: str) -> xr.DataArray:
    if name not in wake.data_vars:
        raise InputError(
            f"extinction.{key}: the wake has no variable {name!r}; it has "
            f"{', '.join(map(str, wake.data_vars))}"
        )
    field = wake[name].astype(float)
    lowest = float(field.min())
    # so that NaN is refused, too
    if not lowest >= 0:
        raise InputError(
            f"extinction.{key}: variable {name!r} has a minimum of {lowest:g}; it must be >= 0"
        )
    return field


def _stretched(
    field: xr.DataArray, stretch: float, reference: float | None, key: str
) -> xr.DataArray:
    """1 - (1 - x)^stretch with x = field/reference."""
    largest = float(field.max())
    # 0 / 0: an empty field has no largest value to refer to
    if largest == 0 and not reference:
        raise InputError(
            f"extinction.{key}: 0 everywhere, so there is no contrast; expected values above 0, "
            "or null for air without it"
        )
    if reference is None:
        reference = largest
    if not (np.isfinite(reference) and reference > 0):
        raise InputError(
            f"extinction.{key}: {reference:g} as the value of maximum extinction is not "
            "allowed; it must be > 0"
        )
    if largest > reference:
        raise InputError(
            f"extinction.reference: {reference:g} is below the largest value {largest:g} "
            f"of {key}; it must be at least that, as no value is clipped"
        )
    return 1 - (1 - field / reference) ** stretch


def _finished(
    extinction: xr.DataArray, background: float, maximum: float, stretch: float
) -> xr.DataArray:
    extinction = extinction.rename("extinction")
    extinction.attrs = {
        "units": "m-1",
        "long_name": "extinction coefficient",
        "background": background,
        "maximum": maximum,
        "stretch": stretch,
    }
    return extinction


def extinction_from_tracer(
    wake: xr.Dataset,
    background: float = 1e-4,
    maximum: float = 1.8e-3,
    stretch: float = 2.0,
    tracer: str | None = "tracer",
    aerosol: str | None = "aerosol",
    reference: float | None = None,
) -> xr.DataArray:
    """Extinction from the exhaust tracer and the stirred background aerosol.

    E = background * aerosol + (maximum - background) * (1 - (1 - x)^stretch), with
    x = tracer/reference in [0, 1]: a contrast stretch that raises thin tracer by the factor
    `stretch` (the slope at x = 0) and keeps both ends. It is monotone, so the order of values is
    kept, and no value is clipped; `stretch` = 1 is linear. The paper states "a
    stretching factor of 2.0" and that relative structure is maintained, but no formula: this
    reading of it is ours. Where aerosol > 1, E may pass `maximum` by background*(aerosol - 1).

    wake: holds the named variables, >= 0; the aerosol relative to its mean.
    background, maximum: m^-1, background >= 0 and maximum > background.
    stretch: >= 1.
    tracer, aerosol: variable names; None leaves that part out (no exhaust; a smooth background).
    reference: tracer value that gets `maximum`; default its largest value here. Give it to put two
        times on one scale.

    Raises InputError: numbers out of range, missing or negative variables, a reference below the
    data.

    Returns
    -------
    xarray.DataArray
        m^-1, dims of the wake's variables.
    """
    _check(background, maximum, stretch)

    def exhaust(name: str) -> xr.DataArray:
        fraction = _stretched(_variable(wake, name, "tracer"), stretch, reference, "tracer")
        # added to the background: the largest tracer has the maximum where the aerosol is 1
        return (maximum - background) * fraction

    if aerosol is not None:
        extinction = background * _variable(wake, aerosol, "aerosol")
        if tracer is not None:
            extinction = extinction + exhaust(tracer)
    elif tracer is not None:
        extinction = background + exhaust(tracer)
    else:
        raise InputError("extinction: tracer and aerosol are both left out; allowed: at most one")
    return _finished(extinction, background, maximum, stretch)


def extinction_from_speed(
    wake: xr.Dataset,
    background: float = 1e-4,
    maximum: float = 1.8e-3,
    stretch: float = 1.0,
    reference: float | None = None,
) -> xr.DataArray:
    """Extinction (m^-1) from the cross-flow speed (v^2 + w^2)^(1/2), the paper's alternative.

    For data without a tracer. According to the paper, such structures may be physically incorrect:
    speed is not an aerosol. E = background + (maximum - background) (1 - (1 - x)^stretch),
    x = speed/reference. The reference (m/s) is by default the largest speed; all else is as in
    `extinction_from_tracer`.
    """
    _check(background, maximum, stretch)
    for name in ("v", "w"):
        if name not in wake.data_vars:
            raise InputError(
                f"extinction: the wake has no variable {name!r}; it has "
                f"{', '.join(map(str, wake.data_vars))}"
            )
    speed = xr.ufuncs.hypot(wake["v"].astype(float), wake["w"].astype(float))
    fraction = _stretched(speed, stretch, reference, "speed")
    return _finished(background + (maximum - background) * fraction, background, maximum, stretch)
