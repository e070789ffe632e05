"""The instrument that the retrieval of a run assumes: as on paper, or calibrated."""

from pathlib import Path
from typing import TYPE_CHECKING

from lidar_mi.atmosphere.scattering.line import laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.ring_images import (
    Rings,
    exposed_frames,
    reference_photons,
    ring_models,
)
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.experiment.stages.ring_reference import calibration_drift
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.io.netcdf import read_netcdf
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.input_files import find_file

if TYPE_CHECKING:
    from lidar_mi.retrieval.rings.calibration import Calibration


# First number of the frames of the calibration, which selects their random streams.
_STREAMS = 3 << 25


def calibration_file(doppler: Doppler, rings: Rings, search_path: Path) -> "Calibration | None":
    """The calibration that an experiment names, or none.

    Raises InputError: a file that is missing, no calibration, or one of another camera, wavelength
    or gap.
    """
    from lidar_mi.retrieval.rings.calibration import calibrated, calibration_of

    asked = doppler.calibration
    if asked is None or asked.file is None:
        return None
    try:
        calibration = calibration_of(read_netcdf(find_file(asked.file, search_path, "file")))
        calibrated(rings.model, calibration)
    except InputError as error:
        raise InputError(f"doppler.calibration.file: {error}") from None
    return calibration


def assumed_rings(
    doppler: Doppler, seed: int, rings: Rings, calibration_file: "Calibration | None", log: Log
) -> Rings:
    """What the retrieval assumes of the instrument, calibrated where the experiment says so.

    Simulated frames are of the true instrument, each with the noise of its camera; the calibration
    starts from the assumed one.

    Raises InputError: frames that do not fit the assumed instrument.
    """
    import torch

    from lidar_mi.retrieval.rings.calibration import calibrated
    from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings

    air, laser = ring_models(doppler)
    asked, calibration = doppler.calibration, calibration_file
    if asked is not None and calibration is None:
        log(f"calibrating the instrument from {asked.frames} frames of the laser")
        line = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
        light = reference_photons(doppler, rings)
        mean = fringe_image(doppler.camera, doppler.etalon, line, 0.0, light)
        numbers = range(_STREAMS, _STREAMS + asked.frames)
        walk = calibration_drift(doppler, asked.frames, seed)
        if walk.any():
            mean = torch.stack(
                [fringe_image(doppler.camera, doppler.etalon, line, v, light) for v in walk]
            )
        frames = exposed_frames(doppler, rings, mean, 1, seed, numbers)
        try:
            calibration = calibrate_rings(
                frames,
                laser,
                pixel_noise(doppler.ccd, rings.modes),
                light_degree=asked.light_degree,
                background_degree=doppler.retrieval.background_degree,
            )
        except InputError as error:
            raise InputError(f"doppler.calibration: {error}") from None
        log(_summary(calibration))
    if calibration is None:
        return rings._replace(model=air, laser=laser)
    response = torch.from_numpy(calibration.response.astype(float))
    return rings._replace(
        model=calibrated(air, calibration),
        laser=calibrated(laser, calibration),
        # pixels of one response need no cells of their own
        response=None if bool((response == 1).all()) else response,
    )


def _summary(calibration: "Calibration") -> str:
    text = (
        f"calibration: focal length {calibration.focal_length * 1e3:.4f} mm, finesse "
        f"{calibration.finesse:.3g}, chi-square {calibration.chi_square:.3f}"
    )
    missing = ", ".join(calibration.undetermined)
    return f"{text}; not determined: {missing}" if missing else text
