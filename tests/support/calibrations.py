"""Frames of an instrument with defects on a small camera, and its nominal models.

Frames are those of `validation.fringe_reference`, harmonics the textbook's: neither from the
program.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import torch

from lidar_mi.retrieval.rings.calibration import calibrated
from lidar_mi.retrieval.rings.model import PixelNoise, RingModel
from tests.support import ring_reference as reference
from tests.support.ring_models import ring_model
from validation.fringe_reference import Defects, Instrument, air_frame, exposures, laser_frame

SMALL = Instrument().binned(4)
COARSE = {"shape": SMALL.shape, "pixel": SMALL.pixel}
NOISE = PixelNoise(5.0)
SPEED = 50.0
# all at once; the tilts are about x and y
DEFECTS = Defects(
    tilt=(math.radians(0.4), math.radians(-0.3)),
    defocus=2.0,
    distortion=2e-3,
    focal_length=1.001,
    finesse=0.95,
    warming=0.3,
)


def laser_model(**changes) -> RingModel:
    return ring_model(temperatures=(), harmonics=reference.harmonics(None), **COARSE, **changes)


def air_model(**changes) -> RingModel:
    model = ring_model(aerosol_harmonics=reference.harmonics(None), **COARSE, **changes)
    priors = {"aerosol": (0.0, 0.5), "temperature": (model.middle_temperature, 10.0)}
    return replace(model, priors=priors)


@cache
def _laser(defects, photons, instrument):
    return laser_frame(instrument, defects, photons)


def laser_frames(count, seed, defects=DEFECTS, photons=2e6, instrument=SMALL) -> torch.Tensor:
    mean = _laser(defects, photons, instrument)
    return torch.from_numpy(exposures(mean, count, seed, NOISE.read_noise).astype(np.float32))


def air_frames(count, seed, defects=DEFECTS, photons=2.4e7) -> torch.Tensor:
    mean = air_frame(SMALL, defects, SPEED, photons)
    return torch.from_numpy(exposures(mean, count, seed, NOISE.read_noise).astype(np.float32))


def truth(defects=DEFECTS) -> dict[str, float]:
    """Values of the calibration's parameters, by the names of their standard errors.

    A camera turned about y by a positive angle has its side of larger x nearer to the lens.
    """
    height, width = SMALL.shape
    return {
        "focal_length": SMALL.focal_length * defects.focal_length,
        "tilt_x": -defects.tilt[1],
        "tilt_y": defects.tilt[0],
        "distortion": defects.distortion,
        "blur": defects.defocus**2 / 4,
        "x": (width - 1) / 2,
        "y": (height - 1) / 2,
    }


def normalised_errors(found, defects=DEFECTS) -> dict[str, float]:
    """Errors of a calibration over their standard errors."""
    values = {
        "focal_length": found.focal_length,
        "tilt_x": found.tilt[0],
        "tilt_y": found.tilt[1],
        "distortion": found.distortion,
        "blur": found.blur,
        "x": found.centre[0],
        "y": found.centre[1],
    }
    unit = {"focal_length": SMALL.focal_length}
    return {
        name: (values[name] - value) / (found.std[name] * unit.get(name, 1.0))
        for name, value in truth(defects).items()
    }


def air_of(found, **changes) -> RingModel:
    """The air's model with the instrument as calibrated."""
    return calibrated(air_model(**changes), found)
