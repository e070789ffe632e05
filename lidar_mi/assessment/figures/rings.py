"""Figures of ring analyses: the rings detected in an image."""

import numpy as np
from matplotlib.figure import Figure

from lidar_mi.retrieval.rings.analysis import Rings

LINE_COLOURS = ("tab:red", "tab:cyan", "tab:orange")


def draw_rings(image: np.ndarray, rings: Rings, title: str = "") -> Figure:
    """An image with the rings detected in it, its profile over r^2, and r^2 over the order."""
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    panel, profile, law = (
        figure.add_subplot(place) for place in (grid[:, 0], grid[0, 1], grid[1, 1])
    )
    height, width = image.shape
    low, high = np.percentile(image, (0.5, 99.8))
    panel.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    angle = np.linspace(0, 2 * np.pi, 721)
    for radius, line in zip(rings.radius, rings.line, strict=True):
        x, y = rings.curve(radius, angle)
        panel.plot(x, y, "--", color=LINE_COLOURS[line], lw=0.9)
    panel.plot(*rings.centre, "+", color="yellow", ms=12)
    panel.set(
        xlim=(-0.5, width - 0.5),
        ylim=(height - 0.5, -0.5),
        xlabel="x / px",
        ylabel="y / px",
        title=f"{title}\ncentre ({rings.centre[0]:.2f}, {rings.centre[1]:.2f}) px".strip(),
    )
    profile.plot(rings.r2 * 1e-3, rings.profile, color="0.3", lw=0.9)
    for radius, line in zip(rings.radius, rings.line, strict=True):
        profile.axvline(radius**2 * 1e-3, color=LINE_COLOURS[line], ls="--", lw=0.9)
    profile.set(
        xlabel="$r^2$ / 1000 px$^2$", ylabel="mean over circles", title="rings about the centre"
    )
    for line, fraction in enumerate(rings.fraction):
        of_line = rings.line == line
        orders = np.array([-fraction, rings.order.max() + 0.5])
        colour = LINE_COLOURS[line]
        law.plot(orders, (orders + fraction) * rings.spacing * 1e-3, color=colour, lw=0.9)
        law.plot(
            rings.order[of_line],
            rings.radius[of_line] ** 2 * 1e-3,
            "o",
            color=colour,
            label=f"fractional order at the centre {fraction:.4f}",
        )
    law.legend(loc="upper left", fontsize="small")
    law.set(
        xlabel="orders below the centre",
        ylabel="$r^2$ / 1000 px$^2$",
        title=f"equal steps of {rings.spacing:.6g} px$^2$",
    )
    law.set_xticks(range(rings.order.max() + 1))
    return figure
