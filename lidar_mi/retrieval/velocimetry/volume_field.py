"""Volumes as smooth functions of place: levelled, band-limited, read anywhere with their slopes."""

from collections.abc import Sequence
from typing import NamedTuple

import scipy.fft
import torch
from torch.nn.functional import max_pool3d

from lidar_mi.errors import InputError
from lidar_mi.retrieval.velocimetry.warping import extended, spline_weights

# Voxels of mirrored volume around each volume: the spline's answer to a face falls by 0.27 a voxel.
_MARGIN = 12
# Points read at once: their intermediate results stay near the cache.
_TILE = 1 << 16


class Volumes(NamedTuple):
    """Cubic B-splines through volumes of one texture, whose mean is 0 and whose rms is 1.

    Attributes
    ----------
    coefficients : torch.Tensor, shape (volumes, x + 2 margin, z + 2 margin, y + 2 margin)
    usable : torch.Tensor of bool, shape (volumes, x, z, y)
        Away from non-finite voxels.
    shape : (int, int, int)
        Of the volumes, (x, z, y).
    noise : float
        Standard deviation of the white noise before the filter; the texture's rms is 1.
    passed : float
        Share of the variance of white noise that the filter let pass.
    excess : float
        Variance of a displacement over what the slopes would allow, were they free of noise.
    """

    coefficients: torch.Tensor
    usable: torch.Tensor
    shape: tuple[int, int, int]
    noise: float
    passed: float
    excess: float

    @property
    def variance(self) -> float:
        """Of a displacement times the sum of squared slopes: of the noise in both volumes."""
        return 2 * self.noise**2 * self.excess

    def sample(
        self, place: Sequence[torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Value and slopes of every volume at its own places.

        Parameters
        ----------
        place : three tensors of shape (volumes, ...)
            x, z and y in voxels from the first; beyond the volume they take the face's value.

        Returns
        -------
        value : torch.Tensor, shape (volumes, ...)
        slope : torch.Tensor, shape (3, volumes, ...)
            Along x, z, y.
        seen : torch.Tensor of bool, shape (volumes, ...)
            Places inside the volume and near no non-finite voxel.
        """
        shape = place[0].shape
        value = torch.empty(shape, dtype=self.coefficients.dtype, device=place[0].device)
        slope = value.new_empty(3, *shape)
        seen = torch.empty(shape, dtype=torch.bool, device=value.device)
        for number in range(shape[0]):
            flat = [axis[number].reshape(-1) for axis in place]
            results = value[number].view(-1), slope[:, number].view(3, -1), seen[number].view(-1)
            for start in range(0, len(flat[0]), _TILE):
                here = slice(start, start + _TILE)
                points = [axis[here] for axis in flat]
                results[0][here], results[1][:, here] = self._read(number, points)
                results[2][here] = self._sees(number, points)
        return value, slope, seen

    def _read(self, number: int, place: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        sizes = self.coefficients.shape[1:]
        at = [p.clamp(0, n - 1) + _MARGIN - 1 for p, n in zip(place, self.shape)]
        low = [p.floor() for p in at]
        x, z, y = (spline_weights(p - below) for p, below in zip(at, low))
        corner = (low[0].long() * sizes[1] + low[1].long()) * sizes[2] + low[2].long()
        flat = self.coefficients[number].reshape(-1)
        total = torch.zeros_like(at[0]).repeat(4, 1)
        for i in range(4):
            plane = torch.zeros_like(total[:3])
            for j in range(4):
                line = torch.zeros_like(total[:2])
                for k in range(4):
                    knot = flat[corner + ((i * sizes[1] + j) * sizes[2] + k)]
                    line[0].addcmul_(knot, y[0][k])
                    line[1].addcmul_(knot, y[1][k])
                plane[0].addcmul_(line[0], z[0][j])
                plane[1].addcmul_(line[0], z[1][j])
                plane[2].addcmul_(line[1], z[0][j])
            total[0].addcmul_(plane[0], x[0][i])
            total[1].addcmul_(plane[0], x[1][i])
            total[2].addcmul_(plane[1], x[0][i])
            total[3].addcmul_(plane[2], x[0][i])
        return total[0], total[1:]

    def _sees(self, number: int, place: list[torch.Tensor]) -> torch.Tensor:
        inside = torch.ones_like(place[0], dtype=torch.bool)
        for p, n in zip(place, self.shape):
            inside &= (p >= 0) & (p <= n - 1)
        nearest = [p.round().long().clamp(0, n - 1) for p, n in zip(place, self.shape)]
        return inside & self.usable[number][tuple(nearest)]


def prepared(volumes: Sequence[torch.Tensor], noise: float | torch.Tensor | None = None) -> Volumes:
    """Volumes of one texture, levelled in brightness, band-limited, as splines.

    Each volume is divided by its own brightness, c exp(a x), fitted to the mean of its gates: so
    attenuation on the way through the volume, and volumes of unlike brightness, are no motion.
    The filter passes sqrt(S / (S + N / 2)) of a wave, S the texture's spectral density and N the
    noise's, both by shells of wavenumber (see `warping.band_limited`). Displacements come out too
    small: by 0.01 to 0.025 voxel in the mean of a volume of 16 x 24 x 28 voxels with noise of a
    tenth of the texture, by 0.035 along x in a rotation. Near a face the filter mixes in the volume's
    mirror image, which does not move; that may be why, but leaving out the two outermost voxels
    does not end it.

    Parameters
    ----------
    volumes : sequence of torch.Tensor, shape (x, z, y)
        Positive in the mean. Non-finite voxels are left out.
    noise : float or torch.Tensor, optional
        Standard deviation of the white noise of a voxel, in the volumes' unit; of a volume of them
        the rms counts. Left out: from the shells of lowest density.

    Raises
    ------
    InputError
        Noise below 0; a volume that is not bright anywhere.
    """
    usable = torch.stack([torch.isfinite(volume) for volume in volumes])
    levelled, brightness = zip(*(_levelled(volume, n) for n, volume in enumerate(volumes, 1)))
    relative = torch.stack(levelled)
    contrast = relative.square().mean((1, 2, 3), keepdim=True).sqrt()
    contrast = torch.where(contrast > 1e-6, contrast, 1.0)  # nothing but rounding
    values = relative / contrast
    level = None
    if noise is not None:
        level = torch.as_tensor(noise, dtype=values.dtype, device=values.device)
        if not bool((level[level.isfinite()] >= 0).all()):
            raise InputError("noise: below 0 is not allowed; expected standard deviations >= 0")
        scaled = (level / brightness[0] / contrast[0]).square()
        level = float(scaled[scaled.isfinite()].mean().sqrt())
    spline, level, passed, excess = _band_limited(values, level)
    bad = (~usable).to(values)[:, None]
    near = max_pool3d(bad, 7, stride=1, padding=3)[:, 0] > 0 if bool(bad.any()) else ~usable
    return Volumes(spline, ~near, tuple(values.shape[1:]), level, passed, excess)


def _levelled(volume: torch.Tensor, number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The volume over its brightness less 1 (0 where it is not finite), and the brightness by gate."""
    dtype = torch.float32 if volume.device.type == "mps" else torch.float64
    volume = volume.to(dtype)
    known = torch.isfinite(volume)
    values = torch.where(known, volume, 0.0)
    count = known.sum((1, 2))
    gates = values.sum((1, 2)) / count.clamp(min=1)
    if not bool((gates[count > 0] > 0).all()) or not bool(count.any()):
        raise InputError(
            f"volume{number}: gates that are 0, negative or not finite on the whole are not "
            "allowed; expected a brightness above 0 in every gate"
        )
    x = torch.arange(len(gates), dtype=dtype, device=volume.device)
    x = x - (x * count).sum() / count.sum()
    logarithm = torch.where(count > 0, gates.clamp(min=1e-300).log(), 0.0)
    decay = (count * x * logarithm).sum() / (count * x * x).sum().clamp(min=1e-30)
    brightness = (decay * x).exp()[:, None, None]
    brightness = brightness * (values / brightness).sum() / count.sum()
    level = torch.where(known, values / brightness - 1, 0.0)
    return level.float(), brightness.float()


def _band_limited(values: torch.Tensor, noise: float | None):
    """Spline coefficients of the filtered volumes, noise level, `passed` and `excess`."""
    shape = values.shape[1:]
    sizes = [scipy.fft.next_fast_len(n + 2 * _MARGIN, real=True) for n in shape]
    like = {"dtype": values.dtype, "device": values.device}
    frequency = [
        torch.fft.fftfreq(sizes[0], **like)[:, None, None],
        torch.fft.fftfreq(sizes[1], **like)[:, None],
        torch.fft.rfftfreq(sizes[2], **like),
    ]
    radius = sum(axis.square() for axis in frequency).sqrt()
    # no finer than the thinnest side tells, no coarser than the texture's fall
    shell = (radius * min(max(min(shape), 16), 64)).long()
    density, uncertainty = _shell_means(values, shell, sizes)
    if noise is None:
        floor = (density * (1 + 2 * uncertainty)).min()
        weight = uncertainty**-2 * (density <= floor * (1 + 2 * uncertainty))
        floor = (weight * density).sum() / weight.sum()
    else:
        floor = torch.as_tensor(noise**2, **like)
    texture = torch.where(density > floor * (1 + 2 * uncertainty), density - floor, 0.0)
    gain = (texture / (texture + floor / 2 + torch.finfo(values.dtype).tiny)).sqrt()[shell]
    twice = torch.full((sizes[2] // 2 + 1,), 2.0, **like)
    twice[0] = 1.0
    passed = float((gain.square() * twice).sum()) / (sizes[0] * sizes[1] * sizes[2])
    steep = radius.square() * gain.square() * twice
    told = float((steep * texture[shell]).sum())
    excess = float((steep * (texture + floor / 2)[shell]).sum()) / told if told > 0 else 1.0

    spectrum = torch.fft.rfftn(extended(values, sizes, _MARGIN), dim=(1, 2, 3)) * gain
    for axis in frequency:
        spectrum = spectrum / ((2 + torch.cos(2 * torch.pi * axis)) / 3)
    smooth = torch.fft.irfftn(spectrum, s=sizes, dim=(1, 2, 3))
    kept = smooth[:, : shape[0] + 2 * _MARGIN, : shape[1] + 2 * _MARGIN, : shape[2] + 2 * _MARGIN]
    return kept.contiguous(), float(floor.sqrt()), max(passed, 1e-6), excess


def _shell_means(
    values: torch.Tensor, shell: torch.Tensor, sizes: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Power spectrum by shells, mean over the volumes (white noise gives its variance).

    With relative standard errors. Shells that the corners of the spectrum cut stand for themselves.
    """
    window = torch.ones((), dtype=values.dtype, device=values.device)
    for axis, n in enumerate(values.shape[1:]):
        hann = torch.hann_window(n + 2, periodic=False, dtype=values.dtype, device=values.device)
        window = window * hann[1:-1].reshape(-1, *[1] * (2 - axis))
    mean = (values * window).sum((1, 2, 3), keepdim=True) / window.sum()
    power = torch.fft.rfftn((values - mean) * window, s=list(sizes), dim=(1, 2, 3))
    power = power.abs().square().mean(0) / window.square().sum()
    number = torch.bincount(shell.flatten())
    total = torch.bincount(shell.flatten(), weights=power.flatten().double())
    density = (total / number.clamp(min=1)).to(values)
    # independent waves: as many as voxels, of which tapering leaves a quarter
    share = 0.25 * len(values) * values[0].numel() / (sizes[0] * sizes[1] * sizes[2])
    return density, (share * number.clamp(min=1)).rsqrt().to(values).clamp(max=1.0)
