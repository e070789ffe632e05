"""Plots that a user expects of results: ``wind.lidar.plot()``, ``scan.lidar.plot()``.

All show the pilot's view: port (+y) on the left, up (+z) at the top. matplotlib is loaded by the
first plot.
"""

import re
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ARROWS = 28
"""About as many arrows along the longer side."""

_COLOURS = {
    "off": "tab:red",
    "autopilot": "tab:purple",
    "feedforward": "tab:blue",
    "perfect": "0.35",
}


@xr.register_dataset_accessor("lidar")
class LidarPlots:
    """What lidar-mi adds to a data set of winds or of a scan, as ``data.lidar``.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> scan = lm.read_scan("image_t1.exr")  # doctest: +SKIP
    >>> axes = scan.lidar.plot()  # doctest: +SKIP
    """

    def __init__(self, data: xr.Dataset) -> None:
        self._data = data

    def plot(self, ax: "Axes | None" = None, layer: str | None = None) -> "Axes":
        """Draw winds as arrows on their speed, a scan as its image.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: of a new figure.
        layer : str, optional
            Variable of a scan, such as ``depolarization``. Default: ``Y_noisy`` where there is
            one, else ``Y``.

        Returns
        -------
        matplotlib Axes
            Flagged vectors are grey.

        Raises
        ------
        InputError
            Neither winds nor a scan; winds of several sources or methods, or of several planes.
        """
        data = self._data
        if layer is None and {"v", "w"} <= set(data.data_vars):
            return plot_wind(data, ax)
        layer = layer or ("Y_noisy" if "Y_noisy" in data else "Y")
        if layer not in data:
            raise InputError(
                f"plot: no {layer}, nor v and w; it has {', '.join(map(str, data.data_vars))}; "
                "expected winds, or a scan of the backscatter lidar"
            )
        return plot_image(data[layer], ax)


def plot_wind(wind: xr.Dataset, ax: "Axes | None" = None) -> "Axes":
    """Cross-flow wind (v, w) on (z, y) as arrows on its speed; flagged vectors are grey.

    Raises
    ------
    InputError
        Vectors of more than one plane, source or method.
    """
    _only_a_plane(wind["v"])
    v, w = (wind[name].transpose("z", "y") for name in "vw")
    valid = (
        (wind["flag"].transpose("z", "y") == 0).values if "flag" in wind else np.ones(v.shape, bool)
    )
    speed = np.hypot(v.values, w.values)
    known = speed[valid & np.isfinite(speed)]
    # the few vectors of a core must not determine the scale of all others
    limit = float(np.quantile(known, 0.999)) if known.size else 1.0
    ax, extend = _axes(ax, v), "max" if known.size and known.max() > limit else "neither"
    y, z = v["y"].values, v["z"].values
    shown = np.where(valid, speed, np.nan)
    mesh = ax.pcolormesh(y, z, shown, shading="nearest", vmin=0, vmax=limit or 1.0, cmap="viridis")
    unit = re.sub(r"-(\d)", r"$^{-\1}$", str(v.attrs.get("units", "m s-1")))
    what = "cross-flow wind" if unit.startswith("m") else "motion"
    ax.figure.colorbar(mesh, ax=ax, label=f"{what} / {unit}", extend=extend, pad=0.02)
    every = max(1, round(max(v.shape) / _ARROWS))
    some = np.s_[::every, ::every]
    step = every * float(np.ptp(y)) / max(1, len(y) - 1)
    style: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": (limit or 1.0) / (1.8 * step) if step else 1.0,
        "width": 0.0025,
    }
    for which, colour in ((valid, "white"), (~valid, "0.6")):
        arrows = ax.quiver(
            y[::every],
            z[::every],
            np.where(which, v.values, np.nan)[some],
            np.where(which, w.values, np.nan)[some],
            color=colour,
            **style,
        )
        if colour == "white":
            length = float(f"{limit:.1g}") or 1.0
            label = f"{length:g} {unit}"
            ax.quiverkey(arrows, 0.9, 1.04, length, label, labelpos="W", color="black")
    ax.set_title(ax.get_title() or " ")  # room for the key
    return ax


def plot_image(image: xr.DataArray, ax: "Axes | None" = None) -> "Axes":
    """An image (z, y) in colours from its 1st to its 99th percentile.

    Raises
    ------
    InputError
        An image of more than one gate.
    """
    if image.sizes.get("gate") == 1:
        image = image.isel(gate=0)
    _only_a_plane(image)
    image = image.transpose("z", "y")
    finite = image.values[np.isfinite(image.values)]
    low, high = np.quantile(finite, [0.01, 0.99]) if finite.size else (0, 1)
    ax = _axes(ax, image)
    mesh = ax.pcolormesh(
        image["y"], image["z"], image.values, shading="nearest", vmin=low, vmax=high, cmap="cividis"
    )
    unit = str(image.attrs.get("units", ""))
    label = f"{image.name}{f' / {unit}' if unit not in ('', '1') else ''}"
    ax.figure.colorbar(mesh, ax=ax, label=label, extend="both", pad=0.02)
    return ax


def plot_flights(series: xr.Dataset, ax: "Axes | None" = None, name: Hashable = "roll") -> "Axes":
    """A time series of every flight; angles in degrees."""
    import matplotlib.pyplot as plt

    if ax is None:
        ax = plt.subplots(figsize=(7.5, 4.2), layout="compressed")[1]
    one = series[name]
    angle = str(one.attrs.get("units", "")).startswith("rad")
    for flight in series["flight"].values:
        flown = one.sel(flight=flight)
        values = np.degrees(flown) if angle else flown
        ax.plot(flown["time"], values, label=str(flight), color=_COLOURS.get(str(flight)))
    unit = str(one.attrs.get("units", "")).replace("rad", "degrees", 1 if angle else 0)
    text = str(one.attrs.get("long_name", name))
    ax.set(xlabel="time of flight / s", ylabel=f"{text} / {unit}" if unit else text)
    ax.axhline(0, color="0.7", lw=0.8, zorder=0)
    ax.legend()
    return ax


def _only_a_plane(field: xr.DataArray) -> None:
    """Refuse what has other dimensions than z and y."""
    more = [str(dim) for dim in field.dims if dim not in ("z", "y")]
    if more or {"z", "y"} - set(field.dims):
        choose = ", ".join(f"{dim}=..." for dim in more)
        raise InputError(
            f"plot: dimensions {', '.join(map(str, field.dims))}; expected z and y"
            + (f": choose by .sel({choose})" if more else "")
        )


def _axes(ax: "Axes | None", field: xr.DataArray) -> "Axes":
    """The pilot's view: port on the left, up at the top, metres true to scale."""
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=(7.5, 4.6), layout="compressed")[1]
    y, z = field["y"].values, field["z"].values
    unit = field["y"].attrs.get("units", "m")
    ax.set(xlabel=f"y / {unit} (port is left)", ylabel=f"z / {unit}", aspect="equal")
    ax.set_xlim(float(y.max()), float(y.min()))
    ax.set_ylim(float(z.min()), float(z.max()))
    return ax
