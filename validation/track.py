"""The track of a vortex pair, against simulated flights past lines in space."""

import math

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

from lidar_mi.retrieval.vortices.track import TrackSettings
from lidar_mi.retrieval.vortices.track_motion import STRAIGHT
from tests.support.flights import RADIUS, fit, flights, wakes_in_space, wakes_that_walk

from .report import Check, Comparison, Row

TITLE = "Vortex track"
INTRODUCTION = (
    "Flights past a wake in which 16 slabs, 7.5 m and 0.1 s apart, are fitted one by one and "
    "tracked. The pair at the wing is that of the second slab, two seconds after it was seen. "
    "Squares of innovations and of errors are normalised by what the filter states: chi-square, "
    "with the mean 1 per degree of freedom, if that is right."
)

FLIGHTS = 100
NOISE = 1.5
"""Of each wind vector, m/s, on a grid of 4 m."""
Y, Z = np.meshgrid(np.arange(-64.0, 65, 4), np.arange(-40.0, 41, 4))


def wind_of_lines(parameters, axis):
    """v + i w in the plane of a slab, of two straight lines along a unit vector, in space.

    Biot-Savart, Gamma/(2 pi) axis x r / (r^2 + core^2) with r across the axis.
    """
    speed = parameters[8] + 1j * parameters[9] + np.zeros(Y.shape)
    for first in (0, 4):
        away = np.stack([np.zeros(Y.shape), Y - parameters[first + 2], Z - parameters[first + 3]])
        away -= axis[:, None, None] * np.tensordot(axis, away, 1)
        spin = np.cross(axis, away, axisb=0).transpose(2, 0, 1)
        spin *= parameters[first] / (2 * np.pi) / ((away**2).sum(0) + RADIUS**2)
        speed += spin[1] + 1j * spin[2]
    return speed


def fitted_to_vectors(axis):
    """Least-squares fits (`scipy`) of a pair across the plane to noisy vectors of oblique lines."""

    def model(theta):
        speed = theta[8] + 1j * theta[9] + np.zeros(Y.shape)
        for circulation, log_radius, y, z in (theta[:4], theta[4:8]):
            away = Y - y + 1j * (Z - z)
            core = np.exp(2 * log_radius)
            speed += 1j * circulation / (2 * np.pi) * away / (np.abs(away) ** 2 + core)
        return np.concatenate([speed.real.ravel(), speed.imag.ravel()]) / NOISE

    def measure(random, truths):
        # the lidar looks along the path: the middle of its scan is that of the pair
        fits = []
        for truth in truths:
            centre = np.zeros(10)
            centre[[2, 6]], centre[[3, 7]] = truth[[2, 6]].mean(), truth[[3, 7]].mean()
            seen = wind_of_lines(truth - centre, axis)
            seen = np.concatenate([seen.real.ravel(), seen.imag.ravel()]) / NOISE
            seen += random.standard_normal(seen.shape)
            found = least_squares(lambda t, s=seen: model(t) - s, truth - centre, x_scale="jac")
            fits.append(fit(found.x + centre, np.linalg.inv(found.jac.T @ found.jac)))
        return fits

    return measure


def _axis(crossing, climb):
    return np.array(
        [
            math.cos(crossing) * math.cos(climb),
            math.sin(crossing),
            -math.cos(crossing) * math.sin(climb),
        ]
    )


def _rows(name, found, reference):
    """Means of normalised squares per degree of freedom, their distribution, and coverage."""
    rows = []
    for key, what, freedom in (
        ("innovations", "innovations", 10),
        ("state", "errors in the newest slab", found["freedom"]),
        ("arrival", "errors at the wing", 10),
    ):
        squares = np.array(found[key])
        sigma = math.sqrt(2 / freedom / squares.size)
        rows.append(
            Row(f"{name}: {what}, mean square", reference, 1.0, squares.mean() / freedom, sigma)
        )
        distance = kstest(squares, chi2(freedom).cdf).statistic
        # exceeded by 0.1 % of samples (Kolmogorov's limit)
        rows.append(
            Row(
                f"{name}: {what}, largest difference of the distribution",
                f"chi-square of {freedom}",
                0.0,
                distance,
                tolerance=1.95 / math.sqrt(squares.size),
            )
        )
    departures = np.abs(found["departures"])
    for limit, expected in ((1, 0.6827), (2, 0.9545)):
        inside = (departures < limit).mean(1)
        rows.append(
            Row(
                f"{name}: fraction within {limit} sigma at the wing",
                "normal",
                expected,
                inside.mean(),
                inside.std(ddof=1) / math.sqrt(len(inside)),
            )
        )
    return rows
