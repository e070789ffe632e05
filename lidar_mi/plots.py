"""Plots that a user expects of results: ``wind.lm.plot()``, ``scan.lm.plot()``.

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

ARROWS = 28
"""About as many arrows along the longer side."""

_SHORTEST = 0.4  # arrow, in distances between arrows

_COLOURS = {
    "off": "tab:red",
    "autopilot": "tab:purple",
    "feedforward": "tab:blue",
    "perfect": "0.35",
}


@xr.register_dataset_accessor("lidar")
@xr.register_dataset_accessor("lm")
class LidarPlots:
    """What lidar-mi adds to a data set of winds, of a scan or of flights, as ``data.lm``.

    ``data.lidar`` is the same.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> scan = lm.read_scan("image_t1.exr")  # doctest: +SKIP
    >>> axes = scan.lm.plot()  # doctest: +SKIP
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

    def wind(
        self, ax: "Axes | None" = None, *, colours: str = "speed", lines: str = "arrows"
    ) -> "Axes":
        """Draw winds; parameters and errors as of `plot_wind`."""
        return plot_wind(self._data, ax, colours=colours, lines=lines)

    def vorticity(self) -> xr.DataArray:
        """Vorticity along x of winds (v, w); as of `vorticity`."""
        return vorticity(self._data)

    def flights(self, name: Hashable = "roll", ax: "Axes | None" = None) -> "Axes":
        """Draw a time series of every flight."""
        return plot_flights(self._data, ax, name)


def vorticity(wind: xr.Dataset) -> xr.DataArray:
    """Vorticity along x, dw/dy - dv/dz, s^-1, by central differences of valid vectors.

    Parameters
    ----------
    wind : xr.Dataset, dims (z, y)
        v, w (m s^-1), y and z (m); vectors with a flag other than 0 are left out.

    Returns
    -------
    xr.DataArray, dims (z, y)
        Positive: anticlockwise from y to z. NaN beside a vector that is left out.

    Raises
    ------
    InputError
        Winds of more than one plane, source or method.
    """
    _only_a_plane(wind["v"])
    valid = wind.where(wind["flag"] == 0) if "flag" in wind else wind
    curl = valid["w"].differentiate("y") - valid["v"].differentiate("z")
    about = {"long_name": "vorticity along x", "units": "s-1"}
    return curl.transpose("z", "y").rename("vorticity").assign_attrs(about)


def arrow_length(speeds: np.ndarray, limit: float) -> float:
    """Length of the arrow of the largest speed, in distances between arrows.

    The median speed has a third of a distance, so that arrows are seen far from the cores, however
    large the plane is; the largest has between 1.8 and 5, so that they do not cover each other.

    Parameters
    ----------
    speeds : array
        Of the arrows, m/s; those that are not finite are left out.
    limit : float
        The largest speed, m/s.
    """
    known = speeds[np.isfinite(speeds)]
    usual = float(np.median(known)) if known.size else 0.0
    return float(np.clip(limit / (3 * usual), 1.8, 5.0)) if usual > 0 else 1.8


def arrow_stretch(speeds: np.ndarray, stderr: np.ndarray | None, most: float) -> np.ndarray:
    """Factors of the lengths of arrows by which none is too short to show its direction.

    The shortest arrow is 0.4 of the distance between arrows. Those with a standard error above
    their speed are left as they are: they have no direction. Colours tell the speed.

    Parameters
    ----------
    speeds, stderr : arrays
        Of the arrows, m/s; stderr None: not known, as 0.
    most : float
        Speed whose arrow is as long as arrows are apart, m/s.
    """
    least = _SHORTEST * most
    sure = speeds > 0 if stderr is None else speeds > np.maximum(stderr, 0.0)
    return np.where(sure, np.maximum(least / np.where(sure, speeds, np.inf), 1.0), 1.0)


def plot_wind(
    wind: xr.Dataset, ax: "Axes | None" = None, *, colours: str = "speed", lines: str = "arrows"
) -> "Axes":
    """Cross-flow wind (v, w) on (z, y) as arrows or streamlines on its speed or vorticity.

    Flagged vectors are grey. Where the standard error exceeds the speed, colours are pale. Arrows
    elsewhere are no shorter than 0.4 of their distance, see `arrow_stretch`.

    Parameters
    ----------
    wind : xr.Dataset, dims (z, y)
        v, w (m s^-1); ``flag``, ``v_stderr`` and ``w_stderr`` where there are any.
    ax : matplotlib Axes, optional
        Default: of a new figure.
    colours : str
        speed or vorticity.
    lines : str
        arrows or streamlines; streamlines end at flagged vectors.

    Raises
    ------
    InputError
        Vectors of more than one plane, source or method; other colours or lines.
    """
    _one_of("colours", colours, ("speed", "vorticity"))
    _one_of("lines", lines, ("arrows", "streamlines"))
    _only_a_plane(wind["v"])
    v, w = (wind[name].transpose("z", "y") for name in "vw")
    valid = (
        (wind["flag"].transpose("z", "y") == 0).values if "flag" in wind else np.ones(v.shape, bool)
    )
    speed = np.hypot(v.values, w.values)
    known = speed[valid & np.isfinite(speed)]
    unit = re.sub(r"-(\d)", r"$^{-\1}$", str(v.attrs.get("units", "m s-1")))
    ax = _axes(ax, v)
    if colours == "vorticity":
        field = vorticity(wind).values
        label = f"vorticity along x / {unit.removeprefix('m ')}"
        limit = _largest(np.abs(field))
        span: dict[str, Any] = {"vmin": -limit, "vmax": limit, "cmap": "RdBu_r"}
    else:
        field = np.where(valid, speed, np.nan)
        label = f"{'cross-flow wind' if unit.startswith('m') else 'motion'} / {unit}"
        limit = _largest(field)
        span = {"vmin": 0, "vmax": limit, "cmap": "viridis"}
    beyond = bool((np.abs(field[np.isfinite(field)]) > limit).any())
    ends = ("both" if colours == "vorticity" else "max") if beyond else "neither"
    y, z = v["y"].values, v["z"].values
    mesh = ax.pcolormesh(y, z, field, shading="nearest", **span)
    ax.figure.colorbar(mesh, ax=ax, label=label, extend=ends, pad=0.02)
    # after the bar, whose colours are full
    stderr = _stderr(wind)
    opacity: Any = None if stderr is None else np.where(stderr > speed, 0.25, 1.0)
    mesh.set_alpha(opacity)
    on_top = "white" if colours == "speed" else "black"
    if lines == "streamlines":
        across, up = (np.where(valid, part.values, np.nan) for part in (v, w))
        ax.streamplot(y, z, across, up, color=on_top, density=1.4, linewidth=0.7, arrowsize=0.7)
        return _axes(ax, v)
    _quiver(ax, v, w, valid, on_top, _largest(known), unit, stderr)
    return ax


def _quiver(
    ax: "Axes",
    v: xr.DataArray,
    w: xr.DataArray,
    valid: np.ndarray,
    colour: str,
    limit: float,
    unit: str,
    stderr: np.ndarray | None,
) -> None:
    """Arrows of valid vectors in a colour; others are grey and no longer than arrows are apart."""
    y, z = v["y"].values, v["z"].values
    every = max(1, round(max(v.shape) / ARROWS))
    some = np.s_[::every, ::every]
    step = every * float(np.ptp(y)) / max(1, len(y) - 1)
    speed = np.hypot(v.values, w.values)
    length = arrow_length(speed[valid], limit)
    style: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": limit / (length * step) if step else 1.0,
        "width": 0.0025,
    }
    most = limit / length
    stretch = arrow_stretch(speed, stderr, most)
    shorter = np.where(valid, stretch, most / np.maximum(speed, most))
    for which, shade in ((valid, colour), (~valid, "0.6")):
        arrows = ax.quiver(
            y[::every],
            z[::every],
            np.where(which, v.values * shorter, np.nan)[some],
            np.where(which, w.values * shorter, np.nan)[some],
            color=shade,
            **style,
        )
        if which is valid:
            key = float(f"{limit:.1g}") or 1.0
            label = f"{key:g} {unit}"
            ax.quiverkey(arrows, 0.9, 1.04, key, label, labelpos="W", color="black")
    ax.set_title(ax.get_title() or " ")  # room for the key


def _largest(values: np.ndarray) -> float:
    """Of known values; the few of a core do not determine the scale of all others."""
    known = values[np.isfinite(values)]
    return (float(np.quantile(known, 0.999)) if known.size else 0.0) or 1.0


def _stderr(wind: xr.Dataset) -> np.ndarray | None:
    """Of the vectors, m/s, (z, y); None: no errors are stated."""
    if not {"v_stderr", "w_stderr"} <= set(wind.data_vars):
        return None
    errors = [np.broadcast_to(wind[f"{name}_stderr"], wind[name].shape) for name in "vw"]
    return xr.DataArray(np.hypot(*errors), dims=wind["v"].dims).transpose("z", "y").values


def _one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"{name}: {value!r} is not allowed; expected {' or '.join(allowed)}")


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
