"""Frames of a real instrument: calibration of the etalon, and speeds along the line of sight.

The nominal instrument, its air and its camera are those of an experiment's section ``doppler``.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from lidar_mi import __version__
from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.ring_images import ring_models
from lidar_mi.experiment.stages.ring_instrument import laser_rings, pixel_noise
from lidar_mi.experiment.truth.clear_air import in_air_of_its_site
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.etalon import mirrors
from lidar_mi.io.images import read_frames, stated_units
from lidar_mi.retrieval.rings.calibration import Calibration, calibrated
from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings
from lidar_mi.retrieval.rings.calibration_lines import combined
from lidar_mi.retrieval.rings.likelihood_fit import RingFit, difference, fit_rings
from lidar_mi.retrieval.rings.model import PixelNoise, RingModel
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import load_experiment
from lidar_mi.variables import variable


def doppler_of(instrument: str | Path | Experiment, name: str = "instrument") -> Doppler:
    """The Doppler lidar of an experiment, which messages call ``name``.

    Raises InputError: an experiment without one.
    """
    experiment = instrument if isinstance(instrument, Experiment) else load_experiment(instrument)
    if experiment.fringes is None:
        raise InputError(
            f"{name}: experiment {experiment.name!r} has no section doppler; expected one"
        )
    placed = in_air_of_its_site(experiment, experiment.folder).fringes
    assert placed is not None
    return placed


def electrons(counts: np.ndarray, ccd: CCD) -> np.ndarray:
    """Photoelectrons from counts: less the bias, times the gains of digitiser and CCD."""
    return (np.asarray(counts, float) - ccd.bias) * ccd.gain / ccd.multiplication_gain


def read_electrons(
    paths: Sequence[str | Path], ccd: CCD, *, counts: bool, layer: str | None = None
) -> np.ndarray:
    """All frames of some files as photoelectrons, (frames, height, width).

    counts: whether the files hold a digitiser's counts; electrons otherwise.

    Raises InputError: a file that is no image, frames of different sizes, a rendered image: its
    values are relative energies, from which neither a pulse nor its noise follows.
    """
    frames: list[np.ndarray] = []
    for path in paths:
        if units := stated_units(path):
            raise InputError(
                f"{path}: a rendered image ({units.partition(';')[0]}) is not allowed; expected "
                "counts or photoelectrons of a camera; `lidar-mi rings` measures its rings"
            )
        for frame in read_frames(path, layer):
            if frames and frame.shape != frames[0].shape:
                raise InputError(
                    f"{path}: {frame.shape[1]} x {frame.shape[0]} px are not allowed; expected "
                    f"{frames[0].shape[1]} x {frames[0].shape[0]} px as in {paths[0]}"
                )
            frames.append(electrons(frame, ccd) if counts else np.asarray(frame, float))
    return np.stack(frames)


@checked_arguments
def calibrate_etalon(
    frames: Any,
    instrument: str | Path | Experiment = "fringes_paper",
    *,
    flat: Any = None,
    lines: Mapping[float, Any] | None = None,
    gap_tolerance: float = 1e-5,
    wavelength_accuracy: float = 1e-8,
    achromatic: bool = True,
    light_degree: int = 2,
    background_degree: int = 4,
    max_chi_square: float = 2.0,
) -> Calibration:
    """Calibrate a fringe-imaging etalon from frames of its laser, and of lamps.

    Parameters
    ----------
    frames : array, shape (frames, height, width)
        Photoelectrons, two frames or more.
    instrument : path, str or Experiment
        The nominal instrument: an experiment with a section ``doppler``, its file or the name of a
        shipped one. Laser, etalon, camera and CCD are taken from it.
    flat : array, shape (height, width), optional
        Mean of frames of even white light, any scale; pixels of 0 are masked.
    lines : mapping of float to array, optional
        Frames of further narrow lines by their wavelengths (m; in vacuum, or in the gap's gas times
        ``doppler.etalon.index``, as the laser's): they give the gap. All that does not depend on
        the wavelength is shared.
    gap_tolerance : float
        What the nominal gap, times its index, may differ by, m.
    wavelength_accuracy : float
        Relative standard error of each of the wavelengths, the laser's included.
    achromatic : bool
        Whether all lines have one focal length and blur.
    light_degree, background_degree : int
        Of the polynomials of the illumination and of each frame's background, 0 to 8.
    max_chi_square : float
        Frames that fit worse are refused.

    Returns
    -------
    Calibration
        To be given to `retrieve_v_los`.

    Raises
    ------
    InputError
        Frames that do not belong to the nominal instrument: another size, no rings, a bad fit.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> lm.calibrate_etalon(np.ones((1, 780, 960)))
    Traceback (most recent call last):
        ...
    lidar_mi.errors.InputError: frames: 1 is not allowed; expected 2 or more, from which the drift \
is determined
    """
    doppler = doppler_of(instrument)
    _, laser = ring_models(doppler)
    response = None if flat is None else _response(flat, doppler)

    def fitted(name: str, images: Any, model: RingModel) -> Calibration:
        return calibrate_rings(
            _batch(name, images, doppler),
            model,
            pixel_noise(doppler.ccd),
            response=response,
            light_degree=light_degree,
            background_degree=background_degree,
            max_chi_square=max_chi_square,
        )

    first = fitted("frames", frames, laser)
    if not lines:
        return first
    etalon = doppler.assumed.of(doppler.etalon)
    wavelength = doppler.lidar.wavelength
    gap = etalon.tuned_gap(wavelength)
    # the gap that gives the laser's order_fraction is the same for all lines
    fixed = etalon.model_copy(update={"gap": gap, "order_fraction": None})
    calibrations = [first]
    for lamp_wavelength, images in lines.items():
        name = f"line of {1e9 * lamp_wavelength:.7g} nm"
        _check_line(lamp_wavelength, wavelength, name)
        lamp = doppler.lidar.model_copy(update={"wavelength": lamp_wavelength})
        try:
            model = laser_rings(lamp, fixed, doppler.assumed.of(doppler.camera))
            calibrations.append(fitted("frames", images, model))
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    return combined(
        calibrations,
        etalon.index * gap,
        gap_tolerance,
        # the phase of reflection depends on the wavelength, unlike a gap
        mirror_orders=[
            mirrors(fixed, lamp_wavelength).order_shift for lamp_wavelength in (wavelength, *lines)
        ],
        wavelength_accuracy=wavelength_accuracy,
        achromatic=achromatic,
    )


def _check_line(wavelength: float, laser: float, name: str) -> None:
    if not 0.5 * laser < wavelength < 2 * laser:
        raise InputError(
            f"{name}: not allowed; expected {5e8 * laser:.4g} to {2e9 * laser:.4g} nm, half to "
            "twice the laser's"
        )
    if math.isclose(wavelength, laser, rel_tol=1e-9):
        raise InputError(f"{name}: the laser's own; expected another line")


@checked_arguments
def retrieve_v_los(
    frames: Any,
    reference: Any = None,
    instrument: str | Path | Experiment = "fringes_paper",
    *,
    calibration: Calibration | None = None,
    max_chi_square: float | None = None,
) -> xr.Dataset:
    """Speeds along the line of sight from frames of the echo of air.

    Parameters
    ----------
    frames : array, shape (frames, height, width)
        Photoelectrons.
    reference : array, shape (n, height, width), optional
        Frames of the laser itself: one for each frame, one for all, or one for each of equal
        numbers of frames in turn. Without them speeds are from the calibration's order.
    instrument : path, str or Experiment
        As of `calibrate_etalon`.
    calibration : Calibration, optional
        The nominal instrument is taken as true without one.
    max_chi_square : float, optional
        Default: that of the experiment's ``doppler.retrieval``.

    Returns
    -------
    xr.Dataset, dim frame
        ``v_los`` (m s-1, positive toward the instrument), ``v_los_std`` its random standard error,
        ``v_los_systematic`` that of the calibration, common to all frames, ``chi_square``,
        ``rings``, and ``status``: empty, or why a frame has no speed (NaN).

    Raises
    ------
    InputError
        Frames of another size than the instrument's, a number of references that does not fit.

    Examples
    --------
    A frame without rings has no speed, and says why:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> speeds = lm.retrieve_v_los(np.full((1, 780, 960), 30.0))
    >>> float(speeds.v_los[0]), str(speeds.status[0].values)
    (nan, 'image: its gradients have no common centre; expected rings')
    """
    doppler = doppler_of(instrument)
    air, laser = ring_models(doppler)
    response = None
    if calibration is not None:
        air, laser = calibrated(air, calibration), calibrated(laser, calibration)
        response = torch.from_numpy(np.asarray(calibration.response, float))
    limit = doppler.retrieval.max_chi_square if max_chi_square is None else max_chi_square
    noise = pixel_noise(doppler.ccd)

    def fitted(name: str, images: torch.Tensor, model: RingModel) -> _Fits:
        return _fit_each(images, name, model, noise, response, limit, calibration is not None)

    batch = _batch("frames", frames, doppler)
    received, status = fitted("frames", batch, air)
    # v_LOS, its random and its systematic standard error
    parts: list[tuple[torch.Tensor, ...] | None] = []
    if reference is None:
        parts = [
            None if fit is None else (fit.v_los, fit.v_los_std, fit.v_los_systematic)
            for fit in received
        ]
    else:
        shots = _batch("reference", reference, doppler)
        if len(batch) % len(shots):
            raise InputError(
                f"reference: {len(shots)} frames are not allowed; expected as many as frames, "
                f"{len(batch)}, or a divisor of that"
            )
        emitted, faults = fitted("reference", shots, laser)
        # a frame of the laser is the zero of the frames that follow it
        frames_per_shot = len(batch) // len(shots)
        for k, fit in enumerate(received):
            zero = emitted[k // frames_per_shot]
            status[k] = status[k] or faults[k // frames_per_shot]
            parts.append(None if fit is None or zero is None else difference(fit, zero))
    columns = np.full((5, len(batch)), np.nan)
    for k, (part, fit) in enumerate(zip(parts, received, strict=True)):
        if part is not None:
            columns[:3, k] = [float(value) for value in part]
        if fit is not None:
            columns[3:, k] = float(fit.chi_square), float(fit.rings)
    return xr.Dataset(
        {
            name: variable("frame", values, *about)
            for (name, *about), values in zip(_VARIABLES, columns, strict=True)
        }
        | {"status": ("frame", status, {"long_name": "why a frame has no speed"})},
        attrs={
            "Conventions": "CF-1.11",
            "title": "Line-of-sight speeds from ring images",
            "software": f"lidar-mi {__version__}",
        },
    )


_VARIABLES = (
    ("v_los", "m s-1", "speed toward the instrument along the line of sight"),
    ("v_los_std", "m s-1", "random standard error of v_los"),
    ("v_los_systematic", "m s-1", "standard error of v_los by the calibration, common to frames"),
    ("chi_square", "1", "squared misfit over its expectation"),
    ("rings", "1", "rings detected"),
)


_Fits = tuple[list[RingFit | None], list[str]]


def _fit_each(
    images: torch.Tensor,
    name: str,
    model: RingModel,
    noise: PixelNoise,
    response: torch.Tensor | None,
    limit: float,
    centre_fixed: bool,
) -> _Fits:
    """The fit of every image, or None and why not."""
    fits: list[RingFit | None] = []
    status = []
    # one by one: a frame that cannot be fitted must not stop the others
    for k, image in enumerate(images):
        try:
            fit = fit_rings(
                image[None],
                model,
                noise,
                response=response,
                centre=model.centre if centre_fixed else None,
                max_chi_square=limit,
            )
        except InputError as error:
            fits.append(None)
            # the fit sees one image, the user has a batch
            status.append(str(error).replace("images[0]", f"{name}[{k}]"))
        else:
            fits.append(fit)
            status.append("")
    return fits, status


def _batch(name: str, frames: Any, doppler: Doppler) -> torch.Tensor:
    """Frames (n, height, width) of the camera's size."""
    values = np.asarray(frames)
    if values.dtype.kind not in "fiub" or values.ndim not in (2, 3):
        raise InputError(
            f"{name}: {values.dtype} of shape {values.shape} is not allowed; expected numbers "
            "(frames, height, width)"
        )
    camera = doppler.camera
    if values.shape[-2:] != (camera.height, camera.width):
        raise InputError(
            f"{name}: {values.shape[-1]} x {values.shape[-2]} px are not allowed; expected "
            f"{camera.width} x {camera.height} px, doppler.camera's width and height"
        )
    # writable, and in the byte order of the machine
    return torch.from_numpy(np.array(values, np.float32).reshape(-1, *values.shape[-2:]))


def _response(flat: Any, doppler: Doppler) -> torch.Tensor:
    """Responses of the pixels, 1 on average."""
    values = _batch("flat", flat, doppler).double().mean(0)
    # masked pixels, of 0, must not lower the mean of the others
    mean = float(values[values > 0].mean()) if (values > 0).any() else math.nan
    if not (torch.isfinite(values).all() and math.isfinite(mean)):
        raise InputError("flat: expected finite values, some of them above 0")
    return values.clamp(min=0) / mean
