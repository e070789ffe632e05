"""The rings' centre: from gradients, by circular averaging, by midpoint lines.

Coordinates are pixels, x to the right and y down, from the top left pixel's centre.
"""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, median_filter

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.peak_fit import peak

COARSE = 12  # of an image's side, the scale beyond which structure is no ring's
ROWS = 64  # of an image at once: what they need stays in the cache


def gradient_centre(
    image: np.ndarray | torch.Tensor, response: torch.Tensor | None = None
) -> tuple[float, float]:
    """Point that the lines along all gradients pass closest by, to about a pixel.

    The gradient of rings points to or from their centre at every pixel, so that no ring needs to be
    detected or complete: least squares of the distances between the point and the lines, weighted
    by the squared gradient (Parthasarathy 2012, Nature Methods 9, 724), here of the smoothed
    image. White noise biases the point toward the image's middle by its fraction of the squared
    gradient: below 0.1 % for the paper's 1.3e7 photons. Pixels of no ``response`` are masked. The
    point (x, y) may lie outside.

    Raises InputError: an image without gradients, or with all of them along one direction.
    """
    image = torch.as_tensor(image)
    block = max(1, min(image.shape) // 192)
    rows, columns = (size // block for size in image.shape)

    def coarse(part: torch.Tensor) -> np.ndarray:
        blocks = part[: rows * block, : columns * block].reshape(rows, block, columns, block)
        return gaussian_filter(blocks.mean((1, 3)).cpu().numpy().astype(float), 2.0)

    known: np.ndarray | float = 1.0
    if response is None:
        smooth = coarse(image)
    else:
        weight = coarse(response.to(image))
        known = weight > 0.5 * weight.max()
        smooth = coarse(torch.where(response > 0, image, 0)) / np.maximum(weight, 1e-3)
    # the filter extrapolates beyond the edge
    rim = 5
    slope_y, slope_x = ((known * part)[rim:-rim, rim:-rim] for part in np.gradient(smooth))
    y, x = np.mgrid[rim : rows - rim, rim : columns - rim].astype(float)
    # n = (-slope_y, slope_x) is across the gradient: n . (p - c) = 0 on each line
    normal = np.stack([-slope_y.ravel(), slope_x.ravel()])
    across = (normal * np.stack([x.ravel(), y.ravel()])).sum(0)
    matrix = normal @ normal.T
    size = np.linalg.eigvalsh(matrix)
    if not size[0] > 1e-3 * size[1]:
        raise InputError("image: its gradients have no common centre; expected rings")
    centre = np.linalg.solve(matrix, normal @ across)
    x, y = centre * block + (block - 1) / 2
    return float(x), float(y)


def ring_centre(image: np.ndarray) -> tuple[float, float]:
    """Centre of rings on any background, partly hidden or not, to a few pixels.

    As `gradient_centre`, but robust: the lines along gradients count by how close to the centre
    they pass (Geman and McClure 1985, Proc. Stat. Comp. Sect. ASA, 12), from several starts and
    distances that become smaller. Those of a sloping background, of edges and of hot pixels miss
    it. Candidates are from the image and from the image without its coarse structure; the one about
    which averages over circles have the largest contrast is the centre.

    Raises InputError: an image without gradients, or with all of them along one direction.
    """
    image = np.asarray(image, float)
    block = max(1, min(image.shape) // 192)
    rows, columns = (size // block for size in image.shape)
    coarse = image[: rows * block, : columns * block].reshape(rows, block, columns, block)
    coarse = median_filter(coarse.mean((1, 3)), 3, mode="nearest")
    fine = coarse - gaussian_filter(coarse, min(coarse.shape) / COARSE, mode="nearest")
    low, high = np.quantile(fine, (0.01, 0.99))
    fine = fine.clip(low, high)
    x, y = ((value - (block - 1) / 2) / block for value in gradient_centre(image))
    starts = [(x, y)]
    starts += [(columns * a, rows * b) for a in (0.25, 0.5, 0.75) for b in (0.25, 0.5, 0.75)]
    candidates = [
        _robust_centre(gaussian_filter(part, 2.0), start)
        for part in (coarse, fine)
        for start in starts
    ]

    def contrast(place: tuple[float, float]) -> float:
        _, mean, weight = circular_average(fine, place)
        return float(weight @ (mean - (weight @ mean) / weight.sum()) ** 2)

    x, y = (v * block + (block - 1) / 2 for v in max(candidates, key=contrast))
    return x, y


def _robust_centre(smooth: np.ndarray, start: tuple[float, float]) -> tuple[float, float]:
    rim = 5
    slope_y, slope_x = (part[rim:-rim, rim:-rim] for part in np.gradient(smooth))
    y, x = np.mgrid[rim : smooth.shape[0] - rim, rim : smooth.shape[1] - rim]
    size = np.hypot(slope_x, slope_y)
    steep = size > np.quantile(size, 0.7)
    size = size[steep]
    normal = np.stack([-slope_y[steep], slope_x[steep]]) / size
    across = normal[0] * x[steep] + normal[1] * y[steep]
    strength = np.minimum(size, np.quantile(size, 0.9)) ** 2
    centre = np.array(start)
    for reach in np.geomspace(0.3, 0.02, 12) * min(smooth.shape):
        for _ in range(2):
            off = across - normal.T @ centre
            weight = strength / (1 + (off / reach) ** 2) ** 2
            matrix = (normal * weight) @ normal.T
            matrix[np.diag_indices(2)] += 1e-6 * np.trace(matrix)
            centre = np.linalg.solve(matrix, (normal * weight) @ across)
    return float(centre[0]), float(centre[1])


def circular_average(
    image: np.ndarray, centre: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over circles about ``centre``, 1 px apart: the paper's circular averaging (CA).

    Every pixel counts at the two radii next to its own, in proportion.

    Returns
    -------
    radius, mean, weight : arrays
        px; the value's unit; sum of the pixels' weights. Radii of weight 0 are omitted.
    """
    height, width = image.shape
    x2 = (np.arange(width) - centre[0]) ** 2
    y2 = (np.arange(height) - centre[1]) ** 2
    size = int(np.sqrt(x2.max() + y2.max())) + 2
    # number, value, and both times the distance beyond the circle below
    sums = np.zeros((4, size))
    for first in range(0, height, ROWS):
        rows = slice(first, first + ROWS)
        r = np.sqrt(y2[rows, None] + x2).ravel()
        low = r.astype(np.intp)
        upper = r - low
        value = np.asarray(image[rows], float).ravel()
        for total, part in zip(sums, (None, value, upper, upper * value), strict=True):
            total += np.bincount(low, part, size)
    whole, above = sums[:2], sums[2:]
    weight, total = whole - above
    weight[1:] += above[0, :-1]
    total[1:] += above[1, :-1]
    known = weight > 0
    return np.flatnonzero(known).astype(float), total[known] / weight[known], weight[known]


def circular_centre(image: np.ndarray, start: tuple[float, float]) -> tuple[float, float]:
    """Centre about which the circular average has the largest contrast: the paper's CA.

    The contrast, the variance of the averages over all pixels, decreases with the square of the
    distance to the centre, as averages about another point blur the rings. Its maximum is found
    by Newton's method, from differences over 1 px. The start is within about 1/3 of a ring's width.

    Raises InputError: a contrast without a maximum: no rings about one centre.
    """
    # variances do not depend on an offset; sums of squares lose least without one
    image = np.asarray(image, float) - np.mean(image)

    def contrast(x: float, y: float) -> float:
        _, mean, weight = circular_average(image, (x, y))
        return float(weight @ mean**2)

    x, y = start
    for _ in range(20):
        middle, corner = contrast(x, y), contrast(x + 1, y + 1)
        right, left = contrast(x + 1, y), contrast(x - 1, y)
        below, above = contrast(x, y + 1), contrast(x, y - 1)
        slope = np.array([right - left, below - above]) / 2
        mixed = corner - right - below + middle
        curve = np.array([[right + left - 2 * middle, mixed], [mixed, below + above - 2 * middle]])
        # uphill where the contrast is not concave
        concave = np.linalg.eigvalsh(curve)[1] < 0
        step = -np.linalg.solve(curve, slope) if concave else 2 * np.sign(slope)
        x, y = np.array([x, y]) + step.clip(-2, 2)
        if concave and np.hypot(*step) < 0.01:
            return float(x), float(y)
    raise InputError("image: averages over circles have no best centre; expected rings")


def midpoint_points(
    image: np.ndarray,
    centre: tuple[float, float],
    radius: float,
    half_width: float,
    bands: int = 24,
) -> np.ndarray:
    """Crests of one ring along lines across it, left and right and above and below.

    Lines are bands of rows (columns) within half a radius of the centre; along each, a Gaussian
    fitted within ``half_width`` of the ring of ``radius`` gives the crest.

    Returns
    -------
    array (2, 2, bands, 2)
        Direction (along x, along y), side (before, behind the centre), band, and (x, y) in px.
        NaN where the line leaves the image or has no crest.
    """
    points = np.full((2, 2, bands, 2), np.nan)
    for direction in range(2):
        # lines along x of the image; along y the same on the transposed image
        lines = image if direction == 0 else image.T
        along, across = centre if direction == 0 else centre[::-1]
        edges = across + np.linspace(-radius / 2, radius / 2, bands + 1)
        for band in range(bands):
            rows = slice(*np.clip(np.round(edges[band : band + 2]), 0, len(lines)).astype(int))
            if rows.stop - rows.start < 1:
                continue
            place = (rows.start + rows.stop - 1) / 2
            values = lines[rows].mean(0)
            half = np.sqrt(radius**2 - (place - across) ** 2)
            for side, sign in enumerate((-1, 1)):
                low = round(along + sign * half - half_width)
                high = round(along + sign * half + half_width) + 1
                if low < 0 or high > len(values) or high - low < 5:
                    continue
                x = np.arange(low, high, dtype=float)
                try:
                    point = peak(x, values[low:high], x.mean(), half_width), place
                except InputError:
                    continue
                points[direction, side, band] = point if direction == 0 else point[::-1]
    return points


def midpoint_line_centre(
    image: np.ndarray, start: tuple[float, float], radius: float, half_width: float
) -> tuple[float, float]:
    """Centre from the midpoints of a ring's chords: the paper's midpoint lines (ML).

    The midpoints of all chords along x lie on the line x = x_c, those of chords along y on
    y = y_c; the lines are the means of the midpoints.

    Raises InputError: no chord along one of the directions lies in the image.
    """
    for _ in range(2):
        points = midpoint_points(image, start, radius, half_width)
        middle = points.mean(1)
        if not all(np.isfinite(middle[k, :, k]).any() for k in range(2)):
            raise InputError(
                f"image: no chord of a ring of {radius:.0f} px about ({start[0]:.0f}, "
                f"{start[1]:.0f}) px; expected a ring within the image"
            )
        x, y = (float(np.nanmean(middle[k, :, k])) for k in range(2))
        start = x, y
    return start
