"""Derived products of a scan: linear depolarisation ratio, fraction of multiple scattering."""

import re

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

# Gates whose products are computed together.
_GATES = 16
_ORDER = re.compile(r"order\d+\.S0")


def linear_depolarization(s0: ArrayLike, s1: ArrayLike) -> np.ndarray:
    """Linear depolarisation ratio delta = (S0 - S1) / (S0 + S1), cross over co-polarised light.

    For emission polarised along e_h, the axis that S1 refers to. NaN where no co-polarised light
    was received.
    """
    s0, s1 = np.asarray(s0, float), np.asarray(s1, float)
    parallel = s0 + s1
    return np.divide(s0 - s1, parallel, out=np.full(parallel.shape, np.nan), where=parallel > 0)


def depolarization_stderr(
    s0: ArrayLike, s1: ArrayLike, s0_stderr: ArrayLike, s1_stderr: ArrayLike, correlation: ArrayLike
) -> np.ndarray:
    """Standard error of `linear_depolarization` by linear error propagation.

    s0_stderr, s1_stderr: standard errors of S0 and S1.
    correlation: correlation coefficient of the estimates of S0 and S1. It is near +-1, as both come
        from the same samples; with 0 the error would be many times too large.
    """
    s0, s1 = np.asarray(s0, float), np.asarray(s1, float)
    first, second = s1 * np.asarray(s0_stderr), s0 * np.asarray(s1_stderr)
    # written as a sum of squares, because its terms nearly cancel where all samples agree
    correlation = np.clip(correlation, -1, 1)
    root = 2 * np.sqrt((first - correlation * second) ** 2 + (1 - correlation**2) * second**2)
    total = s0 + s1
    return np.divide(root, total**2, out=np.full(root.shape, np.nan), where=total > 0)


def depolarization_stderr_bound(
    s0: ArrayLike, s1: ArrayLike, s0_stderr: ArrayLike, samples: int
) -> np.ndarray:
    """The largest standard error the depolarisation ratio can have, from that of S0 alone.

    A Monte Carlo sample of weight s contributes x cross- and s - x co-polarised light,
    0 <= x <= s. The error of
    the ratio delta of their sums is that of the mean of (1 + delta) x - delta s, over the mean
    co-polarised light; it lies between -delta s and s, whatever the path of the sample. So for n
    independent samples

        stderr(delta) <= max(1, delta) (1 + delta) sqrt(<s^2> / n) / <s>,
        <s^2> / n = stderr(S0)^2 + S0^2 / n.

    No smaller bound is certain: it would be reached if few samples contributed all the
    depolarisation. In single scattering, where all samples of a beam are nearly equal, the error is
    orders of magnitude smaller.

    samples: number n of independent samples of a pixel and gate.
    """
    s0 = np.asarray(s0, float)
    ratio = linear_depolarization(s0, s1)
    relative = np.divide(s0_stderr, s0, out=np.full(s0.shape, np.nan), where=s0 > 0)
    return np.maximum(1, ratio) * (1 + ratio) * np.sqrt(relative**2 + 1 / samples)


def depolarization_image(scan: xr.Dataset) -> xr.Dataset:
    """Linear depolarisation ratio of a scan, ``depolarization`` and ``depolarization_stderr``.

    The standard error follows from ``S0_stderr``, ``S1_stderr`` and ``S0_S1_correlation`` if the
    scan has them; from ``S0_stderr`` alone it is `depolarization_stderr_bound`, an upper bound.
    See the attribute ``stderr_is_bound`` of ``depolarization_stderr``.

    Raises InputError: the scan was rendered without polarisation, or its light was not emitted
    along e_h.
    """
    if not _emitted_along_e_h(scan):
        raise InputError(
            f"stokes_emitted: {scan.attrs.get('stokes_emitted')} is not allowed for the linear "
            "depolarisation ratio; expected (1, 1, 0, 0), light polarised along the horizontal "
            "axis"
        )
    if not scan.attrs.get("polarized"):
        raise InputError("polarized: 0 is not allowed; expected a scan of a polarised variant")
    names = ("S0", "S1", "S0_stderr", "S1_stderr", "S0_S1_correlation")
    dims = ("gate", "z", "y")
    known = [scan[n].transpose(*dims).values.astype(float) for n in names if n in scan]
    bound = len(known) < len(names)
    if bound:
        s0, s1, s0_stderr = known[:3]
        stderr = depolarization_stderr_bound(s0, s1, s0_stderr, _samples(scan))
    else:
        stderr = depolarization_stderr(*known)
    ratio = linear_depolarization(*known[:2])
    text = "standard error of the linear depolarisation ratio"
    coords = {name: scan.coords[name] for name in dims if name in scan.coords}
    return xr.Dataset(
        {
            "depolarization": (
                dims,
                ratio,
                {"long_name": "linear depolarisation ratio", "units": "1"},
            ),
            "depolarization_stderr": (
                dims,
                stderr,
                {
                    "long_name": f"upper bound of the {text}" if bound else text,
                    "units": "1",
                    "stderr_is_bound": int(bound),
                },
            ),
        },
        coords=coords,
    )


def multiple_scattering_fraction(
    single: ArrayLike,
    multiple: ArrayLike,
    single_stderr: ArrayLike = 0.0,
    multiple_stderr: ArrayLike = 0.0,
    correlation: ArrayLike = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Fraction of the received light that was scattered more than once, and its standard error.

    single, multiple: S0 of scattering order one, and of all orders above it together.
    single_stderr, multiple_stderr: their standard errors.
    correlation: correlation coefficient of the two estimates; 0 when the orders were sampled
        independently, -1 for an upper bound of the error.

    Returns
    -------
    fraction, stderr : arrays
        multiple / (single + multiple); NaN where no light was received.
    """
    single, multiple = np.asarray(single, float), np.asarray(multiple, float)
    total = single + multiple
    fraction = np.divide(multiple, total, out=np.full(total.shape, np.nan), where=total > 0)
    first, second = multiple * np.asarray(single_stderr), single * np.asarray(multiple_stderr)
    correlation = np.clip(correlation, -1, 1)
    # a sum of squares, as in depolarization_stderr
    root = np.sqrt((first - correlation * second) ** 2 + (1 - correlation**2) * second**2)
    root, total = np.broadcast_arrays(root, total)
    stderr = np.divide(root, total**2, out=np.full(root.shape, np.nan), where=total > 0)
    return fraction, stderr


def multiple_scattering_image(scan: xr.Dataset) -> xr.Dataset:
    """Fraction of light scattered more than once, of a scan with separate scattering orders.

    ``multiple_scattering_fraction`` and ``multiple_scattering_fraction_stderr``. A scan has the
    standard error of all orders together: taken as that of the larger part alone, it is an upper
    bound of the error of the fraction, as long as a sample that contributes more to one order does
    not contribute less to another (attribute ``stderr_is_bound``). Where few samples contribute all
    of the multiple scattering, S0_stderr itself is too small for most pixels, and so is the bound.

    Raises InputError: the scan has no orders above one.
    """
    orders = sorted(str(name) for name in scan.data_vars if _ORDER.fullmatch(str(name)))
    if len(orders) < 2 or "order1.S0" not in orders:
        raise InputError(
            f"orders: {', '.join(orders) or 'none'} is not allowed for the fraction of multiple "
            "scattering; expected order1.S0 and others, from an integrator with orders"
        )
    dims = ("gate", "z", "y")
    single, *further = (scan[name].transpose(*dims).values.astype(float) for name in orders)
    fraction, _ = multiple_scattering_fraction(single, sum(further))
    total = single + sum(further)
    stderr = scan["S0_stderr"].transpose(*dims).values.astype(float)
    relative = np.divide(stderr, total, out=np.full(total.shape, np.nan), where=total > 0)
    text = "fraction of light scattered more than once"
    return xr.Dataset(
        {
            "multiple_scattering_fraction": (dims, fraction, {"long_name": text, "units": "1"}),
            "multiple_scattering_fraction_stderr": (
                dims,
                np.maximum(fraction, 1 - fraction) * relative,
                {
                    "long_name": f"upper bound of the standard error of the {text}",
                    "units": "1",
                    "stderr_is_bound": 1,
                },
            ),
        },
        coords={name: scan.coords[name] for name in dims if name in scan.coords},
    )


def with_products(scan: xr.Dataset) -> xr.Dataset:
    """The scan with its derived products, as far as it was rendered for them; float32.

    Adds the variables of `depolarization_image`, if light polarised along e_h was rendered in a
    polarised variant, and of `multiple_scattering_image`, if the scan has separate orders.
    Attributes ``NAME_is_bound`` state whether NAME, a standard error, is an upper bound.
    """
    images = []
    if scan.attrs.get("polarized") and _emitted_along_e_h(scan):
        images.append(depolarization_image)
    if "order2.S0" in scan:
        images.append(multiple_scattering_image)
    for image in images:
        # a few gates at a time: in double precision all of them are several times the scan
        parts = [
            image(scan.isel(gate=slice(first, first + _GATES))).astype(np.float32)
            for first in range(0, scan.sizes["gate"], _GATES)
        ]
        whole = xr.concat(parts, "gate") if len(parts) > 1 else parts[0]
        for name, variable in whole.data_vars.items():
            scan = scan.assign({name: variable})
            if "stderr_is_bound" in variable.attrs:
                scan.attrs[f"{name}_is_bound"] = variable.attrs["stderr_is_bound"]
    return scan


def _emitted_along_e_h(scan: xr.Dataset) -> bool:
    emitted = scan.attrs.get("stokes_emitted")
    return emitted is not None and np.allclose(emitted, (1, 1, 0, 0), rtol=0, atol=1e-6)


def _samples(scan: xr.Dataset) -> int:
    """Independent samples of a pixel and gate; the gated estimator divides a beam's among gates."""
    for name in ("samples_per_beam", "estimator", "gate_count"):
        if name not in scan.attrs:
            raise InputError(f"scan: attribute {name} is missing; expected a scan rendered here")
    samples, gates = scan.attrs["samples_per_beam"], scan.attrs["gate_count"]
    return max(2, -(-samples // gates)) if scan.attrs["estimator"] == "gated" else samples


def untrusted_pixels(scan: xr.Dataset) -> str | None:
    """Warning of a rendered scan on pixels whose standard error rests on one Monte Carlo sample.

    None where there are at most 1 % of those that receive light; see ``S0_largest_share``.
    """
    bright, untrusted = (scan.attrs.get(f"{name}_pixels", 0) for name in ("lit", "untrusted"))
    if untrusted <= 0.01 * bright:
        return None
    return (
        f"in {untrusted} of {bright} pixels that receive light one Monte Carlo sample carries half "
        "of the variance or more; their standard errors are unreliable; expected more samples"
    )
