"""Whether a cross-flow can be that of a wake: its sense of rotation, its divergence.

A velocity or an axis of the wrong sign gives an impossible flow, or a wake that rises, and no error
message.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core, ring_averages

MOST_DIVERGENCE = 0.5
"""Largest plausible `relative_divergence` of a cross-section. Sections of a simulated wake have
0.1, those of isotropic turbulence 1 / sqrt(5) (Taylor 1935: <(du/dx)^2> is a fifth of the mean
square of a component of the vorticity). With a component or an axis of the wrong sign they have
1."""


def relative_divergence(wind: xr.Dataset) -> float:
    """Rms of the divergence over the rms of the vorticity of a cross-flow (v, w on z, y).

    Of air that is stretched along x, the cross-flow has the divergence -du/dx. NaN where there is
    no vorticity.
    """
    spacing = {axis: wind[axis].values for axis in ("y", "z")}
    v, w = (wind[name].transpose("z", "y").values.astype(float) for name in ("v", "w"))
    if min(v.shape) < 2:
        return float("nan")
    divergence = np.gradient(v, spacing["y"], axis=1) + np.gradient(w, spacing["z"], axis=0)
    vorticity = np.gradient(w, spacing["y"], axis=1) - np.gradient(v, spacing["z"], axis=0)
    rms = np.sqrt((vorticity**2).mean())
    return float(np.sqrt((divergence**2).mean()) / rms) if rms > 0 else float("nan")


def rises(cores: Sequence[Core]) -> bool:
    """Whether a pair of vortices rotates against the lift of an aircraft, and so rises.

    Behind a lifting wing the port vortex (larger y) rotates from +y towards +z, and the air between
    both sinks.
    """
    if len(cores) != 2:
        return False
    port, starboard = sorted(cores, key=lambda core: -core.y)
    return port.circulation < 0 < starboard.circulation


def sense_of_rotation(wind: xr.Dataset, cores: Sequence[Core]) -> str:
    """The vortices of a cross-flow in words, port first.

    Circulations are averages over rings of 5 to 15 m, or, where these leave the field or meet the
    other vortex, those at the core radius, which are marked.
    """
    if not cores:
        return "no vortices"
    vortices = sorted(cores, key=lambda core: -core.y)
    senses = ", ".join(
        f"{_circulation(wind, core, [other for other in vortices if other is not core])} "
        f"at y = {core.y:z.1f} m, z = {core.z:z.1f} m"
        for core in vortices
    )
    if len(vortices) < 2:
        return senses
    return f"{senses}: the pair {'rises' if rises(vortices) else 'sinks'}"


def _circulation(wind: xr.Dataset, core: Core, others: Sequence[Core]) -> str:
    rings = ring_averages(wind, core, others)
    if rings is None:
        return f"{core.circulation:+.0f} m²/s (core of {core.radius:.1f} m)"
    return f"{rings.circulation:+.0f} m²/s"
