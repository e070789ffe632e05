"""All methods for the wind: lidar-mi, OpenPIV, OpenCV and scikit-image, at four noise levels.

Errors are those of v at a method's own vectors, at least 8 px inside the image, each compared with
the wind at the vector's position (see `velocimetry`).
"""

import time
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.retrieval.wind.methods import METHODS
from lidar_mi.retrieval.wind.pair import retrieve_wind

from .cases import CORE_RADIUS, DT, SPACING, Pair, vortex_pair_images
from .report import Comparison, row
from .velocimetry import Field, window_deformation

NOISE = (0.0, 0.01, 0.03, 0.06)
RIM = 8


def compare(repeats: int = 5, columns: int = 219, rows: int = 139) -> Comparison:
    """Errors averaged over as many textures as ``repeats``, and the fastest call's time."""
    title = f"Wind from an image pair of {columns} x {rows} px, all methods"
    sides = ("everywhere", "beyond 2 core radii")
    methods = {f"lidar-mi {name}": (ours(name), "") for name in METHODS}
    for name, (find, package) in PEERS.items():
        methods[name] = (find, "" if find_spec(package) else f"skipped: pip install {PIP[package]}")
    lines = []
    for noise in NOISE:
        pairs = [vortex_pair_images(noise, seed, columns, rows) for seed in range(1, repeats + 1)]
        for name, (find, skipped) in methods.items():
            case = f"noise of {noise:.0%} of the mean"
            if skipped:
                lines.append(row(case, name, "m/s", [], [], note=skipped))
                continue
            find(pairs[0])
            errors, seconds = [], []
            for pair in pairs:
                start = time.perf_counter()
                field = find(pair)
                seconds.append(time.perf_counter() - start)
                errors.append(rms_errors(pair, field))
            mean = np.mean(errors, axis=0)
            note = f"{min(seconds):.3f} s"
            lines.append(row(case, name, "m/s", [mean[0]], [mean[1]], note=note))
    return Comparison(
        title,
        *sides,
        tuple(lines),
        (
            (
                f"Rms error of v, mean over {repeats} textures; the case of the other table of "
                "winds, with white noise. No vector is left out."
            ),
            (
                "lidar-mi: default settings, one vector per pixel, time with quality flags. "
                "OpenPIV: windef.simple_multipass with windows of 32, 16, 8, 8 px. OpenCV: DIS "
                "optical flow, medium preset, on 8 bits. scikit-image: TV-L1 and iterative "
                "Lucas-Kanade with their defaults."
            ),
        ),
    )


def ours(method: str) -> Callable[[Pair], Field]:
    def find(pair: Pair) -> Field:
        wind = retrieve_wind(pair.first, pair.second, DT, method)
        moved = [wind[name].values * DT / SPACING for name in ("w", "v")]
        start = (float(wind["z"][0]) - float(pair.first["z"][0])) / SPACING
        return Field(*moved, start=start, moved=0.0 if METHODS[method].centred else 0.5)

    return find


def open_piv(pair: Pair) -> Field:
    return window_deformation(pair, (32, 16, 8, 8), (8, 4, 2, 1))


def dis_flow(pair: Pair) -> Field:
    import cv2

    images = [
        np.clip((image.values - 0.2) / 1.6 * 255, 0, 255).astype(np.uint8)
        for image in (pair.first, pair.second)
    ]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*images, None)
    return Field(flow[..., 1], flow[..., 0], start=0, moved=0.5)


def tv_l1(pair: Pair) -> Field:
    from skimage.registration import optical_flow_tvl1

    return Field(*optical_flow_tvl1(pair.first.values, pair.second.values), start=0, moved=0.5)


def lucas_kanade(pair: Pair) -> Field:
    from skimage.registration import optical_flow_ilk

    return Field(*optical_flow_ilk(pair.first.values, pair.second.values), start=0, moved=0.5)


PEERS = {
    "OpenPIV window deformation": (open_piv, "openpiv"),
    "OpenCV DIS": (dis_flow, "cv2"),
    "scikit-image TV-L1": (tv_l1, "skimage"),
    "scikit-image ILK": (lucas_kanade, "skimage"),
}
PIP = {"openpiv": "openpiv", "cv2": "opencv-python-headless", "skimage": "scikit-image"}


def rms_errors(pair: Pair, field: Field) -> tuple[float, float]:
    """Rms error of v everywhere and beyond two core radii, m/s."""
    place = [
        float(pair.first[name][0]) + (field.start + np.arange(n)) * SPACING
        for name, n in zip(("z", "y"), field.dz.shape, strict=True)
    ]
    z, y = np.meshgrid(*place, indexing="ij")
    dz, dy = field.dz * SPACING, field.dy * SPACING
    v, _ = velocity(pair.vortices, y + field.moved * dy, z + field.moved * dz)
    square = (dy / DT - v) ** 2
    edge = [float(np.abs(pair.first[name]).max()) - RIM * SPACING for name in ("z", "y")]
    inside = np.isfinite(square) & (np.abs(z) < edge[0]) & (np.abs(y) < edge[1])
    distance = np.min([np.hypot(y - o.y, z - o.z) for o in pair.vortices], axis=0)
    return tuple(
        float(np.sqrt(square[chosen].mean()))
        for chosen in (inside, inside & (distance > 2 * CORE_RADIUS))
    )
