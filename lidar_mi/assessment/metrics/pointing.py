"""What errors of the reported poses make of a wind that is retrieved from two scans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ScanPointing:
    """Times and places of the beams of two scans, in the plane in the middle of their gates.

    y, z (columns,), (rows,) arrays: nodes of the image, ascending, m.
    dt: time between the scans, s.
    time (2, n): of each beam from its scan's reference time, s, in film order.
    places (2, n, 2): y and z as reported, m.
    errors (2, n, 2): true less reported, m.
    """

    y: np.ndarray
    z: np.ndarray
    dt: float
    time: np.ndarray
    places: np.ndarray
    errors: np.ndarray

    def on_nodes(self) -> bool:
        """Whether the beams of both scans are reported at the nodes, film order."""
        lateral, vertical = np.meshgrid(self.y[::-1], self.z[::-1])
        nodes = np.stack([lateral.ravel(), vertical.ravel()], -1)
        spacing = np.ptp(self.y) / max(self.y.size - 1, 1)
        # up to rounding
        return bool(np.abs(self.places - nodes).max() < 1e-6 * spacing)


def apparent_wind(pointing: ScanPointing) -> np.ndarray:
    """Wind v, w (n, 2), m/s, that errors of the poses add to that of beams on the same nodes.

    Air at ``e`` from the reported place is displaced by ``e`` to the other side:
    -(e2 - e1) / dt, whatever the method. What both scans have in common adds nothing.
    """
    return -(pointing.errors[1] - pointing.errors[0]) / pointing.dt


def common_motion(pointing: ScanPointing) -> tuple[np.ndarray, float]:
    """Mean apparent wind (v, w), m/s, and its rotation (s^-1): the part common to all vectors.

    A least squares fit of a uniform wind and a velocity gradient to the errors of each scan, so
    that the beams need not be at the same places. The rotation is half of dw/dy - dv/dz; it adds
    2 pi r^2 times itself to the circulation at a radius r.
    """
    fits = []
    for places, errors in zip(pointing.places, pointing.errors, strict=True):
        model = np.column_stack([np.ones(len(places)), places])
        fits.append(np.linalg.lstsq(model, errors, rcond=None)[0])
    motion = -(fits[1] - fits[0]) / pointing.dt
    return motion[0], float(motion[1, 1] - motion[2, 0]) / 2


def pointing_metrics(pointing: ScanPointing | None) -> dict[str, float]:
    """``pointing.rms_y`` (m) and so on; none where all beams are where they are reported."""
    if pointing is None:
        return {}
    (v, w), rotation = common_motion(pointing)
    rms = np.sqrt((pointing.errors**2).mean((0, 1)))
    return {
        "pointing.scan_time": float(np.ptp(pointing.time[0])),
        "pointing.rms_y": float(rms[0]),
        "pointing.rms_z": float(rms[1]),
        "pointing.bias_v": float(v),
        "pointing.bias_w": float(w),
        "pointing.rotation": rotation,
    }


def scan_pointing(
    y: np.ndarray,
    z: np.ndarray,
    dt: float,
    times: Sequence[np.ndarray],
    true: Sequence[np.ndarray],
    reported: Sequence[np.ndarray],
) -> ScanPointing:
    """From the times (n,) and places (n, 2) of the beams of both scans."""
    places = np.stack(reported)
    return ScanPointing(y, z, dt, np.stack(times), places, np.stack(true) - places)
