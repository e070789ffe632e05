"""Histogram of errors over standard errors, and the density that it should have."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from scipy import stats


def draw_normalised_errors(
    axes: Axes, errors: Mapping[str, np.ndarray], color: str | None = None
) -> None:
    """Histogram of errors over standard errors, by label; the last bins hold all beyond 5."""
    edges = np.linspace(-5, 5, 51)
    for label, values in errors.items():
        finite = values[np.isfinite(values)]
        axes.hist(
            np.clip(finite, -5, 5),
            list(edges),
            density=True,
            histtype="step",
            label=label,
            color=color,
        )


def draw_normal_density(axes: Axes) -> None:
    """The density of normalised errors with correct standard errors."""
    middle = np.linspace(-4.9, 4.9, 50)
    axes.plot(middle, stats.norm.pdf(middle), "k:", label="as stated")
    axes.set(xlabel="normalised error", ylabel="density")
