"""Receivers of the Doppler shift: published efficiencies, estimates, and what 0.5 m/s costs."""

import math

import numpy as np
import torch
from scipy import constants
from scipy.optimize import minimize, minimize_scalar

from lidar_mi.experiment import receivers
from lidar_mi.experiment.stages.ring_instrument import air_rings
from lidar_mi.instrument.doppler import DopplerLidar, photons
from lidar_mi.instrument.double_edge import DoubleEdge
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.michelson import Michelson
from lidar_mi.retrieval.channels.assumption import assumption_error
from lidar_mi.retrieval.channels.bound import cramer_rao
from lidar_mi.retrieval.channels.fit import fit_channels
from lidar_mi.retrieval.channels.model import mean_and_jacobian, parameter_vector
from lidar_mi.retrieval.rings.bound import cramer_rao as ring_bound
from lidar_mi.retrieval.rings.model import PixelNoise

from . import figures
from .report import Check, Comparison, Row

TITLE = "Receivers"
INTRODUCTION = (
    "Analysers of the Doppler shift behind the same telescope: rings of a Fabry-Perot etalon, "
    "straight fringes of a Michelson interferometer, two Fabry-Perot filters on the flanks of the "
    "line (double edge), and an ideal spectral analyser, which detects every photon with its "
    "frequency. All get the same photons, counted in front of them."
)

REQUIRED, SPEED, RANGES, AEROSOL = 0.5, 50.0, (56.0, 76.0, 150.0), (0.0, 0.1, 0.5)
"""m/s, m/s, m, fractions of the backscattered photons."""
PRIOR = {"temperature": 5.0, "aerosol": 0.05}
BINNED = FringeCamera(width=240, height=195, pixel=4 * 7.4e-6)
# nearly one Gaussian, as published figures take it
GAUSSIAN = DopplerLidar(line_shape="rayleigh", laser_width=45e6)


def _photon_noise(receiver):
    return receiver._replace(noise=PixelNoise())


def _relative(receiver, lidar, v_los=0.0):
    """Standard error over that of the ideal analyser, photon noise alone."""
    error = receivers.standard_error(_photon_noise(receiver), v_los)
    return error / receivers.ideal_error(lidar)


def _fringes(path, **changes):
    interferometer = Michelson(path_difference=path, contrast=1.0, elements=256, **changes)
    return receivers.michelson_receiver(GAUSSIAN, interferometer)


def _first_harmonic(path):
    """Relative standard error of the phase of the fringes' first Fourier component.

    By error propagation, for a fringe in any phase: the weights are the cosine in quadrature.
    """
    receiver = _fringes(path)
    truth = parameter_vector(receiver.channels, level=receiver.level)
    mean, jacobian = mean_and_jacobian(receiver.channels, truth)
    weight = jacobian[0, 0]
    error = (weight**2 * mean[0]).sum().sqrt() / (weight * jacobian[0, 0]).sum()
    return float(error) / receivers.ideal_error(GAUSSIAN)


def edges(width, spacing, **changes):
    """Filters without defects of a full width and a spacing, GHz; 12 GHz from order to order."""
    sine = math.sin(math.pi * width / 12 / 2)
    b = 1 + 2 * sine**2
    etalon = Etalon(
        gap=constants.c / 24e9,
        reflectivity=b - math.sqrt(b**2 - 1),
        order_fraction=None,
        surface_rms=0,
    )
    filters = DoubleEdge(etalon=etalon, spacing=spacing * 1e9, field_half_angle=0, **changes)
    return receivers.double_edge_receiver(GAUSSIAN, filters)


def published(effort):
    """Efficiencies that others have derived for a Gaussian line and photon noise."""
    sigma = 2 / GAUSSIAN.wavelength * math.sqrt(constants.R * 232.94 / 28.9644e-3)
    sigma = math.hypot(sigma, 45e6 / math.sqrt(8 * math.log(2)))
    closed = GAUSSIAN.wavelength / 2 * sigma / math.sqrt(photons(GAUSSIAN))

    def optimum(relative):
        return minimize_scalar(relative, bounds=(0.01, 0.08), method="bounded")

    harmonic, likelihood = (
        optimum(f) for f in (_first_harmonic, lambda x: _relative(_fringes(x), GAUSSIAN))
    )
    time = likelihood.x / constants.c
    visibility = math.exp(-2 * (math.pi * time * sigma) ** 2)
    fringe = 1 / (2 * math.pi * time * sigma * math.sqrt(1 - math.sqrt(1 - visibility**2)))
    filters = minimize(
        lambda x: _relative(edges(*x), GAUSSIAN), (1.5, 4.4), method="Nelder-Mead", tol=1e-3
    )
    lidar = DopplerLidar()
    rings = receivers.ring_receiver(lidar, Etalon(), BINNED)
    light = rings.level * receivers.detected_fraction(rings)
    theirs = ring_bound(air_rings(lidar, Etalon(), BINNED), light, rings.noise, v_los=SPEED)
    free = ("v_los", "level", "temperature")
    bruneau, mckay = "Bruneau 2002", "McKay 1998"
    rows = (
        Row(
            "ideal analyser: standard error of one pulse at 56 m",
            "(lambda / 2) sigma / N^(1/2)",
            closed,
            receivers.ideal_error(GAUSSIAN),
            tolerance=1e-5,
            unit="m/s",
        ),
        Row(
            "straight fringes, first harmonic: best path difference",
            bruneau,
            0.03,
            harmonic.x,
            tolerance=0.005,
            unit="m",
        ),
        Row(
            "straight fringes, first harmonic: times the ideal error",
            bruneau,
            2.3,
            harmonic.fun,
            tolerance=0.05,
        ),
        Row(
            "straight fringes, maximum likelihood: times the ideal error",
            "1 / (2 pi t sigma (1 - (1 - V^2)^(1/2))^(1/2))",
            fringe,
            likelihood.fun,
            tolerance=1e-3,
        ),
        Row(
            "double edge, best width and spacing: times the ideal error",
            mckay,
            2.5,
            filters.fun,
            tolerance=0.05,
        ),
        Row(
            "rings: times the ideal error",
            f"{mckay}: 2 to 4",
            3.0,
            _relative(receivers.ring_receiver(GAUSSIAN, Etalon(), BINNED), GAUSSIAN),
            tolerance=1.0,
        ),
        Row(
            "rings as annuli: standard error over that of `rings.bound.cramer_rao`",
            "the same rings, pixel by pixel, with unknown centre",
            1.0,
            receivers.standard_error(rings, SPEED, free) / theirs["v_los"],
            tolerance=0.005,
        ),
    )
    return Check(
        "Published efficiencies",
        "A Gaussian line (molecules at 233 K), photon noise, no defects. The phase of the first "
        "harmonic is what published figures of fringe imagers refer to; maximum likelihood "
        "weights bright elements less. The double edge is optimised at a free spectral range of "
        "12 GHz; its factor falls to 2.39 for a much larger one.",
        rows,
    )


def estimates(effort):
    """Standard deviation and coverage of fitted speeds, with all noise."""
    lidar = DopplerLidar(range=150.0, aerosol_fraction=0.1)
    number = 4000 * effort.scale
    rows = []
    for name, receiver, free in (
        (
            "Michelson, contrast unknown",
            receivers.michelson_receiver(lidar, Michelson()),
            ("v_los", "level", "aerosol"),
        ),
        ("double edge", receivers.double_edge_receiver(lidar, DoubleEdge()), ("v_los", "level")),
    ):
        channels, noise, level, aerosol = receiver
        truth = parameter_vector(channels, SPEED, level, aerosol=aerosol)
        mean = mean_and_jacobian(channels, truth)[0].numpy()
        rng = np.random.default_rng(81)
        background = channels.background.numpy()
        light = (mean - background) * rng.gamma(
            noise.speckle_modes, 1 / noise.speckle_modes, (number, mean.shape[1])
        )
        counts = rng.poisson(light + background)
        counts = counts + noise.read_noise * rng.standard_normal(counts.shape)
        fit = fit_channels(torch.from_numpy(counts), channels, noise, free=free, aerosol=aerosol)
        bound = cramer_rao(channels, level, noise, v_los=SPEED, aerosol=aerosol, free=free)
        error = (fit.v_los - SPEED).numpy()
        z = np.abs(error) / fit.v_los_std.numpy()
        reference = f"{number} exposures at 150 m"
        rows += [
            Row(
                f"{name}: standard deviation over the bound",
                reference,
                1.0,
                error.std() / bound["v_los"],
                1 / math.sqrt(2 * number),
            ),
            Row(
                f"{name}: mean error over the bound",
                reference,
                0.0,
                error.mean() / bound["v_los"],
                1 / math.sqrt(number),
            ),
        ]
        rows += [
            Row(
                f"{name}: within {width:g} standard errors",
                "normal distribution",
                expected,
                (z < width).mean(),
                math.sqrt(expected * (1 - expected) / number),
            )
            for width, expected in ((1.0, 0.6827), (1.96, 0.95))
        ]
    return Check(
        "Estimates and their standard errors",
        "Fits of signals with photon noise, speckle and read noise; 10 % of the photons from "
        "aerosol.",
        tuple(rows),
    )


def _compared(lidar):
    """Name and receiver of every line of the comparison."""
    wide = {"field_half_angle": "2.8 mrad"}
    rings = receivers.ring_receiver(lidar, Etalon(), FringeCamera())
    detected = receivers.detected_fraction(rings)
    return {
        "rings": rings,
        "rings, pixels binned 4 x 4": receivers.ring_receiver(lidar, Etalon(), BINNED),
        "rings, all photons detected": rings._replace(level=rings.level / detected),
        "Michelson, both outputs": receivers.michelson_receiver(lidar, Michelson()),
        "Michelson, one output": receivers.michelson_receiver(lidar, Michelson(outputs=1)),
        "double edge": receivers.double_edge_receiver(lidar, DoubleEdge()),
        "double edge, etalons of 0.1 m": receivers.double_edge_receiver(lidar, DoubleEdge(**wide)),
        "double edge, in sequence": receivers.double_edge_receiver(
            lidar, DoubleEdge(arrangement="sequential")
        ),
    }


def _digits(value):
    """Two, or three from 1 on, without an exponent."""
    digits = 3 if value >= 1 else 2
    return np.format_float_positional(value, digits, unique=False, fractional=False, trim="-")


def _line(name, aerosol, near, lidars):
    """One line of the comparison: the receiver at all ranges, its assumptions at the first."""
    channels, noise, level, _ = near[0]
    energies = [receivers.required_energy(r, REQUIRED, SPEED) for r in near]
    errors = [receivers.standard_error(r, SPEED) for r in near]
    wrong = [
        assumption_error(
            channels, level, noise, assumed=assumed, by=by, v_los=SPEED, aerosol=aerosol
        )
        for assumed, by in PRIOR.items()
    ]
    free = ("v_los", "level", *PRIOR)
    unknown = receivers.standard_error(near[0], SPEED, free, PRIOR) / errors[0]
    return (
        f"{100 * aerosol:.0f} %",
        name,
        f"{100 * receivers.detected_fraction(near[0]) * level / photons(lidars[0]):.0f} %",
        _digits(_relative(near[0], lidars[0], SPEED)),
        " / ".join(map(_digits, errors)),
        " / ".join(f"{math.ceil((e / REQUIRED) ** 2)}" for e in errors),
        " / ".join(_digits(1e3 * e * lidars[0].pulse_energy) for e in energies),
        *(f"{abs(w):.2f}" if abs(w) >= 0.005 else "0" for w in wrong),
        f"{unknown:.2f}",
    )


def _ideal_line(aerosol, lidars):
    errors = [receivers.ideal_error(lidar) for lidar in lidars]
    energies = [1e3 * lidars[0].pulse_energy * (e / REQUIRED) ** 2 for e in errors]
    return (
        f"{100 * aerosol:.0f} %",
        "ideal spectral analyser",
        "100 %",
        "1",
        " / ".join(map(_digits, errors)),
        " / ".join(f"{math.ceil((e / REQUIRED) ** 2)}" for e in errors),
        " / ".join(map(_digits, energies)),
        "0",
        "0",
        "1.00",
    )


def _draw(place):
    """Standard error against range, without and with aerosol."""
    ranges = np.geomspace(40, 500, 10)
    styles = {
        "rings": ("C0", "-"),
        "rings, pixels binned 4 x 4": ("C0", "--"),
        "rings, all photons detected": ("C0", ":"),
        "Michelson, both outputs": ("C1", "-"),
        "double edge": ("C2", "-"),
        "double edge, etalons of 0.1 m": ("C2", ":"),
        "double edge, in sequence": ("C2", "--"),
    }
    with figures.figure(place, (9.5, 3.8), columns=2, sharey=True) as axes:
        for axis, aerosol in zip(axes, AEROSOL[:2], strict=True):
            lidars = [DopplerLidar(range=r, aerosol_fraction=aerosol) for r in ranges]
            found = [_compared(lidar) for lidar in lidars]
            for name, (colour, style) in styles.items():
                errors = [receivers.standard_error(one[name], SPEED) for one in found]
                axis.loglog(ranges, errors, style, color=colour, label=name)
            ideal = [receivers.ideal_error(lidar) for lidar in lidars]
            axis.loglog(ranges, ideal, color=figures.REFERENCE, label="ideal spectral analyser")
            axis.axhline(REQUIRED, color="0.7", linewidth=0.8)
            axis.set(
                xlabel="range, m",
                title="clean air" if aerosol == 0 else f"{100 * aerosol:.0f} % aerosol",
                xticks=(50, 100, 200, 500),
                xticklabels=("50", "100", "200", "500"),
                ylim=(3e-3, 60),
            )
            axis.minorticks_off()
        axes[0].set(ylabel="standard error of one pulse, m/s")
        axes[1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))


def cost(effort):
    """What each receiver needs for 0.5 m/s."""
    lines = []
    for aerosol in AEROSOL:
        lidars = [DopplerLidar(range=r, aerosol_fraction=aerosol) for r in RANGES]
        at_ranges = [_compared(lidar) for lidar in lidars]
        lines.append(_ideal_line(aerosol, lidars))
        lines += [
            _line(name, aerosol, [one[name] for one in at_ranges], lidars) for name in at_ranges[0]
        ]
    near, far = (
        receivers.standard_error(
            receivers.michelson_receiver(DopplerLidar(range=r), Michelson()), SPEED
        )
        for r in (56.0, 150.0)
    )
    row = Row(
        "Michelson: standard error at 150 m over that at 56 m",
        "(r2 / r1) exp(alpha (r2 - r1)), photon noise alone; the rest is speckle's",
        150 / 56 * math.exp(2.7e-5 * 94),
        far / near,
        tolerance=0.1,
    )
    place = effort.folder / "receivers.png"
    _draw(place)
    heads = (
        "aerosol",
        "receiver",
        "light detected",
        "times the ideal error",
        "standard error of a pulse, m/s",
        "pulses for 0.5 m/s",
        "energy of one pulse for 0.5 m/s, mJ",
        "error by 5 K, m/s",
        "error by 0.05 aerosol, m/s",
        "both unknown: times the error",
    )
    return Check(
        "Cost of 0.5 m/s",
        "Cramér-Rao bounds at 56 / 76 / 150 m for the default lidar (70 mJ, 8500 m) and CCD (5 "
        "electrons rms per pixel or element), v_LOS = 50 m/s. N = 2.4e7 / 1.3e7 / 3.3e6 photons "
        "reach every receiver; *aerosol* is a fraction of them. *Rings, all photons detected*: N "
        "photons reach the CCD, and 5.6 times as many the etalon (elsewhere in this documentation "
        "the paper's photon numbers are those on the "
        "CCD). *Times the ideal error*: error by the photon noise of N photons alone, over that "
        "of the ideal analyser, which is the only one here that resolves the narrow line of the "
        "aerosol. *Pulses* are averaged, or their energies added in one pulse of that "
        "*energy*. *Error by*: bias of a fit of speed and level if the assumed temperature is 5 "
        "K, or the assumed aerosol 5 % of the photons, too "
        "high. *Both unknown*: temperature and aerosol are fitted as well, with prior standard "
        "errors of 5 K and 0.05; a double edge determines neither. The double edge is "
        "collimated to 1 mrad, which takes etalons of 0.28 m behind this telescope (0.41 m, 0.7 "
        "mrad at 56 m); etalons of 0.1 m have 2.8 mrad. Rings and the fringes of a field- "
        "widened Michelson take such light. Saturation is not included: 1e6 photons in one "
        "channel would exceed the full well of a pixel.",
        (row,),
        (
            (
                place.name,
                "Standard error of one pulse of 70 mJ (lines: bounds; grey: ideal and 0.5 m/s).",
            ),
        ),
        comparison=Comparison(heads, tuple(lines)),
    )


CHECKS = (published, estimates, cost)
