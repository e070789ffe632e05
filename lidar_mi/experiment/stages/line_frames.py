"""Frames of the Doppler lidar's CCD for lines of sight, from few images without noise.

Images without noise are made at a few speeds and interpolated between them (their rings move by far
less than an order); the frames of each line are drawn by the CCD.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.scattering.line import laser_line
from lidar_mi.experiment.stages.ring_images import Rings, exposed_frames, reference_photons
from lidar_mi.experiment.stages.ring_reference import reference_frames
from lidar_mi.instrument.doppler import photons
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.schema.doppler import Doppler

if TYPE_CHECKING:
    import torch


PULSES = "sensor.pulses"
# Speeds at which images without noise are made; those between are interpolated (Chebyshev).
_NODES = 7
# First numbers of images, which select their random streams: of lines, and of the laser's frames.
_LINES, _LASER = 1 << 24, 1 << 25
# Lines of a scan at most, a million: those of other scans have other streams.
_A_SCAN = 1 << 26


@dataclass(frozen=True, eq=False)
class LineImages:
    """Images without noise, photons per pixel and pulse.

    middle, half: of the speeds that they are for, m/s.
    air (nodes, height, width): at the lidar's own range.
    laser (height, width)
    """

    middle: float
    half: float
    air: "torch.Tensor"
    laser: "torch.Tensor"

    def at(self, speed: float) -> "torch.Tensor":
        """Image of air at a speed of the range, (height, width)."""
        import torch

        place = (speed - self.middle) / self.half
        return torch.tensordot(torch.from_numpy(_lagrange(place)).to(self.air), self.air, 1)


def line_images(doppler: Doppler, rings: Rings, slowest: float, fastest: float) -> LineImages:
    """Images of air with speeds (m/s) in a range."""
    import torch

    # nodes must differ, even if all lines have one speed
    middle, half = (fastest + slowest) / 2, max((fastest - slowest) / 2, 1e-3)
    light, counted = photons(doppler.lidar), doppler.lidar.counted
    air = [
        fringe_image(doppler.camera, doppler.etalon, rings.line, speed, light, counted)
        for speed in middle + half * _nodes()
    ]
    line = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    emitted = fringe_image(
        doppler.camera, doppler.etalon, line, 0.0, reference_photons(doppler, rings)
    )
    return LineImages(middle, half, torch.stack(air), emitted)


def line_frames(
    doppler: Doppler,
    rings: Rings,
    images: LineImages,
    lines: xr.Dataset,
    numbers: Sequence[int],
    pulses: int,
    seed: int,
    scan: int = 0,
) -> "tuple[torch.Tensor, torch.Tensor, list[int]]":
    """Frames of air and of the laser for some lines of a scan, sums over their pulses.

    lines (line): all lines of the scan, with ``v_los_true`` (m/s) and ``range`` (m).
    numbers: those whose frames are made.
    pulses: of a line.
    scan: its number selects random streams.

    Returns
    -------
    air : torch.Tensor, shape (lines, height, width)
        Photoelectrons.
    laser : torch.Tensor, shape (frames, height, width)
    own : list of int
        The laser's frame of every line; lines may share one.
    """
    import torch

    summed, sharing = reference_frames(pulses, doppler.reference.every, PULSES)
    light, first = photons(doppler.lidar), scan * _A_SCAN
    air = []
    speeds, ranges = (lines[name].values for name in ("v_los_true", "range"))
    for number in numbers:
        lidar = doppler.lidar.model_copy(update={"range": float(ranges[number])})
        # the range changes the light, not the rings
        mean = images.at(speeds[number]) * (photons(lidar) / light)
        # random streams different from those of the images of the Doppler lidar's chapter
        streams = [first + _LINES + number]
        air.append(exposed_frames(doppler, rings, mean, pulses, seed, streams))
    groups = sorted({number // sharing for number in numbers})
    streams = [first + _LASER + _LINES + group for group in groups]
    laser = exposed_frames(doppler, rings, images.laser, summed, seed, streams)
    return torch.cat(air), laser, [groups.index(number // sharing) for number in numbers]


def _nodes() -> np.ndarray:
    return np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)


def _lagrange(place: float) -> np.ndarray:
    """Weights (nodes,) of values at the nodes in the polynomial through them, at a place."""
    nodes = _nodes()
    others = ~np.eye(len(nodes), dtype=bool)
    return np.array(
        [
            ((place - nodes[o]) / (node - nodes[o])).prod()
            for node, o in zip(nodes, others, strict=True)
        ]
    )
