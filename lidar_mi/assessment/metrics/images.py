"""Metrics of a rendered scan: its Monte Carlo noise, multiple scattering, depolarisation."""

import xarray as xr

from lidar_mi.assessment.metrics.names import Source
from lidar_mi.instrument.products import linear_depolarization


def noise_metrics(scan: xr.Dataset) -> dict[str, float]:
    """Monte Carlo standard error over signal, median over the pixels, ``mc_relative_error``."""
    signal = scan["S0"].where(scan["S0"] > 0)
    return {f"{Source.BACKSCATTER}.mc_relative_error": float((scan["S0_stderr"] / signal).median())}


def light_metrics(scan: xr.Dataset) -> dict[str, float]:
    """Noise, fraction of multiple scattering and depolarisation of a scan's first gate.

    scan: as rendered; metrics of missing variables are absent.
    """
    first = scan.isel(gate=0)
    metrics = noise_metrics(first)
    if "order1.S0" in first:
        total = float(first["S0"].sum(dtype=float))
        single = float(first["order1.S0"].sum(dtype=float))
        metrics[f"{Source.BACKSCATTER}.multiple_scattering_fraction"] = 1 - single / total
    if "depolarization" in first:
        s0, s1 = (float(first[name].sum(dtype=float)) for name in ("S0", "S1"))
        ratio = float(linear_depolarization(s0, s1))
        metrics[f"{Source.BACKSCATTER}.depolarization"] = ratio
        stderr = float(first["depolarization_stderr"].median())
        metrics[f"{Source.BACKSCATTER}.depolarization_stderr"] = stderr
    return metrics
