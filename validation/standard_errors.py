"""Standard errors stated by images, against the scatter of images."""

import math
from importlib.resources import files

import numpy as np

from . import figures
from .lidar_equation import SCAN, layered
from .multiple_scattering import FORWARD, RAYLEIGH, dense
from .report import Check, Row
from .scenes import ENVIRONMENT, batches, layer, medium, render, scene, secants

TITLE = "Standard errors"
INTRODUCTION = (
    "A z-score is the error of a value over its standard error. If the standard errors are "
    "correct, it has the mean 0 and the variance 1 over beams, gates and seeds."
)


def _draw(place, scores):
    """Histograms of z-scores and the normal distribution, down to where one score is a step."""
    edges = np.linspace(-5, 5, 51)
    lowest = min(0.5 / (0.2 * z.size) for z in scores.values())
    middle = (edges[1:] + edges[:-1]) / 2
    with figures.figure(place) as axis:
        axis.plot(
            middle,
            np.exp(-(middle**2) / 2) / math.sqrt(2 * math.pi),
            color=figures.REFERENCE,
            label="normal",
        )
        for number, (name, z) in enumerate(scores.items()):
            density, _ = np.histogram(np.clip(z, -4.99, 4.99), edges, density=True)
            axis.plot(
                middle,
                np.where(density > 0, density, np.nan),
                "." if number % 2 else "x",
                color=f"C{number}",
                markersize=5,
                label=name,
            )
        axis.set(yscale="log", ylim=(lowest, 1), xlabel="z-score", ylabel="density")
        axis.legend(frameon=False, fontsize=8)


def single_scattering(effort):
    """The paper's scan: 30 441 beams, each against the lidar equation."""
    size, samples = (219, 139), 1024 * effort.scale
    shapes = {"slab": layer(490, 512, medium(2e-2), ENVIRONMENT)}
    loaded = scene((500, 502.5), shapes, size, environment=medium(1e-4), **SCAN)
    found = render(loaded, 400, samples)
    truth = layered([500, 502.5], [(0, 1e-4), (490, 2e-2)], secants(loaded, size))
    z = (found["S0"] - truth) / found["S0_stderr"]
    # means over n samples are normal up to a few 1/n
    slack = 4 / samples
    rows = [
        Row(
            f"mean square of {z.size} z-scores",
            "lidar equation",
            1.0,
            (z**2).mean(),
            math.sqrt(2 / z.size),
            slack,
        ),
        Row(
            "mean z-score",
            "lidar equation",
            0.0,
            z.mean(),
            1 / math.sqrt(z.size),
            1e-5 * (truth / found["S0_stderr"]).mean(),
        ),
        Row(
            "fraction of beams beyond 3 sigma",
            "normal distribution",
            0.0027,
            (np.abs(z) > 3).mean(),
            math.sqrt(0.0027 / z.size),
            0.0027 * 10 * slack,
        ),
    ]
    return Check(
        "Single scattering, beam by beam",
        f"219 x 139 beams over 12.4 by 7.8 degrees, {samples} samples each, slab of 0.02 / m, "
        "gate of 2.5 m at 500 m.",
        tuple(rows),
    )


def multiple_scattering(effort):
    """Dense slabs, gate by gate, over seeds."""
    rows, scores = [], {}
    seeds = 100
    for number, (name, case, estimator, samples) in enumerate(
        (
            ("molecules, gated", RAYLEIGH, "gated", 30_000),
            ("molecules, analog", RAYLEIGH, "analog", 30_000),
            ("forward scatterers, gated", FORWARD, "gated", 60_000),
            ("forward scatterers, analog", FORWARD, "analog", 60_000),
        )
    ):
        found = batches(dense(case, estimator), 410 + number, seeds * samples, seeds)
        value, error = (found[key][..., 0, 0] for key in ("S0", "S0_stderr"))
        # variances: a mean of squared errors is unbiased, a z-score of skewed samples is not
        ratio = value.var(0, ddof=1) / (error**2).mean(0)
        excess = ((value - value.mean(0)) ** 4).mean(0) / value.var(0) ** 2 - 1
        sigma = np.sqrt((excess / seeds).mean() / ratio.size)
        rows.append(
            Row(
                f"{name}: variance over seeds / stated, ten gates",
                f"{seeds} seeds",
                1.0,
                ratio.mean(),
                sigma,
            )
        )
        scores[name] = ((value - value.mean(0)) / error).ravel() * math.sqrt(seeds / (seeds - 1))
    place = effort.folder / "z_scores_dense.png"
    _draw(place, scores)
    return Check(
        "Multiple scattering, gate by gate",
        "The dense slabs with six orders, 30 000 (molecules) and 60 000 Monte Carlo samples "
        "(forward scatterers), for the gated estimator a tenth of them in each gate. With so few "
        "samples a rare large contribution increases both a mean and its standard error, and the "
        "z-scores have a negative skewness. Variances are therefore compared before this "
        "division.",
        tuple(rows),
        ((place.name, "z-scores of ten gates and 100 seeds about the mean over seeds."),),
    )


def rare_paths(effort):
    """The paper's scan with all orders: the rare ones make up 0.2 to 0.5 % of the signal."""
    size, samples = (219, 139), 256 * effort.scale
    table = str(files("lidar_mi.scenes") / "aerosol_spheroids_532nm.txt")
    phases = {"molecules": "rayleigh_polarized", "spheroids": {"type": "mueller", "table": table}}
    rows, scores = [], {}
    for number, (name, phase) in enumerate(phases.items()):
        shapes = {"slab": layer(490, 512, medium(1.8e-3, phase), ENVIRONMENT)}
        loaded = scene(
            (500, 502.5),
            shapes,
            size,
            integrator={"max_order": 4},
            environment=medium(1e-4, phase),
            **SCAN,
        )
        one, two = (render(loaded, 420 + 2 * number + k, samples) for k in (0, 1))
        difference = one["S0"] - two["S0"]
        stated = one["S0_stderr"] ** 2 + two["S0_stderr"] ** 2
        scores[name] = (difference / np.sqrt(stated)).ravel()
        # relative to a beam's own signal, so that all beams have the same weight
        weight = ((one["S0"] + two["S0"]) / 2) ** -2
        observed, expected = (weight * difference**2).ravel(), (weight * stated).ravel()
        ratio = observed.mean() / expected.mean()
        noise = (observed - ratio * expected).std() / math.sqrt(observed.size) / expected.mean()
        rows += [
            Row(
                f"{name}: variance of differences / stated",
                f"{observed.size} pairs of beams",
                1.0,
                ratio,
                noise,
            ),
            Row(
                f"{name}: mean difference over its standard error",
                "two seeds",
                0.0,
                difference.sum() / math.sqrt(stated.sum()),
                1.0,
            ),
        ]
    place = effort.folder / "z_scores_thin.png"
    _draw(place, scores)
    return Check(
        "Rare paths in a thin slab",
        f"The paper's scan with {samples} samples per beam, orders 1 to 4. Contributions of "
        "orders above one "
        "are rare and large. Differences of two seeds over all beams.",
        tuple(rows),
        ((place.name, "Differences of two seeds over their standard errors, 30 441 beams."),),
    )


CHECKS = (single_scattering, multiple_scattering, rare_paths)
