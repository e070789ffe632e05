"""The detector: from received energy to counted photoelectrons, and how uncertain they are.

Counts are the charge collected in a gate, in units of one mean photoelectron: an analogue
receiver, as the paper's light levels need (10^5 photoelectrons in 17 ns leave no single pulses to
count). Saturation, dead time, afterpulses and the steps of a digitiser are left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy import constants, special

from lidar_mi.errors import InputError
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.instrument.signal import apparent_backscatter
from lidar_mi.units import Frequency, Length, Number, SpectralRadiance, quantity


class Detector(BaseModel):
    """What lies between the telescope and the numbers; defaults: a photomultiplier by day.

    Transmission of the filter at the laser's wavelength belongs to ``optics_efficiency``.

    ``excess_noise_factor`` is <g^2> / <g>^2 of the gain g of one photoelectron: d / (d - 1) for a
    photomultiplier whose every dynode multiplies by d (1.25 for 5); k G + (1 - k)(2 - 1 / G) for an
    avalanche photodiode of gain G and ionisation ratio k (McIntyre 1966, IEEE Trans. Electron
    Devices 13, 164); 1 for a detector without gain.

    The default ``sky_radiance`` is that of a white surface of reflectance 0.5, such as a sunlit
    cloud, under an overhead sun of 1.9 W m^-2 nm^-1 (ASTM G173, 532 nm, above the atmosphere):
    0.5 x 1.9 / pi. Blue sky is several times darker.

    ``line_width`` is that of the received light: the laser's (30 GHz: a Nd:YAG laser without
    seeding; 0.44 / pulse duration: a perfect one) and, for molecules, their Doppler broadening.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    optics_efficiency: Number = Field(0.5, gt=0, le=1, description="telescope to detector")
    quantum_efficiency: Number = Field(0.4, gt=0, le=1, description="photoelectrons per photon")
    excess_noise_factor: Number = Field(1.25, ge=1, description="variance added by the gain")
    dark_rate: Frequency = Field(
        quantity("1 kHz"), ge=0, description="photoelectrons without light"
    )
    readout_noise: Number = Field(0.0, ge=0, description="rms photoelectrons a gate, at the input")
    sky_radiance: SpectralRadiance = Field(
        quantity("0.3 W/m^2/sr/nm"), ge=0, description="solar background"
    )
    filter_bandwidth: Length = Field(
        quantity("1 nm"), gt=0, description="equivalent width of the filter"
    )
    speckle: bool = Field(True, description="whether the coherence of the laser causes speckle")
    line_width: Frequency = Field(
        quantity("30 GHz"), gt=0, description="of the echo, full width half maximum"
    )
    speckle_modes: Number | None = Field(
        None, ge=1, description="number of modes; default: from line width, telescope and footprint"
    )

    @model_validator(mode="after")
    def _modes_of_speckle(self):
        if self.speckle_modes is not None and not self.speckle:
            raise ValueError(
                f"speckle_modes: {self.speckle_modes:g} is not allowed without speckle"
            )
        return self


class Detection(NamedTuple):
    """One noisy reading: ``counts`` (photoelectrons), estimated ``s0`` and its ``s0_std``."""

    counts: np.ndarray
    s0: np.ndarray
    s0_std: np.ndarray


def gate_duration(gate_length: ArrayLike) -> np.ndarray:
    """Time in which a gate is recorded, s: 2 dr / c for a gate dr (m) long."""
    return 2 * np.asarray(gate_length, float) / constants.c


def photons_per_energy(wavelength: float) -> float:
    """Photons in one joule of light, lambda / (h c), J^-1."""
    return wavelength / (constants.h * constants.c)


def signal_photoelectrons(
    s0: ArrayLike, pulse_energy: float, wavelength: float, detector: Detector
) -> np.ndarray:
    """Mean photoelectrons of an echo.

    Parameters
    ----------
    s0 : array
        Received energy over emitted pulse energy.
    pulse_energy : float
        J.
    wavelength : float
        m.
    """
    return np.asarray(s0, float) * (
        pulse_energy * photons_per_energy(wavelength) * _efficiency(detector)
    )


def background_photoelectrons(
    detector: Detector,
    duration: ArrayLike,
    aperture_area: float,
    fov_half: float,
    wavelength: float,
) -> np.ndarray:
    """Mean photoelectrons of scattered sunlight: radiance x filter x area x solid angle x time.

    Their number is Poisson distributed: sunlight through a filter has far too many modes for
    speckle (paper's telescope, 1 nm: 10^13).

    Parameters
    ----------
    duration : array
        Time in which the gate is recorded, s.
    aperture_area : float
        m^2.
    fov_half : float
        Field of view, half angle, rad.
    wavelength : float
        m.
    """
    solid_angle = 4 * np.pi * np.sin(fov_half / 2) ** 2
    power = detector.sky_radiance * detector.filter_bandwidth * aperture_area * solid_angle
    return np.asarray(duration, float) * (
        power * photons_per_energy(wavelength) * _efficiency(detector)
    )


def dark_counts(detector: Detector, duration: ArrayLike) -> np.ndarray:
    """Mean photoelectrons that come without light in ``duration`` (s)."""
    return detector.dark_rate * np.asarray(duration, float)


def footprint_radius(lidar: BackscatterLidar, distance: ArrayLike) -> np.ndarray:
    """1/e^2 radius of the beam at a distance (m), as far as the field of view holds it, m.

    A Gaussian with the variance of the truncated aperture plus the divergence. Area pi w^2 is
    (integral of I)^2 / integral of I^2; it is exact for an uncut beam and for one cut far inside
    its 1/e^2 radius, 10 % too small for a collimated one cut there (divergence hides that: the
    paper's is 2 % too small at 100 m, 0.01 % at 500 m). The field of view is a disc with a sharp
    edge: there the area is pi w^2 tanh(R^2 / w^2) for radius R, exact for a Gaussian.
    """
    distance = np.asarray(distance, float)
    squared = lidar.radius_at(distance) ** 2
    return np.sqrt(squared * np.tanh((distance * lidar.fov_half) ** 2 / squared))


def temporal_modes(line_width: float, duration: ArrayLike) -> np.ndarray:
    """Independent speckle patterns in the time a gate is recorded.

    M = [2/T int_0^T (1 - t/T) |g(t)|^2 dt]^-1 for a Gaussian line (Goodman, Statistical Optics,
    1985, section 6.1), whose coherence time int |g|^2 dt is sqrt(2 ln 2 / pi) / line_width =
    0.66 / line_width.

    Parameters
    ----------
    line_width : float
        Full width at half maximum, Hz.
    duration : array
        T, s.
    """
    x = np.asarray(duration, float) * line_width / np.sqrt(2 * np.log(2) / np.pi)
    return 1 / (special.erf(np.sqrt(np.pi) * x) / x + np.expm1(-np.pi * x**2) / (np.pi * x**2))


def spatial_modes(
    aperture_radius: float, wavelength: float, footprint: ArrayLike, distance: ArrayLike
) -> np.ndarray:
    """Speckle grains in the telescope: A Omega / lambda^2, and 1 when a grain is larger than it.

    M = [1/A^2 int int |mu(p - q)|^2 dp dq]^-1 over the aperture, where mu is the coherence that a
    Gaussian footprint of incoherent scatterers makes (van Cittert-Zernike; Goodman, Speckle
    Phenomena in Optics, 2007, section 4.7). For a circular aperture that is
    a / 2 / (1 - e^-a (I_0(a) + I_1(a))) with a = 2 (pi w R / (lambda r))^2; for large a it is the
    etendue in units of lambda^2, with A = pi R^2 and Omega = pi w^2 / r^2.

    Parameters
    ----------
    aperture_radius : float
        R, m.
    wavelength : float
        m.
    footprint : array
        1/e^2 radius w of the beam there, m.
    distance : array
        r, m.
    """
    footprint, distance = np.asarray(footprint, float), np.asarray(distance, float)
    a = 2 * (np.pi * footprint * aperture_radius / (wavelength * distance)) ** 2
    # 1 + a / 2 is the series; for small a the closed form loses digits
    small = a < 1e-6
    safe = np.where(small, 1.0, a)
    closed = safe / 2 / (1 - special.ive(0, safe) - special.ive(1, safe))
    return np.where(small, 1 + a / 2, closed)


def speckle_modes(
    detector: Detector,
    lidar: BackscatterLidar,
    duration: ArrayLike,
    distance: ArrayLike,
    polarization: ArrayLike = 1.0,
) -> float | np.ndarray:
    """Degrees of freedom M of the received light: its relative variance is 1 / M.

    Temporal times spatial modes, times 2 / (1 + P^2) for light of degree of polarisation P, as both
    polarisations are counted (Goodman, Statistical Optics, section 6.1). Light scattered several
    times comes from a wider spot, so M is a lower bound there. ``detector.speckle_modes`` replaces
    all of it; without ``detector.speckle`` M is infinite.

    Parameters
    ----------
    duration : array
        Time in which the gate is recorded, s.
    distance : array
        Range of the gate, m.
    polarization : array
        Degree of polarisation of the received light, 0 to 1.

    Raises
    ------
    InputError
        The line is narrower than a pulse of ``lidar.pulse_duration`` can have.
    """
    if not detector.speckle:
        return np.inf
    if detector.speckle_modes is not None:
        return detector.speckle_modes
    if detector.line_width * lidar.pulse_duration < 0.44 and lidar.pulse_duration > 0:
        raise InputError(
            f"detector.line_width: {detector.line_width:g} Hz is not allowed with pulses of "
            f"{lidar.pulse_duration:g} s; expected at least {0.44 / lidar.pulse_duration:g} Hz"
        )
    spatial = spatial_modes(
        lidar.aperture_radius, lidar.wavelength, footprint_radius(lidar, distance), distance
    )
    both = 2 / (1 + np.asarray(polarization, float) ** 2)
    return temporal_modes(detector.line_width, duration) * spatial * both


def noise_terms(
    signal: np.ndarray,
    background: np.ndarray,
    dark: np.ndarray,
    modes: float | np.ndarray,
    detector: Detector,
) -> dict[str, np.ndarray]:
    """Variances of the counts by cause: shot, speckle, background, dark, readout.

    Counts of partly coherent light are Poisson with a Gamma distributed mean, that is negative
    binomial: variance n + n^2 / M (Mandel 1959; Goodman, Statistical Optics, section 9.2). Gain
    noise multiplies the Poisson part by F, never the speckle's: the variance of a sum of N gains of
    mean 1 is <N> (F - 1) + var N.

    Parameters
    ----------
    signal, background, dark : array
        Mean photoelectrons.
    modes : array
        Degrees of freedom of the signal's speckle; infinite: none.
    """
    factor = detector.excess_noise_factor
    return {
        "shot": factor * signal,
        "speckle": signal**2 / modes,
        "background": factor * background,
        "dark": factor * dark,
        "readout": np.asarray(detector.readout_noise**2),
    }


def noise_variance(
    signal: np.ndarray,
    background: np.ndarray,
    dark: np.ndarray,
    modes: float | np.ndarray,
    detector: Detector,
) -> np.ndarray:
    """Variance of the counts, the sum of `noise_terms`."""
    terms = noise_terms(signal, background, dark, modes, detector)
    return np.asarray(sum(terms.values()))


def detect(
    s0: ArrayLike,
    lidar: BackscatterLidar,
    detector: Detector,
    duration: ArrayLike,
    distance: ArrayLike,
    seed: int | Sequence[int],
    polarization: ArrayLike = 1.0,
) -> Detection:
    """Read the detector once, every pixel with noise of its own.

    The signal's mean is drawn from a Gamma distribution (speckle), photoelectrons of signal,
    background and dark current together from a Poisson one, their summed gain from a Gamma one of
    mean N and variance N (F - 1), and read-out noise is Gaussian. Known means of background and
    dark counts are subtracted, so the estimate is unbiased and may be negative.

    Parameters
    ----------
    s0 : array
        Received energy over emitted pulse energy, without noise.
    duration : array
        Time in which the gate is recorded, s.
    distance : array
        Range of the gate, m.
    seed : int or sequence of int
        Images with independent noise need different ones.
    polarization : array
        Degree of polarisation of the received light, 0 to 1.

    Returns
    -------
    Detection
        All of one shape. ``s0_std`` is the exact standard deviation of ``s0`` for this mean; from
        measured counts alone, `noise_variance` of the estimated signal is its estimate.

    Raises
    ------
    InputError
        S0 negative or not finite, light beyond 10^15 photoelectrons, duration, distance,
        polarisation or seed out of range.
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
    signal, background, dark, modes = _means(s0, lidar, detector, duration, distance, polarization)
    if signal.size and (signal + background + dark).max() > 1e15:
        raise InputError(
            f"lidar.pulse_energy: {lidar.pulse_energy:g} J is not allowed; it gives up to "
            f"{(signal + background + dark).max():g} photoelectrons a gate, expected 1e15 at most"
        )
    light = random.gamma(modes, signal / modes) if detector.speckle else signal
    counts = np.asarray(random.poisson(light + background + dark), float)
    spread = detector.excess_noise_factor - 1
    if spread > 0:
        counts = random.gamma(counts / spread, spread)
    if detector.readout_noise > 0:
        counts = counts + random.normal(0, detector.readout_noise, counts.shape)
    sensitivity = signal_photoelectrons(1, lidar.pulse_energy, lidar.wavelength, detector)
    variance = noise_variance(signal, background, dark, modes, detector)
    return Detection(
        counts, (counts - background - dark) / sensitivity, np.sqrt(variance) / sensitivity
    )


def noisy_scan(
    scan: xr.Dataset, lidar: BackscatterLidar, detector: Detector, seed: int | Sequence[int]
) -> xr.Dataset:
    """A scan with the detector's noise, in addition to the noise-free image.

    Adds ``S0_noisy`` and ``S0_noise_std`` (gate, z, y), ``Y_noisy`` and ``Y_noise_std`` (z, y), the
    attenuated backscatter of the first gate; and the detector as attributes ``detector_...``. The
    rendered image's Monte Carlo error (``S0_stderr``) comes on top of ``S0_noise_std``. Speckle
    of gates, pixels and scans is independent (the air moves by more than a wavelength from scan
    to scan; between gates that holds for lines wider than 1 / gate duration).

    Parameters
    ----------
    scan : xr.Dataset
        As rendered or read from EXR.
    seed : int or sequence of int
        Different ones for the scans of a pair.

    Raises
    ------
    InputError
        The scan does not state its gates; see `detect` for the rest.
    """
    plan = _plan(scan)
    scan = scan.transpose("gate", "z", "y", ...)
    s0 = scan["S0"].values
    ranges = np.broadcast_to(plan.ranges(), s0.shape)
    duration = np.broadcast_to(gate_duration(plan.gate_length()), s0.shape)
    counted = detect(s0, lidar, detector, duration, ranges, seed, _polarization(scan))
    scene = (plan, lidar.aperture_area, scan.attrs["environment_extinction"])
    y, y_std = (apparent_backscatter(x, *scene)[0] for x in (counted.s0, counted.s0_std))
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
    return scan.assign(
        {
            name: (dims, values.astype(np.float32), {"long_name": text, "units": unit})
            for name, (dims, values, text, unit) in noise.items()
        }
    ).assign_attrs(attributes)


def noise_budget(scan: xr.Dataset, lidar: BackscatterLidar, detector: Detector) -> dict[str, float]:
    """What the noise of a scan is made of: medians over all pixels and gates.

    Keys ``photons`` (at the telescope), ``signal``, ``background``, ``dark`` (photoelectrons),
    ``speckle_modes`` (not without speckle), and the relative standard deviation of S0 by cause,
    ``noise.shot``, ``.speckle``, ``.background``, ``.dark``, ``.readout``, and ``noise.all``.

    Raises
    ------
    InputError
        The scan does not state its gates, or is dark.
    """
    plan = _plan(scan)
    scan = scan.transpose("gate", "z", "y", ...)
    s0 = scan["S0"].values.astype(float)
    if not np.nanmax(s0, initial=0) > 0:
        raise InputError("S0: 0 everywhere is not allowed; expected a scan with light in it")
    duration = gate_duration(plan.gate_length())
    signal, background, dark, modes = _means(
        s0, lidar, detector, duration, plan.ranges(), _polarization(scan)
    )
    terms = noise_terms(signal, background, dark, modes, detector)
    lit = signal > 0
    budget = {
        "photons": signal / _efficiency(detector),
        "signal": signal,
        "background": background,
        "dark": dark,
    }
    if detector.speckle:
        budget["speckle_modes"] = modes
    terms["all"] = noise_variance(signal, background, dark, modes, detector)
    for name, variance in terms.items():
        spread = np.sqrt(np.broadcast_to(variance, s0.shape)[lit])
        budget[f"noise.{name}"] = spread / signal[lit]
    return {name: float(np.median(value)) for name, value in budget.items()}


def _efficiency(detector: Detector) -> float:
    return detector.optics_efficiency * detector.quantum_efficiency


def _means(s0, lidar, detector, duration, distance, polarization):
    """Signal, background and dark photoelectrons, and modes; the first three of one shape."""
    signal = signal_photoelectrons(s0, lidar.pulse_energy, lidar.wavelength, detector)
    background = background_photoelectrons(
        detector, duration, lidar.aperture_area, lidar.fov_half, lidar.wavelength
    )
    dark = dark_counts(detector, duration)
    modes = speckle_modes(detector, lidar, duration, distance, polarization)
    shape = np.broadcast_shapes(signal.shape, background.shape, np.shape(modes))
    return *(np.broadcast_to(x, shape) for x in (signal, background, dark)), modes


def _polarization(scan: xr.Dataset) -> np.ndarray:
    """Degree of polarisation; 1, the most speckle, where the rendering was unpolarised."""
    s0 = scan["S0"].values
    if not scan.attrs.get("polarized"):
        return np.ones_like(s0)
    polarized = np.sqrt(sum(scan[name].values.astype(float) ** 2 for name in ("S1", "S2", "S3")))
    # Monte Carlo rounding may leave a little more than all of the light
    return np.minimum(1, np.divide(polarized, s0, out=np.ones(s0.shape), where=s0 > 0))


def _plan(scan: xr.Dataset) -> ScanPlan:
    """Where the gates of a scan lie, from the attributes of the scan."""
    names = ("gate_start", "gate_stop", "gate_kind", "gate_count")
    for name in (*names, "environment_extinction"):
        if name not in scan.attrs:
            raise InputError(f"scan: attribute {name} is missing; expected a scan rendered here")
    gates = {name: scan.attrs[name] for name in names}
    return ScanPlan(scan["y"].values, scan["z"].values, **gates, position=0.0)


def _generator(seed) -> np.random.Generator:
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
