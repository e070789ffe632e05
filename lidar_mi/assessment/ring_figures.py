"""Pictures of ring analyses: what was found in an image, and why a peak fitted in r is biased."""

import numpy as np
from matplotlib.figure import Figure

from lidar_mi.retrieval.peak_fit import peak
from lidar_mi.retrieval.ring_cells import annular_average
from lidar_mi.retrieval.ring_model import RingModel, expected
from lidar_mi.retrieval.ring_peaks import PIECE, ring_radius, velocity_from_radii
from lidar_mi.retrieval.rings import Rings

LINE_COLOURS = ("tab:red", "tab:cyan", "tab:orange")


def draw_rings(image: np.ndarray, rings: Rings, title: str = "") -> Figure:
    """An image with the rings found in it, its profile over r^2, and r^2 over the order."""
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    picture, profile, law = (
        figure.add_subplot(place) for place in (grid[:, 0], grid[0, 1], grid[1, 1])
    )
    height, width = image.shape
    low, high = np.percentile(image, (0.5, 99.8))
    picture.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    angle = np.linspace(0, 2 * np.pi, 721)
    for radius, line in zip(rings.radius, rings.line):
        x, y = rings.curve(radius, angle)
        picture.plot(x, y, "--", color=LINE_COLOURS[line], lw=0.9)
    picture.plot(*rings.centre, "+", color="yellow", ms=12)
    picture.set(
        xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x / px", ylabel="y / px",
        title=f"{title}\ncentre ({rings.centre[0]:.2f}, {rings.centre[1]:.2f}) px".strip(),
    )  # fmt: skip
    profile.plot(rings.r2 * 1e-3, rings.profile, color="0.3", lw=0.9)
    for radius, line in zip(rings.radius, rings.line):
        profile.axvline(radius**2 * 1e-3, color=LINE_COLOURS[line], ls="--", lw=0.9)
    profile.set(
        xlabel="$r^2$ / 1000 px$^2$", ylabel="mean over circles", title="rings about the centre"
    )
    for line, fraction in enumerate(rings.fraction):
        of_line = rings.line == line
        orders = np.array([-fraction, rings.order.max() + 0.5])
        colour = LINE_COLOURS[line]
        law.plot(orders, (orders + fraction) * rings.spacing * 1e-3, color=colour, lw=0.9)
        law.plot(rings.order[of_line], rings.radius[of_line] ** 2 * 1e-3, "o", color=colour,
                 label=f"fractional order at the centre {fraction:.4f}")  # fmt: skip
    law.legend(loc="upper left", fontsize="small")
    law.set(
        xlabel="orders below the centre", ylabel="$r^2$ / 1000 px$^2$",
        title=f"equal steps of {rings.spacing:.6g} px$^2$",
    )  # fmt: skip
    law.set_xticks(range(rings.order.max() + 1))
    return figure


def peak_bias(
    received: RingModel, emitted: RingModel, coordinate: str, pieces: np.ndarray, v_los: float = 0.0
) -> np.ndarray:
    """Error of v_LOS, m/s, of a Gaussian fitted to the innermost ring, without any noise.

    Parameters
    ----------
    received, emitted : RingModel
        Of the backscatter and of the laser, of one instrument.
    coordinate : {"r", "r2"}
    pieces : array
        Half widths of the fitted piece, in radii of the ring.
    """
    pictures = [expected(m, v).numpy() for m, v in ((received, v_los), (emitted, 0.0))]
    radii = [
        [ring_radius(p, m.centre, "ca", coordinate, piece=piece) for piece in pieces]
        for p, m in zip(pictures, (received, emitted))
    ]
    return np.array(
        [velocity_from_radii(r, e, received.focal_length, received.pixel) - v_los
         for r, e in zip(*radii)]
    )  # fmt: skip


def draw_peak_bias(received: RingModel, emitted: RingModel) -> Figure:
    """Why a ring's peak fitted over r is biased: the ring is symmetric in r^2.

    Left the received ring with the Gaussian fitted over r, middle the ring and its mirror image
    about the true radius over r and over r^2, right the error of v_LOS over the width of the
    fitted piece.
    """
    figure = Figure(figsize=(14, 4.4), layout="constrained")
    ring, mirror, error = figure.subplots(1, 3)
    picture = expected(received)
    r2, mean, _ = annular_average(picture, received.centre, received.order_spacing / 400)
    r2, mean = r2.numpy(), mean.numpy()
    r = np.sqrt(r2)
    truth = np.sqrt(received.order_at_centre % 1 * received.order_spacing)
    found = peak(r, mean, truth, PIECE * truth)
    near = np.abs(r - truth) < PIECE * truth
    ring.plot(r[r < 2 * truth], mean[r < 2 * truth], color="0.3", label="received ring")
    ring.axvspan(r[near][0], r[near][-1], color="0.92", label="fitted piece")
    ring.axvline(truth, color="tab:green", label=f"true radius {truth:.2f} px")
    ring.axvline(found, color="tab:red", ls="--", label=f"Gaussian in r {found:.2f} px")
    ring.set(ylim=(0, 1.6 * mean.max()), xlabel="r / px", ylabel="electrons a pixel", title="innermost ring, no noise")
    ring.legend(fontsize="small", loc="upper left")
    offset = np.linspace(0, 0.9 * PIECE, 200)
    inner, outer = (np.interp(truth * (1 + s * offset), r, mean) for s in (-1, 1))
    mirror.plot(offset, inner - outer, color="tab:red", label="over r: inside less outside")
    inner, outer = (np.interp(truth**2 * (1 + 2 * s * offset), r2, mean) for s in (-1, 1))
    mirror.plot(offset, inner - outer, color="tab:blue", label="over r$^2$")
    mirror.set(xlabel="distance from the crest / radius", ylabel="electrons a pixel",
               title="skew of the ring")  # fmt: skip
    mirror.legend(fontsize="small")
    pieces = np.arange(0.12, 0.46, 0.04)
    for coordinate, colour in (("r", "tab:red"), ("r2", "tab:blue")):
        error.plot(pieces, peak_bias(received, emitted, coordinate, pieces), "o-", color=colour,
                   label={"r": "Gaussian in r", "r2": "Gaussian in r$^2$"}[coordinate])  # fmt: skip
    error.axhline(0, color="0.6", lw=0.8)
    error.set(xlabel="half width of the fitted piece / radius", ylabel="error of v$_{LOS}$ / m s$^{-1}$",
              title="bias, received less emitted")  # fmt: skip
    error.legend(fontsize="small")
    return figure
