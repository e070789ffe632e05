"""Where the vectors of a volume lie, weighted sums about them, and what becomes of outliers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.velocimetry.quality import Flag

AXES = ("x", "z", "y")


@dataclass(frozen=True)
class VolumeWindows:
    """Cubic windows in a volume, stepped by `stride` voxels; they lie wholly inside.

    Attributes
    ----------
    shape : (int, int, int)
        Voxels of the volume, (x, z, y).
    template, search, stride : int
        In voxels; template >= 4, search >= template + 2, stride >= 1. Displacements up to
        (search - template) / 2 in each direction are looked for.

    Raises
    ------
    InputError
        A size out of its range, or a volume smaller than a template.
    """

    shape: tuple[int, int, int]
    template: int = 8
    search: int = 16
    stride: int = 4

    def __post_init__(self) -> None:
        lowest = {"template": 4, "search": self.template + 2, "stride": 1}
        for name, low in lowest.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                allowed = "template + 2" if name == "search" else low
                raise InputError(f"{name}: {value!r} voxels is not an integer >= {allowed}")
        if min(self.shape) < self.template:
            sizes = " x ".join(map(str, self.shape))
            raise InputError(
                f"template: {self.template} voxels do not fit into the volume of {sizes} (x, z, y); "
                "expected at least as many voxels (gates along x) in every direction"
            )

    @property
    def reach(self) -> float:
        """Largest displacement looked for, voxels."""
        return (self.search - self.template) / 2

    @property
    def count(self) -> tuple[int, int, int]:
        """Number of windows, (x, z, y)."""
        return tuple((n - self.template) // self.stride + 1 for n in self.shape)

    def centres(self, axis: int) -> torch.Tensor:
        """Places of the windows' centres along an axis, voxels from the first."""
        n = self.count[axis]
        # what the stride leaves over is shared between both faces
        spare = self.shape[axis] - self.template - (n - 1) * self.stride
        start = spare // 2 + (self.template - 1) / 2
        return start + self.stride * torch.arange(n, dtype=torch.float64)


class VolumeDisplacement(NamedTuple):
    """Displacements of all windows from volume 1 to volume 2.

    Attributes
    ----------
    d, variance : torch.Tensor, shape (3, *windows.count)
        Voxels and voxels^2, along x, z, y; NaN where no displacement was found.
    score : torch.Tensor
        Correlation of the volumes carried to mid-time.
    flag : torch.Tensor of uint8
        `quality.Flag` bits.
    """

    d: torch.Tensor
    variance: torch.Tensor
    score: torch.Tensor
    flag: torch.Tensor


def separable(values: torch.Tensor, matrices: Sequence[torch.Tensor]) -> torch.Tensor:
    """A matrix (new, old) along each of the last three axes."""
    return along_x(matrices[1] @ (values @ matrices[2].T), matrices[0])


def along_x(values: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """A matrix (new, old) along the third axis from the end."""
    return (matrix @ values.flatten(-2)).unflatten(-1, values.shape[-2:])


def bells(windows: VolumeWindows, sigma: float, like: torch.Tensor) -> list[torch.Tensor]:
    """Gaussian weights (window, voxel) along each axis, cut at 3 sigma."""
    matrices = []
    for axis, n in enumerate(windows.shape):
        place = torch.arange(n, dtype=torch.float64)
        offset = (place - windows.centres(axis)[:, None]) / sigma
        bell = torch.exp(-offset.square() / 2) * (offset.abs() <= 3)
        matrices.append(bell.to(like))
    return matrices


def hats(known: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Matrix (place, known) of linear interpolation; the outermost value holds outside."""
    if len(known) == 1:
        return places.new_ones(len(places), 1)
    at = ((places - known[0]) / (known[1] - known[0])).clamp(0, len(known) - 1)
    number = torch.arange(len(known), dtype=places.dtype, device=places.device)
    return (1 - (at[:, None] - number).abs()).clamp(min=0)


def correlation(carried: torch.Tensor, seen: torch.Tensor, weights: Sequence[torch.Tensor]):
    """Smallest weighted correlation of a volume with the mean of the others, window by window.

    Parameters
    ----------
    carried : torch.Tensor, shape (volumes, x, z, y)
        At mid-time.
    seen : torch.Tensor, shape (x, z, y)
    weights : three tensors (window, voxel)

    Returns
    -------
    score, share : torch.Tensor, shape windows.count
        NaN without contrast; the share of the weight that was seen.
    """
    scores = []
    number = len(carried)
    for volume in carried:
        others = (carried.sum(0) - volume) / (number - 1)
        fields = torch.stack(
            [torch.ones_like(volume), volume, others, volume**2, others**2, volume * others]
        )
        sums = separable(fields * seen, weights).double()
        first, second, square1, square2, cross = sums[1:] / sums[0].clamp(min=1e-12)
        contrast = (square1 - first**2).clamp(min=0) * (square2 - second**2).clamp(min=0)
        scores.append(
            torch.where(contrast > 1e-10, (cross - first * second) / contrast.sqrt(), torch.nan)
        )
    whole = separable(torch.ones_like(seen, dtype=carried.dtype), weights)
    return torch.stack(scores).amin(0), (sums[0] / whole).to(carried)


def median_outliers(d: torch.Tensor, threshold: float = 2.0, epsilon: float = 0.1) -> torch.Tensor:
    """Normalised median test (Westerweel & Scarano 2005) among the 26 neighbours of every vector.

    `d` (3, ...) in voxels, NaN where there is none; False where a vector has fewer than three
    neighbours.
    """
    around = _neighbours(d)
    middle = _median(around)
    spread = _median((around - middle).abs()) + epsilon
    enough = (~around.isnan()).all(1).sum(0) > 2
    return enough & (((d - middle) / spread).norm(dim=0) > threshold)


def validated(d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacements with outliers and gaps filled by their neighbours' medians, and which were.

    Gaps are filled from the rim inwards; without any vector the displacement is zero.
    """
    wrong = d.isnan().any(0) | median_outliers(d)
    d = torch.where(wrong, torch.nan, d)
    while bool((gap := d[0].isnan()).any()) and not bool(gap.all()):
        d = torch.where(gap, _median(_neighbours(d)), d)
    return d.nan_to_num(0.0), wrong


def _neighbours(d: torch.Tensor) -> torch.Tensor:
    """(26, 3, ...); beyond the faces the field goes on as it changes there."""
    padded = d
    for axis in (1, 2, 3):
        first, last = padded.narrow(axis, 0, 1), padded.narrow(axis, -1, 1)
        inner = [torch.full_like(first, torch.nan)] * 2
        if d.shape[axis] > 1:
            inner = [padded.narrow(axis, 1, 1), padded.narrow(axis, -2, 1)]
        padded = torch.cat([2 * first - inner[0], padded, 2 * last - inner[1]], axis)
    x, z, y = d.shape[1:]
    return torch.stack(
        [
            padded[:, i : i + x, j : j + z, k : k + y]
            for i in range(3)
            for j in range(3)
            for k in range(3)
            if (i, j, k) != (1, 1, 1)
        ]
    )


def _median(values: torch.Tensor) -> torch.Tensor:
    """Over the first axis, without NaN; the mean of the middle two of an even number."""
    ranked = values.sort(dim=0).values
    number = (~values.isnan()).sum(0, keepdim=True)
    middle = torch.cat([(number - 1).clamp(min=0) // 2, number // 2])
    return ranked.gather(0, middle.clamp(max=len(values) - 1)).mean(0)


def flags(
    d: torch.Tensor,
    variance: torch.Tensor,
    score: torch.Tensor,
    share: torch.Tensor,
    finite: torch.Tensor,
    min_correlation: float,
) -> torch.Tensor:
    """`quality.Flag` bits of what both methods judge alike.

    No match where there is no contrast or less than half of the window was seen; low texture where
    a component's standard error is beyond half a voxel.
    """
    matched = score.isfinite() & (share > 0.5) & d.isfinite().all(0)
    uncertain = (variance.nan_to_num(torch.inf) > 0.25).any(0)
    flag = (
        Flag.NO_MATCH * ~matched
        + Flag.LOW_TEXTURE * uncertain
        + Flag.LOW_CORRELATION * (matched & (score < min_correlation))
    ).to(torch.uint8)
    flag[~finite] |= Flag.NON_FINITE_INPUT.value
    return flag
