"""An instrument calibrated from frames of a known line: stored in a file, used by the ring fit."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.model import INSTRUMENT, RingModel
from lidar_mi.tables import Table, Tabular, with_error

_ARRAYS = {
    "systematic": (("systematic", "systematic_2"), "1", "covariance of the instrument"),
    "frame_speed": (("frame",), "m s-1", "drift of the frame, as a speed"),
    "frame_speed_std": (("frame",), "m s-1", "standard error of frame_speed"),
    "response": (("row", "column"), "1", "response to light, 0 for masked pixels"),
    "misfit": (("block_row", "block_column"), "1", "mean misfit over its standard deviation"),
}
"""Dimensions, units and names of the arrays in a file."""


_LISTED = 6


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Tabular):
    """An instrument as calibrated from frames of a narrow line.

    Attributes
    ----------
    shape : (int, int)
        Height and width of the camera, pixels.
    pixel, wavelength, focal_length : float
        m. The focal length is that for the nominal gap.
    order_at_centre : float
        Order of the line at the centre; its fraction is the mean over the frames.
    finesse : float
        Free spectral range over the full width at half maximum of the line's rings.
    centre : (float, float)
        (x, y) of the rings, pixels.
    tilt, distortion, blur, damping, roughness
        As in `lidar_mi.retrieval.rings.model`.
    falloff : float
        Fall-off q of the illumination, exp(-q r^2 / R^2) with R half of the image's diagonal.
    light : mapping
        Uneven illumination, terms of `LIGHT`.
    std : mapping
        Standard errors by name, of `INSTRUMENT` (focal_length relative), x, y and falloff.
    systematic : array (8, 8)
        Covariance common to all later speeds, see `RingModel.systematic`.
    frame_speed, frame_speed_std : array (frames,)
        Fractional order of every frame as a speed about their mean, m/s: the drift.
    drift : float
        Standard deviation of `frame_speed` in excess of its noise, m/s.
    chi_square : float
        Squared misfit over its expectation.
    response : array (height, width)
        Relative sensitivity of each pixel; 0 for masked pixels.
    misfit : array (height, width)
        Mean of the frames less the model, in standard deviations, in blocks of ``block`` pixels.
    block : int
    undetermined : tuple of str
        Parameters of `INSTRUMENT` that the frames determine no better than the tolerances.
    lines : tuple of float
        Wavelengths of two or more lines, where their frames gave the gap, m.
    gaps : tuple of (float, float)
        Gaps, times the refractive index, that agree with the fractional orders of the lines, and
        their standard errors, m. The order is determined if there is only one.
    whole_orders : tuple of int
        Whole numbers of the order at the centre that agree with one gap. If there are several, they
        are neighbours, and the standard error of the gap includes them. Empty: the nominal one.
    """

    shape: tuple[int, int]
    pixel: float
    wavelength: float
    focal_length: float
    order_at_centre: float
    finesse: float
    centre: tuple[float, float]
    tilt: tuple[float, float]
    distortion: float
    blur: float
    damping: float
    roughness: float
    falloff: float
    light: Mapping[str, float]
    std: Mapping[str, float]
    systematic: np.ndarray
    frame_speed: np.ndarray
    frame_speed_std: np.ndarray
    drift: float
    chi_square: float
    response: np.ndarray
    misfit: np.ndarray
    block: int
    undetermined: tuple[str, ...]
    lines: tuple[float, ...] = ()
    gaps: tuple[tuple[float, float], ...] = ()
    whole_orders: tuple[int, ...] = ()

    def tables(self) -> list[Table]:
        """The instrument, with standard errors, and how well the frames fit."""
        std, bad = self.std, int((self.response == 0).sum())
        x, y = self.centre
        tilt_x, tilt_y = (math.degrees(t) for t in self.tilt)
        which = "this" if self.whole_orders else "the nominal"
        focal = with_error(self.focal_length * 1e3, std["focal_length"] * self.focal_length * 1e3)
        rows = [
            ("frames", str(len(self.frame_speed))),
            (f"focal length, for {which} gap", f"{focal} mm"),
            ("fractional order at the centre", f"{self.order_at_centre % 1:.5f}"),
            *self._gap_rows(),
            ("finesse of the line's rings", f"{self.finesse:.3g}"),
            ("centre x, y", f"{with_error(x, std['x'])}, {with_error(y, std['y'])} px"),
            (
                "camera tilt along x, y",
                f"{with_error(tilt_x, math.degrees(std['tilt_x']))}, "
                f"{with_error(tilt_y, math.degrees(std['tilt_y']))} deg",
            ),
            (
                "distortion at the corner",
                with_error(100 * self.distortion, 100 * std["distortion"], "%"),
            ),
            ("squared radius of the blur", with_error(self.blur, std["blur"], "px^2")),
            ("change of -ln R of the mirrors", with_error(self.damping, std["damping"])),
            ("change of the roughness term", with_error(self.roughness, std["roughness"])),
            ("fall-off of the light to the corner", with_error(self.falloff, std["falloff"])),
            ("pixels masked", str(bad)),
            ("drift between frames", f"{self.drift:.3g} m/s"),
            ("chi-square", f"{self.chi_square:.4f}"),
        ]
        note = ""
        if self.undetermined:
            note = f"Not determined by the frames: {', '.join(self.undetermined)}."
        return [Table("calibration", rows, note=note)]

    def _gap_rows(self) -> list[tuple[str, str]]:
        """The gap of several lines; that it is ambiguous where it is."""
        count = len(self.gaps)
        rows = [
            (
                "gap" if count == 1 else f"gap, {k} of {count} that agree",
                with_error(1e3 * gap, 1e3 * std, "mm"),
            )
            for k, (gap, std) in enumerate(self.gaps[:_LISTED], 1)
        ]
        if count > 1:
            more = f"ambiguous, {count} gaps agree: the nominal one is kept"
            rows.append(("whole order at the centre", more))
        elif self.whole_orders:
            first, last = self.whole_orders[0], self.whole_orders[-1]
            text = str(first) if first == last else f"{first} to {last}, ambiguous"
            rows.append(("whole order at the centre", text))
        return rows

    def to_dataset(self) -> xr.Dataset:
        """All of it, for a NetCDF file; numbers that are no arrays as JSON in ``calibration``."""
        single = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        arrays = {
            name: (dims, getattr(self, name), {"units": units, "long_name": text})
            for name, (dims, units, text) in _ARRAYS.items()
        }
        attributes = {"title": "Calibration of a fringe-imaging lidar", "Conventions": "CF-1.11"}
        return xr.Dataset(arrays, attrs={**attributes, "calibration": json.dumps(single)})


def calibration_of(data: xr.Dataset) -> Calibration:
    """The calibration in a data set of `Calibration.to_dataset`.

    Raises InputError: a data set that is none, or not whole.
    """
    try:
        single: dict[str, Any] = json.loads(data.attrs["calibration"])
        arrays = {name: data[name].transpose(*dims).values for name, (dims, *_) in _ARRAYS.items()}
        for name in ("shape", "centre", "tilt", "undetermined"):
            single[name] = tuple(single[name])
        for name in ("lines", "whole_orders"):
            single[name] = tuple(single.get(name, ()))
        single["gaps"] = tuple((float(gap), float(std)) for gap, std in single.get("gaps", ()))
        single.update(arrays)
        result = Calibration(**single)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"calibration: {error} is missing or wrong; expected the file of a calibration"
        ) from None
    numbers = (result.pixel, result.wavelength, result.focal_length, result.order_at_centre)
    size = (1 + len(INSTRUMENT),) * 2
    whole = result.response.shape == result.shape and result.systematic.shape == size
    finite = all(np.isfinite(getattr(result, name)).all() for name in _ARRAYS)
    if not (whole and finite and all(isinstance(v, float) and v > 0 for v in numbers)):
        raise InputError(
            "calibration: sizes or numbers that cannot be; expected the file of a calibration"
        )
    return result


def calibrated(model: RingModel, calibration: Calibration) -> RingModel:
    """The model of another line with the instrument as calibrated.

    Raises InputError: a calibration of another camera or wavelength.
    """
    if tuple(model.shape) != tuple(calibration.shape):
        sizes = " and ".join(f"{h} x {w}" for h, w in (calibration.shape, model.shape))
        raise InputError(f"calibration: sizes {sizes} px (height x width) of cameras differ")
    for name in ("pixel", "wavelength"):
        expected, given = getattr(calibration, name), getattr(model, name)
        if not math.isclose(expected, given, rel_tol=1e-3):
            raise InputError(
                f"calibration: {name} {expected:g} m is not that of the model, {given:g} m"
            )
    order = calibration.order_at_centre
    # the nominal gap may be given to another fraction of an order; one by two lines is absolute,
    # and line widths in orders change in proportion
    allowed = 0.01 * order if calibration.whole_orders else 2
    if abs(order - model.order_at_centre) > allowed:
        raise InputError(
            f"calibration: order {order:.1f} at the centre is not that of the model, "
            f"{model.order_at_centre:.1f}: another gap"
        )

    def changed(harmonics: np.ndarray) -> np.ndarray:
        n = np.arange(np.shape(harmonics)[-1])
        factor = np.exp(-calibration.damping * n - calibration.roughness * n**2)
        return np.asarray(harmonics) * factor

    aerosol = model.aerosol_harmonics
    return replace(
        model,
        centre=calibration.centre,
        focal_length=calibration.focal_length,
        order_at_centre=order,
        harmonics=changed(model.harmonics),
        aerosol_harmonics=None if aerosol is None else changed(aerosol),
        tilt=calibration.tilt,
        distortion=calibration.distortion,
        blur=calibration.blur,
        falloff=calibration.falloff,
        light=calibration.light,
        systematic=calibration.systematic,
    )
