"""Receivers for the same light: from a lidar and its receiver to the model of the signals.

All receivers get the same photons (`lidar_mi.instrument.doppler.photons`, counted in front of
them), line, sunlight and detector; each has the losses of its own optics. The rings of an etalon
are annuli of equal steps of the order, so that aerosol is a parameter of them, too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
import torch

from lidar_mi.atmosphere.scattering.line import Line, backscatter_line, laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.ring_instrument import TEMPERATURE_NODES, pixel_noise
from lidar_mi.experiment.truth.clear_air import air_of
from lidar_mi.instrument import double_edge, michelson
from lidar_mi.instrument import etalon as fabry_perot
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import (
    DopplerLidar,
    channel_modes,
    photons,
    solar_background,
    speckle_modes,
)
from lidar_mi.instrument.double_edge import DoubleEdge
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.michelson import Michelson
from lidar_mi.retrieval.channels.bound import cramer_rao
from lidar_mi.retrieval.channels.model import ChannelModel, mean_and_jacobian, parameter_vector
from lidar_mi.retrieval.rings.model import PixelNoise

# Annuli of a ring image, for each order: the tenth harmonic loses 1 % of its contrast.
_ANNULI_PER_ORDER = 128
# Speeds at which the response of two filters is examined.
_SPEEDS = 4001
# Range of a required pulse energy, relative to the lidar's.
_ENERGIES = (1e-6, 1e6)


class Receiver(NamedTuple):
    """A receiver behind a lidar.

    Attributes
    ----------
    channels : ChannelModel
        Its signals.
    noise : PixelNoise
        Of the pixels of its channels.
    level : float
        Photoelectrons of a pulse, were all photons in front of the receiver detected.
    aerosol : float
        Fraction of them that aerosol scatters.
    """

    channels: ChannelModel
    noise: PixelNoise
    level: float
    aerosol: float


def ideal_error(lidar: DopplerLidar) -> float:
    """Standard error of v_LOS from one pulse by an ideal spectral analyser, m/s.

    It detects every photon with its frequency: (lambda / 2) / (N information)^(1/2), which is
    (lambda / 2) sigma / N^(1/2) for a Gaussian line.
    """
    return lidar.wavelength / 2 / math.sqrt(photons(lidar) * _line(lidar).information)


def michelson_receiver(
    lidar: DopplerLidar, interferometer: Michelson, detector: CCD | None = None
) -> Receiver:
    """Fringes of a Michelson interferometer on line detectors.

    Parameters
    ----------
    detector : CCD
        Its pixels are the elements; the default one if not given.
    """
    harmonics = michelson.harmonics(interferometer)
    # at the crest of a fringe, where light has the fewest modes
    bright = interferometer.model_copy(update={"order_fraction": 0.0})
    return _receiver(
        lidar,
        detector or CCD(),
        harmonics,
        interferometer.delay,
        modes=channel_modes(
            lidar, _line(lidar), lambda nu: michelson.transmission(bright, nu)[0], len(harmonics)
        ),
    )


def double_edge_receiver(
    lidar: DopplerLidar, filters: DoubleEdge, detector: CCD | None = None
) -> Receiver:
    """Two filters, for speeds about 0 between which the ratio of their signals is monotone.

    Parameters
    ----------
    detector : CCD
        A pixel for each filter; the default one if not given.

    Raises
    ------
    InputError
        Filters whose ratio does not depend on the speed.
    """
    return _receiver(
        lidar,
        detector or CCD(),
        double_edge.harmonics(filters, lidar.wavelength),
        filters.delay(lidar.wavelength),
        modes=channel_modes(
            lidar,
            _line(lidar),
            lambda nu: double_edge.transmission(filters, lidar.wavelength, nu)[0],
            2,
        ),
        ratio=True,
    )


def ring_receiver(
    lidar: DopplerLidar, etalon: Etalon, camera: FringeCamera, detector: CCD | None = None
) -> Receiver:
    """Rings of an etalon on a camera, as annuli about their known centre.

    Parameters
    ----------
    detector : CCD
        Of the camera's pixels; the default one if not given.
    """
    r2 = camera.radius_squared().ravel()
    light = camera.illumination(r2)
    cosine = fabry_perot.cosine_inside(etalon, camera.cosine(r2))
    order = fabry_perot.fractional_order(etalon, lidar.wavelength, cosine)
    # by the order, not the radius, as all rings have the same width in it
    annulus = np.floor(order * _ANNULI_PER_ORDER).astype(int)
    # orders fall towards the rim, and bincount takes no negative numbers
    annulus -= annulus.min()
    pixels = np.bincount(annulus)
    used = pixels > 0
    annulus_light = np.bincount(annulus, light)[used]
    middle = np.bincount(annulus, light * order)[used] / annulus_light
    # variance of the order over a pixel: r^2 varies by r^2 pixel^2 / 3
    slope = etalon.order_at_centre(lidar.wavelength) / 2 / (etalon.index * camera.focal_length) ** 2
    spread = slope**2 * camera.pixel**2 / 3 * np.bincount(annulus, light * r2)[used] / annulus_light
    amplitudes = fabry_perot.harmonics(etalon, lidar.wavelength)
    n = np.arange(len(amplitudes))
    # harmonics averaged over a pixel: by a Gaussian of the same variance of the order
    turns = np.exp(2j * math.pi * n * middle[:, None] - 2 * (math.pi * n) ** 2 * spread[:, None])
    return _receiver(
        lidar,
        detector or CCD(),
        (annulus_light / annulus_light.sum())[:, None] * amplitudes * turns,
        1 / etalon.free_spectral_range(lidar.wavelength),
        modes=speckle_modes(lidar, camera, etalon, _line(lidar)),
        pixels=pixels[used].astype(float),
    )


def standard_error(
    receiver: Receiver,
    v_los: float = 0.0,
    free: Sequence[str] = ("v_los", "level"),
    prior: Mapping[str, float] | None = None,
    energy: float = 1.0,
) -> float:
    """Cramer-Rao bound of v_LOS from one pulse of ``energy`` times the lidar's, m/s.

    ``free`` and ``prior`` as in `lidar_mi.retrieval.channels.bound.cramer_rao`.
    """
    channels, noise, level, aerosol = receiver
    bound = cramer_rao(
        channels, energy * level, noise, v_los=v_los, aerosol=aerosol, free=free, prior=prior
    )
    return bound["v_los"]


def required_energy(receiver: Receiver, error: float, v_los: float = 0.0) -> float:
    """Energy of a pulse with this standard error of v_LOS (m/s), relative to the lidar's.

    Raises
    ------
    InputError
        An error that a million times more or less energy does not have.
    """

    # in logarithms the error falls almost linearly: as E^(-1/2) by shot noise
    def excess(log_energy: float) -> float:
        return math.log(standard_error(receiver, v_los, energy=math.exp(log_energy)) / error)

    low, high = map(math.log, _ENERGIES)
    if not (error > 0 and excess(low) > 0 > excess(high)):
        raise InputError(
            f"error: {error!r} m/s is not allowed; expected one of {_ENERGIES[0]:g} to "
            f"{_ENERGIES[1]:g} times the energy"
        )
    return math.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-6))


def detected_fraction(receiver: Receiver) -> float:
    """Fraction of the light in front of the receiver that its channels detect, at v_LOS = 0."""
    channels, _, _, aerosol = receiver
    mean = mean_and_jacobian(channels, parameter_vector(channels, aerosol=aerosol))[0]
    return float((mean - channels.background).sum())


def _line(
    lidar: DopplerLidar, temperature: float | None = None, aerosol: float | None = None
) -> Line:
    """The line at the lidar's altitude, or at another temperature, with another aerosol."""
    pressure, usual = air_of(lidar)
    return backscatter_line(
        lidar.wavelength,
        usual if temperature is None else temperature,
        pressure,
        lidar.laser_width,
        lidar.aerosol_fraction if aerosol is None else aerosol,
        lidar.line_shape,
    )


def _receiver(
    lidar: DopplerLidar,
    detector: CCD,
    harmonics: np.ndarray,
    delay: float,
    modes: float,
    pixels: float | np.ndarray = 1.0,
    ratio: bool = False,
) -> Receiver:
    """A receiver from complex harmonics (channels, harmonics) of the transmission of its channels.

    Their period is 1 / ``delay`` (s); a channel has so many ``modes`` of speckle and ``pixels``;
    with ``ratio``, speeds are read from the ratio of two signals.
    """
    times = np.arange(harmonics.shape[1]) * delay
    _, usual = air_of(lidar)
    temperatures = [usual * node for node in TEMPERATURE_NODES]
    # of molecules alone: aerosol is a separate signal
    lines = [_line(lidar, kelvin, 0.0).characteristic(times) for kelvin in temperatures]
    laser = laser_line(lidar.wavelength, lidar.laser_width).characteristic(times)
    # in front of the receiver, so without an etalon
    sun = solar_background(lidar.model_copy(update={"counted": "detected"}), Etalon())
    # the spectrum of sunlight is flat: the mean transmission, harmonic 0, passes
    electrons = sun * detector.quantum_efficiency * harmonics[:, 0].real
    dark = detector.dark_current * detector.integration_time * detector.binning**2
    channels = ChannelModel(
        molecules=torch.from_numpy(harmonics * np.array(lines)[:, None]),
        aerosol=torch.from_numpy(harmonics * laser),
        # in speed, whose shift of the frequency is 2 v / wavelength
        period=lidar.wavelength / (2 * delay),
        temperatures=np.array(temperatures),
        background=torch.from_numpy(electrons + pixels * dark),
        pixels=torch.as_tensor(pixels),
    )
    if ratio:
        channels = replace(channels, limits=_monotone(channels, lidar.aerosol_fraction))
    level = photons(lidar) * detector.quantum_efficiency
    return Receiver(channels, pixel_noise(detector, modes), level, lidar.aerosol_fraction)


def _monotone(channels: ChannelModel, aerosol: float) -> tuple[float, float]:
    """Speeds about 0 between which the ratio of two signals is that of one speed, m/s."""
    speeds = np.linspace(-channels.period / 2, channels.period / 2, _SPEEDS)
    parameters = parameter_vector(channels, aerosol=aerosol).repeat(_SPEEDS, 1)
    parameters[:, 0] = torch.from_numpy(speeds)
    background = torch.as_tensor(channels.background)
    signal = mean_and_jacobian(channels, parameters)[0] - background
    # the light's intensity cancels in the ratio
    steps = torch.diff(torch.log(signal[:, 1] / signal[:, 0])).numpy()
    middle = _SPEEDS // 2
    if not steps[middle - 1] * steps[middle] > 0:
        raise InputError("double edge: the ratio of its signals does not depend on the speed at 0")
    falling = np.flatnonzero(steps * steps[middle] <= 0)
    first = falling[falling < middle].max(initial=-1) + 1
    last = falling[falling > middle].min(initial=_SPEEDS - 1)
    return float(speeds[first]), float(speeds[last])
