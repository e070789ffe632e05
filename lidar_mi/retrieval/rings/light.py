"""Illumination of sectors: one profile common to all, with a height and a background of each.

The cells of a sector s are

    value = b_s + h_s p(r^2),

with a smooth background b_s of its own (1, r and r^2), a height h_s + k_s r^2, and the profile p
of the rings, which is common to all. A background that slopes, vignetting, or a part of the image
that something hides then do not enter the profile: the mean over circles would take them for rings
where sectors leave the image one after the other. b, h and p are fitted alternately (alternating
least squares: Young 1941, Psychometrika 6, 49). Cells far from it, as of hot pixels and of the edge
of what hides a sector, do not count; nor do sectors without rings.
"""

import math
import warnings
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import inverse_of

OUTLIER = 6.0  # standard deviations of a cell
ITERATIONS = 12
VISIBLE = 0.15  # of the usual height, the least of a sector that shows rings
SIGNIFICANT = 4.0  # standard errors, likewise
LEAST = 3  # sectors that an annulus must have
SMOOTH = 25  # annuli over which the scatter is averaged


@dataclass(frozen=True, eq=False)
class Light:
    """The profile common to all sectors.

    profile (annuli,): in units of the usual sector's light; interpolated where no sector determines
        it.
    weight (annuli,): effective number of pixels, those of the usual sector counting 1.
    noise (annuli,): variance of a pixel, from the scatter among sectors.
    used (array (sectors, annuli) of bool): cells that show rings, and are no outliers.
    """

    profile: np.ndarray
    weight: np.ndarray
    noise: np.ndarray
    used: np.ndarray


def common_light(r2: np.ndarray, value: np.ndarray, count: np.ndarray) -> Light:
    """Profile and cells of sectors (sectors, annuli): mean and number of pixels of each cell."""
    q = r2 / r2[-1]
    filled = count > 0
    smooth = np.broadcast_to(np.column_stack([np.ones_like(q), np.sqrt(q), q]), (*value.shape, 3))
    # a start: each sector less its own background, without what stands out of an annulus
    residual = np.where(filled, value - _fitted(value, smooth, count)[0], np.nan)
    middle = _median(residual)
    # 1.4826 times the median deviation is the standard deviation of normal errors
    reach = 3 * 1.4826 * np.nanmedian(np.abs(residual - middle))
    clipped = np.nan_to_num(np.clip(residual, middle - reach, middle + reach))
    profile = (clipped * count).sum(0) / np.maximum(count.sum(0), 1)
    used, fraction = filled, count / np.maximum(count.sum(0), 1)
    visible = np.ones(len(value), bool)
    for iteration in range(ITERATIONS):
        # a height that changes with r only once there is a profile to compare with
        parts = [profile, q * profile] if iteration > ITERATIONS // 3 else [profile]
        columns = np.concatenate(
            [smooth, np.broadcast_to(np.column_stack(parts), (*value.shape, len(parts)))], -1
        )
        model, linear, std = _fitted(value, columns, count * used)
        residual = np.where(filled, value - model, 0.0) * np.sqrt(count)
        # the profile follows a sector that is alone in an annulus
        remaining = 1 - fraction
        noise = _noise(residual / np.sqrt(np.maximum(remaining, 0.5)), used & (remaining >= 0.5))
        # on a crest there is more, as of photons
        typical = _median(np.where(filled & visible[:, None], np.abs(residual), np.nan))
        scale = np.maximum(noise, (1.4826 * typical) ** 2)
        used = filled & (np.abs(residual) <= OUTLIER * np.sqrt(scale) + 1e-12)
        height = linear[:, 3:] @ np.stack([np.ones_like(q), q])[: len(parts)]
        mean = (height * count * used).sum(1) / np.maximum((count * used).sum(1), 1)
        # a sector of a few cells fits any profile, and its height is as large as its error
        visible = mean > SIGNIFICANT * std[:, 3] * np.sqrt(noise.mean())
        usual = float(np.median(mean[visible])) if visible.any() else math.inf
        visible &= mean > VISIBLE * usual
        # the usual sector has height 1: profile and heights are determined but for a factor
        height = np.where(visible[:, None], height / usual, 0.0).clip(0)
        weight = (used * count * height**2).sum(0)
        # of fewer sectors none can be identified as an outlier
        weight[(used & visible[:, None]).sum(0) < LEAST] = 0
        known = weight > 0
        if not known.any():
            raise InputError("rings: none detected in three sectors; expected at least 2")
        # near 1 the profile is that sector's alone, which then has no residual of its own
        fraction = np.where(known, used * count * height**2, 0) / np.where(known, weight, 1)
        rings = value - np.einsum("sqk,sk->sq", smooth, linear[:, :3])
        total = (used * count * height * rings).sum(0)
        profile = np.interp(r2, r2[known], total[known] / weight[known])
    return Light(profile, weight, noise, used & visible[:, None])


def _fitted(
    value: np.ndarray, columns: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares sector by sector: model, parameters, their errors for variance 1."""
    weighted = columns * weight[..., None]
    matrix = np.einsum("sqk,sql->skl", weighted, columns)
    inverse = inverse_of(torch.from_numpy(matrix), 1e-8).numpy()
    linear = np.einsum("skl,sql,sq->sk", inverse, weighted, value, optimize=True)
    std = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2), 0.0))
    return np.einsum("sqk,sk->sq", columns, linear), linear, std


def _noise(residual: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Variance of a pixel at every annulus, from deviations of its and its neighbours' sectors."""
    size = residual.shape[1]
    edges = np.linspace(0, size, max(size // SMOOTH, 1) + 1).round().astype(int)
    variances = []
    for first, last in pairwise(edges):
        cells = np.abs(residual[:, first:last][used[:, first:last]])
        variances.append((1.4826 * np.median(cells)) ** 2 if len(cells) else np.nan)
    variance = np.array(variances)
    known = variance > 0
    if not known.any():
        return np.full(size, np.finfo(float).tiny)
    middle = (edges[:-1] + edges[1:]) / 2
    return np.interp(np.arange(size), middle[known], variance[known])


def _median(value: np.ndarray) -> np.ndarray:
    """Median over sectors; 0 where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an annulus without cells
        return np.nan_to_num(np.nanmedian(value, 0))
