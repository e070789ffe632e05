"""Images of air that moves by given vectors, and that motion averaged over windows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch.nn.functional import grid_sample

from lidar_mi.retrieval.correlation.settings import MultipassSettings
from lidar_mi.retrieval.images.spline import Spline
from lidar_mi.retrieval.images.windows import Windows, averaged, separable

# Steps of a path, rounds of the place at mid-time.
_STEPS, _ROUNDS = 4, 3
# Standard deviation of a window over the template: of a Gaussian one, and of a square.
_GAUSSIAN, _SQUARE = MultipassSettings().sigma, 12**-0.5


class Advected(NamedTuple):
    """An image whose air has moved.

    image (shape (z, y), or (x, z, y) of a volume)
    slopes (axes, ...): of the image at the places that its air came from, per px.
    inside: where there is any air.
    """

    image: torch.Tensor
    slopes: torch.Tensor
    inside: torch.Tensor


def origin(wind: torch.Tensor) -> torch.Tensor:
    """Where the air of each pixel was one time step ago, px: paths in a steady wind (axes, ...)."""
    place = _pixels(wind.shape[1:], wind)
    for _ in range(_STEPS):
        half = place - read(wind, place) / (2 * _STEPS)
        place = place - read(wind, half) / _STEPS
    return place


def advected(spline: Spline, place: torch.Tensor) -> Advected:
    """The first image of a spline, with the air of each pixel from a place (axes, ...)."""
    at = place[:, None].to(spline.coefficients)
    image, *slopes = (part[0].to(place) for part in spline.sample(*at))
    return Advected(image, torch.stack(slopes), spline.holds(*at)[0])


def at_mid_time(flow: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Displacement (axes, ...) in dt of the air that is at each pixel at mid-time."""
    start = wind = on_pixels(flow, windows)
    if not centred:
        pixels = _pixels(windows.shape, flow)
        for _ in range(_ROUNDS):
            wind = read(start, pixels - wind / 2)
    return wind


def on_pixels(flow: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Values (n, *windows.count) of windows on pixels, by cubic splines."""
    return separable(
        flow,
        [
            _spline_weights(windows.centres(axis).to(flow), torch.arange(n).to(flow))
            for axis, n in enumerate(windows.shape)
        ],
    )


def _spline_weights(known: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Matrix (place, known) of natural cubic splines, which go on straight beyond their ends.

    A constant would bend a shear at the outermost vectors, and curves would amplify their noise.
    """
    if len(known) == 1:
        return places.new_ones(len(places), 1)
    at, x = (part.double().cpu().numpy() for part in (known, places))
    spline = CubicSpline(at, np.eye(len(at)), bc_type="natural")
    inside = x.clip(at[0], at[-1])
    weights = spline(inside) + (x - inside)[:, None] * spline(inside, 1)
    return torch.as_tensor(weights).to(known)


def of_windows(field: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Means of fields (n, ...) on pixels over Gaussians as wide as windows, about each pixel.

    Windows that are deformed (`centred`) have Gaussian weights, the others are squares.
    """
    width = windows.template * (_GAUSSIAN if centred else _SQUARE)
    everywhere = torch.ones_like(field[0], dtype=torch.bool)
    return torch.stack([averaged(part, everywhere, width) for part in field])


def places(d: torch.Tensor, windows: Windows, centred: bool) -> torch.Tensor:
    """Places of vectors at mid-time, px (axes, ...)."""
    centres = [windows.centres(axis).to(d) for axis in range(windows.dims)]
    along = torch.stack(torch.meshgrid(*centres, indexing="ij"))
    return along + (0.0 if centred else 0.5) * d.nan_to_num(0.0)


def read(field: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """A field (n, ...) on pixels at places (axes, ...) between them, linearly; outside, the rim."""
    last = [max(1, n - 1) for n in field.shape[1:]]
    across = torch.stack([2 * p / n - 1 for p, n in zip(place, last, strict=True)][::-1], -1)
    return grid_sample(field[None], across[None], "bilinear", "border", align_corners=True)[0]


def _pixels(shape: Sequence[int], like: torch.Tensor) -> torch.Tensor:
    return torch.stack(torch.meshgrid(*(torch.arange(n).to(like) for n in shape), indexing="ij"))
