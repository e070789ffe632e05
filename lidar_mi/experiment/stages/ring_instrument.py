"""From the fringe-imaging instrument and the air to the model of the ring analysis.

The only module that imports both `lidar_mi.instrument` and `lidar_mi.retrieval` for rings.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidar_mi.atmosphere.scattering.line import Line, backscatter_line, laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.clear_air import air_of
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon, harmonics
from lidar_mi.instrument.fringe_camera import FringeCamera

if TYPE_CHECKING:
    from lidar_mi.retrieval.rings.model import PixelNoise, RingModel


# Around the expected temperature: five nodes hold harmonics of air to 1e-4 of the ring contrast.
TEMPERATURE_NODES = (0.75, 0.875, 1.0, 1.125, 1.25)


def ring_model(
    etalon: Etalon,
    camera: FringeCamera,
    line: Line | Callable[[float], Line],
    temperatures: Sequence[float] = (),
) -> "RingModel":
    """The model of a line's rings for the retrieval.

    line (Line, or function of the temperature (K) that returns one): of air at rest, or of the
        laser.
    temperatures: K, ascending; with them ``line`` is a function and the temperature a parameter of
        the fit.

    Raises InputError: a mirror that does not transmit, lines of different wavelengths.
    """
    from lidar_mi.retrieval.rings.model import RingModel

    if callable(line) != (len(temperatures) > 0):
        raise InputError("line: expected a Line, or a function of the temperature and temperatures")
    lines = [line(float(t)) for t in temperatures] if callable(line) else [line]
    wavelength = lines[0].wavelength
    if any(other.wavelength != wavelength for other in lines):
        raise InputError("line: expected one wavelength at all temperatures")
    rows = [harmonics(etalon, wavelength, one) for one in lines]
    table = np.zeros((len(rows), max(map(len, rows))), complex)
    for row, values in zip(table, rows, strict=True):
        # broader lines have fewer harmonics: the others are 0
        row[: len(values)] = values
    diagonal2 = (camera.width**2 + camera.height**2) / 4 * camera.pixel**2
    return RingModel(
        shape=(camera.height, camera.width),
        centre=camera.centre_pixel,
        pixel=camera.pixel,
        focal_length=camera.focal_length,
        wavelength=wavelength,
        order_at_centre=etalon.order_at_centre(wavelength),
        harmonics=table,
        temperatures=np.asarray(temperatures, float),
        # the exponent of the illumination at half the diagonal
        falloff=2 * diagonal2 / camera.illumination_radius**2,
        tilt=camera.tilt,
        distortion=camera.distortion,
        blur=(camera.defocus / 2 / camera.pixel) ** 2,
    )


def laser_rings(lidar: DopplerLidar, etalon: Etalon, camera: FringeCamera) -> "RingModel":
    """Rings of the laser's own light."""
    return ring_model(etalon, camera, laser_line(lidar.wavelength, lidar.laser_width))


def air_rings(
    lidar: DopplerLidar,
    etalon: Etalon,
    camera: FringeCamera,
    *,
    aerosol_std: float = 0.0,
    temperature_std: float = math.inf,
    light_degree: int = 0,
    background_degree: int = 0,
) -> "RingModel":
    """Rings of the backscatter at the lidar's altitude, for its temperature within 25 %.

    aerosol_std, temperature_std: standard deviations of what is known of the fraction of aerosol
        (0: all) and of the temperature (K), about those of the lidar's air.
    light_degree, background_degree: of the smooth variations of light and background that are
        fitted along.
    """
    pressure, temperature = air_of(lidar)
    # aerosol that is fitted has harmonics of its own: the line is that of molecules
    known = lidar.aerosol_fraction if aerosol_std == 0 else 0.0

    def line(kelvin: float) -> Line:
        return backscatter_line(
            lidar.wavelength, kelvin, pressure, lidar.laser_width, known, lidar.line_shape
        )

    model = ring_model(etalon, camera, line, [temperature * node for node in TEMPERATURE_NODES])
    priors = {}
    if math.isfinite(temperature_std):
        priors["temperature"] = (temperature, temperature_std)
    if aerosol_std > 0:
        priors["aerosol"] = (lidar.aerosol_fraction, aerosol_std)
    return replace(
        model,
        aerosol_harmonics=laser_rings(lidar, etalon, camera).harmonics[0] if aerosol_std else None,
        light_degree=light_degree,
        background_degree=background_degree,
        priors=priors,
    )


def pixel_noise(ccd: CCD, modes: float = math.inf, images: int = 1) -> "PixelNoise":
    """The CCD's noise in the sum of so many images, referred to photoelectrons.

    ``modes`` are those of the speckle in one image. Responses of the pixels that are not known
    have, like speckle, a variance that grows with the square of the signal; they are the same in
    every image.
    """
    from lidar_mi.retrieval.rings.model import PixelNoise

    spread = 1 / (images * modes) + ccd.pixel_response_rms**2
    return PixelNoise(
        math.sqrt(images) * ccd.output_noise / ccd.multiplication_gain,
        1 / spread if spread else math.inf,
        ccd.excess,
    )
