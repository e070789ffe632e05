"""Reading a detector: counted photoelectrons, their noise by cause, scans with noise.

Counts are the charge collected in a gate, in units of one mean photoelectron: an analogue
receiver, as the paper's light levels need (10^5 photoelectrons in 17 ns leave no single pulses to
count). Saturation, dead time, afterpulses and the steps of a digitiser are neglected.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError
from lidar_mi.instrument.attenuated_backscatter import attenuated_backscatter
from lidar_mi.instrument.detector import (
    Detector,
    background_photoelectrons,
    dark_counts,
    efficiency,
    gate_duration,
    signal_photoelectrons,
)
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.instrument.speckle import speckle_modes


class Detection(NamedTuple):
    """One noisy reading: ``counts`` (photoelectrons), estimated ``s0`` and its ``s0_std``."""

    counts: np.ndarray
    s0: np.ndarray
    s0_std: np.ndarray


def noise_terms(
    signal: np.ndarray,
    background: np.ndarray,
    dark: np.ndarray,
    modes: float | np.ndarray,
    detector: Detector,
    pulses: int = 1,
) -> dict[str, np.ndarray]:
    """Variances of the counts by cause: shot, speckle, background, dark, readout.

    Counts of partly coherent light are Poisson with a Gamma distributed mean, that is negative
    binomial: variance n + n^2 / M (Mandel 1959; Goodman, Statistical Optics, section 9.2). Gain
    noise multiplies the Poisson part by F, never the speckle's: the variance of a sum of N gains of
    mean 1 is <N> (F - 1) + var N.

    signal, background, dark: mean photoelectrons of all pulses.
    modes: degrees of freedom of the signal's speckle, in all pulses; infinite: none.
    pulses: each is read out.
    """
    factor = detector.excess_noise_factor
    return {
        "shot": factor * signal,
        "speckle": signal**2 / modes,
        "background": factor * background,
        "dark": factor * dark,
        "readout": np.asarray(pulses * detector.readout_noise**2),
    }


def noise_variance(
    signal: np.ndarray,
    background: np.ndarray,
    dark: np.ndarray,
    modes: float | np.ndarray,
    detector: Detector,
    pulses: int = 1,
) -> np.ndarray:
    """Variance of the counts, the sum of `noise_terms`."""
    terms = noise_terms(signal, background, dark, modes, detector, pulses)
    return np.asarray(sum(terms.values()))


def detect(
    s0: ArrayLike,
    lidar: BackscatterLidar,
    detector: Detector,
    duration: ArrayLike,
    distance: ArrayLike,
    seed: int | Sequence[int],
    polarization: ArrayLike = 1.0,
    pulses: int = 1,
) -> Detection:
    """Read the detector once, with independent noise of every pixel.

    The signal's mean is drawn from a Gamma distribution (speckle), photoelectrons of signal,
    background and dark current together from a Poisson one, their summed gain from a Gamma one of
    mean N and variance N (F - 1), and read-out noise is Gaussian. Known means of background and
    dark counts are subtracted, so the estimate is unbiased and may be negative.

    s0: received energy over emitted pulse energy, without noise.
    duration: time in which the gate is recorded, s.
    distance: range of the gate, m.
    seed: images with independent noise need different ones.
    polarization: degree of polarisation of the received light, 0 to 1.
    pulses: whose counts are added up, each with noise and speckle of its own.

    Raises InputError: S0 negative or not finite, light beyond 10^15 photoelectrons, duration,
    distance, polarisation or seed out of range.

    Returns
    -------
    Detection
        All of one shape. ``s0_std`` is the exact standard deviation of ``s0`` for this mean; from
        measured counts alone, `noise_variance` of the estimated signal is its estimate.
    """
    s0 = np.asarray(s0, float)
    _check("S0", s0, s0 >= 0, "finite values, 0 or more")
    for name, value in (("duration", duration), ("distance", distance)):
        value = np.asarray(value, float)
        _check(name, value, value > 0, "finite values above 0")
    polarization = np.asarray(polarization, float)
    within = (polarization >= 0) & (polarization <= 1)
    _check("polarization", polarization, within, "0 to 1")
    random = _generator(seed)
    signal, background, dark, modes = expected_counts(
        s0, lidar, detector, duration, distance, polarization, pulses
    )
    if signal.size and (signal + background + dark).max() > 1e15:
        raise InputError(
            f"lidar.pulse_energy: {lidar.pulse_energy:g} J is not allowed; it gives up to "
            f"{(signal + background + dark).max():g} photoelectrons a gate, expected 1e15 at most"
        )
    # mean n and variance n^2 / M
    light = random.gamma(modes, signal / modes) if detector.speckle else signal
    counts = np.asarray(random.poisson(light + background + dark), float)
    spread = detector.excess_noise_factor - 1
    if spread > 0:
        # shape times scale is N, shape times scale squared N (F - 1)
        counts = random.gamma(counts / spread, spread)
    if detector.readout_noise > 0:
        # variances of the read-outs add
        readout = math.sqrt(pulses) * detector.readout_noise
        counts = counts + random.normal(0, readout, counts.shape)
    # photoelectrons of all pulses per S0, which is relative to the energy of one
    sensitivity = pulses * signal_photoelectrons(1, lidar.pulse_energy, lidar.wavelength, detector)
    variance = noise_variance(signal, background, dark, modes, detector, pulses)
    return Detection(
        counts, (counts - background - dark) / sensitivity, np.sqrt(variance) / sensitivity
    )


def noisy_scan(
    scan: xr.Dataset,
    lidar: BackscatterLidar,
    detector: Detector,
    seed: int | Sequence[int],
    plan: ScanPlan | None = None,
    pulses: int = 1,
) -> xr.Dataset:
    """A scan with the detector's noise, in addition to the noise-free image.

    Adds ``S0_noisy`` and ``S0_noise_std`` (gate, z, y), ``Y_noisy`` and ``Y_noise_std`` (z, y), the
    attenuated backscatter of the first gate; and the detector as attributes ``detector_...``. The
    rendered image's Monte Carlo error (``S0_stderr``) comes on top of ``S0_noise_std``. Speckle
    of gates, pixels and scans is independent (the air moves by more than a wavelength from scan
    to scan; between gates that holds for lines wider than 1 / gate duration).

    scan: as rendered or read from EXR.
    seed: different ones for the scans of a pair.
    plan: where the gates lie; by default as the scan states, in single precision where it was read
        from a file.
    pulses: averaged in every beam.

    Raises InputError: the scan does not state its gates; see `detect` for the rest.
    """
    plan = plan or _plan(scan)
    scan = scan.transpose("gate", "z", "y", ...)
    s0 = scan["S0"].values
    ranges = np.broadcast_to(plan.ranges(), s0.shape)
    duration = np.broadcast_to(gate_duration(plan.gate_length()), s0.shape)
    counted = detect(s0, lidar, detector, duration, ranges, seed, _polarization(scan), pulses)
    scene = (plan, lidar.aperture_area, scan.attrs["environment_extinction"])
    # attenuated backscatter is proportional to S0, and so is its noise
    y, y_std = (attenuated_backscatter(x, *scene)[0] for x in (counted.s0, counted.s0_std))
    image, pixel = ("gate", "z", "y"), ("z", "y")
    noise = {
        "S0_noisy": (image, counted.s0, "S0 with the detector's noise", "1"),
        "S0_noise_std": (image, counted.s0_std, "standard deviation of the noise of S0_noisy", "1"),
        "Y_noisy": (pixel, y, "attenuated backscatter with the detector's noise", "m-1 sr-1"),
        "Y_noise_std": (pixel, y_std, "standard deviation of the noise of Y_noisy", "m-1 sr-1"),
    }
    fields = detector.model_dump(exclude_none=True)
    attributes = {f"detector_{name}": float(value) for name, value in fields.items()}
    attributes["detector_pulse_energy"] = lidar.pulse_energy
    if pulses > 1:
        attributes["detector_pulses"] = float(pulses)
    return scan.assign(
        {
            name: (dims, values.astype(np.float32), {"long_name": text, "units": unit})
            for name, (dims, values, text, unit) in noise.items()
        }
    ).assign_attrs(attributes)


def without_noise(scan: xr.Dataset) -> xr.Dataset:
    """A scan without the variables of `noisy_scan`."""
    noise = ("S0_noisy", "S0_noise_std", "Y_noisy", "Y_noise_std")
    signal = scan.drop_vars(noise, errors="ignore")
    signal.attrs = {
        k: value
        for k, value in scan.attrs.items()
        if not k.startswith("detector_") and k != "monte_carlo_fraction"
    }
    return signal


def noise_budget(
    scan: xr.Dataset, lidar: BackscatterLidar, detector: Detector, pulses: int = 1
) -> dict[str, float]:
    """Contributions to the noise of a scan, of all pulses: medians over all pixels and gates.

    Keys ``photons`` (at the telescope), ``signal``, ``background``, ``dark`` (photoelectrons),
    ``speckle_modes`` (not without speckle), and the relative standard deviation of S0 by cause,
    ``noise.shot``, ``.speckle``, ``.background``, ``.dark``, ``.readout``, and ``noise.all``.

    Raises InputError: the scan does not state its gates, or is dark.
    """
    plan = _plan(scan)
    scan = scan.transpose("gate", "z", "y", ...)
    s0 = scan["S0"].values.astype(float)
    if not np.nanmax(s0, initial=0) > 0:
        raise InputError("S0: 0 everywhere is not allowed; expected a scan with light in it")
    duration = gate_duration(plan.gate_length())
    signal, background, dark, modes = expected_counts(
        s0, lidar, detector, duration, plan.ranges(), _polarization(scan), pulses
    )
    terms = noise_terms(signal, background, dark, modes, detector, pulses)
    # relative noise has no value in the dark
    bright = signal > 0
    budget = {
        "photons": signal / efficiency(detector),
        "signal": signal,
        "background": background,
        "dark": dark,
    }
    if detector.speckle:
        budget["speckle_modes"] = np.asarray(modes)
    terms["all"] = noise_variance(signal, background, dark, modes, detector, pulses)
    for name, variance in terms.items():
        spread = np.sqrt(np.broadcast_to(variance, s0.shape)[bright])
        budget[f"noise.{name}"] = spread / signal[bright]
    return {name: float(np.median(value)) for name, value in budget.items()}


def expected_counts(
    s0: np.ndarray,
    lidar: BackscatterLidar,
    detector: Detector,
    duration: ArrayLike,
    distance: ArrayLike,
    polarization: ArrayLike,
    pulses: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float | np.ndarray]:
    """Mean photoelectrons of signal, background and dark current, of one shape; speckle modes.

    Parameters are those of `detect`. Between pulses the air moves by more than a wavelength, so
    that their speckle is independent.
    """
    signal = signal_photoelectrons(s0, lidar.pulse_energy, lidar.wavelength, detector)
    background = background_photoelectrons(
        detector, duration, lidar.aperture_area, lidar.fov_half, lidar.wavelength
    )
    dark = dark_counts(detector, duration)
    modes = speckle_modes(detector, lidar, duration, distance, polarization)
    shape = np.broadcast_shapes(signal.shape, background.shape, np.shape(modes))
    signal, background, dark = (
        pulses * np.broadcast_to(x, shape) for x in (signal, background, dark)
    )
    return signal, background, dark, pulses * modes


def _polarization(scan: xr.Dataset) -> np.ndarray:
    """Degree of polarisation; 1, the most speckle, where the rendering was unpolarised."""
    s0 = scan["S0"].values
    if not scan.attrs.get("polarized"):
        return np.ones_like(s0)
    polarized = np.sqrt(sum(scan[name].values.astype(float) ** 2 for name in ("S1", "S2", "S3")))
    # rounding may make it exceed 1 by a little
    return np.minimum(1, np.divide(polarized, s0, out=np.ones(s0.shape), where=s0 > 0))


def _plan(scan: xr.Dataset) -> ScanPlan:
    """The gates of a scan, from its attributes."""
    names = ("gate_start", "gate_stop", "gate_kind", "gate_count")
    for name in (*names, "environment_extinction"):
        if name not in scan.attrs:
            raise InputError(f"scan: attribute {name} is missing; expected a scan rendered here")
    gates = {name: scan.attrs[name] for name in names}
    return ScanPlan(scan["y"].values, scan["z"].values, **gates, position=0.0)


def _generator(seed: int | Sequence[int]) -> np.random.Generator:
    try:
        return np.random.default_rng(np.random.SeedSequence(seed))
    except (TypeError, ValueError):
        raise InputError(
            f"seed: {seed!r} is not allowed; expected an integer of 0 or more, or several"
        ) from None


def _check(name: str, values: np.ndarray, good: np.ndarray, allowed: str) -> None:
    good = good & np.isfinite(values)
    if not good.all():
        raise InputError(f"{name}: {values[~good].flat[0]:g} is not allowed; expected {allowed}")
