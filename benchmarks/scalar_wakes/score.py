"""Score anyone's vectors: rms error, coverage of stated errors, flags.

Vectors of a pair are a .flo file (pixels, to the right and down, dense, unknown above 1e9) or a
NetCDF file with v and w (m/s) on z and y and, if stated, v_stderr, w_stderr and flag (0: valid).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

RIM = 8.0
"""Vectors nearer to the rim of the image than this, px (here m), do not count."""
UNKNOWN = 1e9


class Score(NamedTuple):
    """Of one pair or of several."""

    rms: float
    """Rms error of v and w, valid vectors, m/s."""
    valid: float
    """Fraction of the vectors inside the rim that are valid."""
    coverage: tuple[float, float]
    """Fraction of the errors within 1 and 1.96 standard errors; NaN: none stated."""
    variance: float
    """Of the errors over their standard errors; 1 where these are right."""


def read_vectors(path: Path, truth: xr.Dataset) -> xr.Dataset:
    """Vectors of a file; those of a .flo file are on the pixels of the truth."""
    if path.suffix == ".nc":
        with xr.open_dataset(path) as found:
            return found.load()
    data = path.read_bytes()
    if data[:4] != b"PIEH":
        raise SystemExit(f"{path}: no .flo file")
    width, height = np.frombuffer(data, "<i4", 2, 4)
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)[::-1, ::-1].astype(float)
    flow = np.where(np.abs(flow) < UNKNOWN, -flow, np.nan)
    size = [float(np.diff(truth[axis].values).mean()) for axis in ("z", "y")]
    dt, on = truth.attrs["dt"], ("z", "y")
    v, w = flow[..., 0] * size[1] / dt, flow[..., 1] * size[0] / dt
    return xr.Dataset({"v": (on, v), "w": (on, w)}, truth[["z", "y"]].coords)


def errors_of(found: xr.Dataset, truth: xr.Dataset) -> dict[str, np.ndarray]:
    """Errors, normalised errors and validity of the vectors inside the rim."""
    at = {axis: found.get(f"{axis}_vector", found[axis]) for axis in ("z", "y")}
    true = truth[["v", "w"]].interp(at)
    limits = {axis: np.abs(truth[axis].values).max() - RIM for axis in ("z", "y")}
    inside = (abs(found["z"]) < limits["z"]) & (abs(found["y"]) < limits["y"])
    error = np.stack([(found[name] - true[name]).transpose("z", "y").values for name in "vw"])
    valid = np.isfinite(error).all(0)
    if "flag" in found:
        valid &= found["flag"].transpose("z", "y").values == 0
    normalised = np.full_like(error, np.nan)
    if "v_stderr" in found:
        stated = [found[f"{name}_stderr"].transpose("z", "y").values for name in "vw"]
        normalised = error / np.stack(stated)
    inside = inside.transpose("z", "y").values
    return {"error": error[:, inside], "normalised": normalised[:, inside], "valid": valid[inside]}


def score(parts: list[dict[str, np.ndarray]]) -> Score:
    """Score of the vectors of some pairs together."""
    valid = np.concatenate([part["valid"] for part in parts])
    error, normalised = (
        np.concatenate([part[name] for part in parts], axis=1)[:, valid]
        for name in ("error", "normalised")
    )
    if not valid.any():
        return Score(np.nan, 0.0, (np.nan, np.nan), np.nan)
    stated = np.isfinite(normalised).all()
    within = tuple(
        float(np.mean(np.abs(normalised) < limit)) if stated else np.nan for limit in (1, 1.96)
    )
    variance = float(np.mean(normalised**2)) if stated else np.nan
    return Score(float(np.sqrt(np.mean(error**2))), float(valid.mean()), within, variance)
