"""Vortices from slices of a Doppler lidar, on families of wakes that the fit was not built on."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidar_mi.retrieval.ground_vortices.detection import detect
from lidar_mi.retrieval.ground_vortices.fit import Assumptions
from lidar_mi.retrieval.ground_vortices.radial_velocities import by_radial_velocities
from lidar_mi.retrieval.ground_vortices.scan_plane import plane_scans
from lidar_mi.retrieval.ground_vortices.vortices import fit_vortices_to_lines, lidar_of
from tests.support.line_wakes import START, Drawn, Family, averaging, drawn, drawn_from, slices

from .report import Check, Comparison, Row

TITLE = "Vortices from lines of sight"
INTRODUCTION = (
    "Slices (RHI, 3 degrees a second) of a pulsed lidar, gates of 30 m every 15 m, beside wakes "
    "550 to 850 m away in frozen turbulence of von Karman's spectrum; noise of the Cramér-Rao "
    "bound. Wakes are drawn anew for every seed. Constants were chosen on other families."
)

SCANS = 60
AIR_SCANS = 60
FIRST_SEED = 50_000
FIRST_OF_AIR = 55_000

SIMULATED = Path(__file__).resolve().parents[1] / "scenes" / "wake_volume_40s.nc"
SMALL = Family(circulations=(-150.0, 150.0), core_radii=(1.6, 1.6), separation=28.0)
AVERAGED = Family(sigma=0.35, length=60.0, rate=4.0)
GROUND = Family(sigma=0.4, length=40.0, ground=-1.5, heights=(22.0, 45.0))
FAMILIES: dict[str, tuple[Family, dict]] = {
    "0.1 m/s, 60 m": (Family(sigma=0.1, length=60.0), {}),
    "0.35 m/s, 60 m": (Family(sigma=0.35, length=60.0), {}),
    "0.7 m/s, 120 m": (Family(sigma=0.7, length=120.0), {}),
    "1.2 m/s, 200 m": (Family(sigma=1.2, length=200.0), {}),
    "Burnham-Hallock, fitted as Lamb-Oseen": (
        Family(sigma=0.35, length=60.0, profile="burnham_hallock"),
        {},
    ),
    "28 m, 150 m²/s": (replace(SMALL, sigma=0.25, length=90.0), {}),
    "weak signal": (Family(sigma=0.25, length=90.0, snr=0.012), {}),
    "one vortex": (
        Family(circulations=(350.0,), core_radii=(3.5,), sigma=0.35, length=60.0),
        {"kind": "single"},
    ),
    "near the ground": (GROUND, {"ground": -1.5}),
    "pulses and gates of 60 m, 4°/s": (replace(AVERAGED, lidar=averaging(60.0)), {}),
    "pulses and gates of 90 m, 4°/s": (replace(AVERAGED, lidar=averaging(90.0)), {}),
    "simulated wake": (Family(sigma=0.2), {}),
}
INNER = ("Burnham-Hallock, fitted as Lamb-Oseen", "simulated wake")
"""Of which the circulation from 5 to 15 m is compared: what a profile extrapolates is not known."""
AIRS = {
    "0.1 m/s, 60 m": Family(sigma=0.1, length=60.0),
    "0.35 m/s, 60 m": Family(sigma=0.35, length=60.0),
    "1.2 m/s, 200 m": Family(sigma=1.2, length=200.0),
    "weak signal": Family(sigma=0.25, length=90.0, snr=0.006),
}


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors (scans, vortices, 3) of y, z and circulation over all scans with a valid fit.

    Attributes
    ----------
    error, stderr, peer : (scans, vortices, 3) arrays
        Of the fit, as stated, of the method of radial velocities.
    circulation : (scans, vortices) array
        As it is.
    valid, scans : int
    """

    error: np.ndarray
    stderr: np.ndarray
    peer: np.ndarray
    circulation: np.ndarray
    valid: int
    scans: int


def wake(name: str, seed: int) -> Drawn:
    """One of a family."""
    if name == "simulated wake":
        return drawn_from(SIMULATED, seed)
    family = FAMILIES[name][0]
    return drawn(family, seed, slices(0.0, 10.0) if family.ground is not None else None)


def measured(name: str, seeds) -> Measured:
    """Fits and peer of a family."""
    family, options = FAMILIES[name]
    inner = name in INNER
    errors, stderrs, peers, strengths = [], [], [], []
    for seed in seeds:
        one = wake(name, seed)
        found = fit_vortices_to_lines(one.lines, **options).isel(scan=0)
        if int(found["flag"]):
            continue
        strength = one.circulations
        if inner and family.profile == "burnham_hallock":
            # mean of r^2 / (r^2 + r_c^2) over 5 to 15 m
            core = one.core_radii
            strength = strength * (1 - core / 10 * (np.arctan(15 / core) - np.arctan(5 / core)))
        truth = np.column_stack([one.at(found["time"].values), strength])
        keys = "y", "z", "circulation_5_15" if inner else "circulation"
        errors.append(np.stack([found[k].values for k in keys], -1) - truth)
        stderrs.append(np.stack([found[f"{k}_stderr"].values for k in keys], -1))
        peers.append(_peer(one, family, options))
        strengths.append(strength)
    return Measured(
        *(np.array(part) for part in (errors, stderrs, peers, strengths)), len(errors), len(seeds)
    )


def _peer(one: Drawn, family: Family, options: dict) -> np.ndarray:
    """Errors of the method of radial velocities, each vortex when its line passes; NaN: none."""
    (scan,), _ = plane_scans(one.lines, None)
    lidar = lidar_of(one.lines, None, None)
    given = Assumptions(ground=options.get("ground"), core_radius=family.core_radii[0])
    guess = detect(scan, lidar, given, single=len(family.circulations) == 1).candidates[0]
    found = by_radial_velocities(scan, lidar, given, guess.vortices)
    if found is None:
        return np.full((len(one.circulations), 3), np.nan)
    angles = np.arctan2(found[:, 1], found[:, 0])
    times = np.interp(angles, scan.angle, scan.time)
    moments = [START + np.timedelta64(round(1e9 * t), "ns") for t in times]
    places = np.array([one.at(moment)[k] for k, moment in enumerate(moments)])
    return found - np.column_stack([places, one.circulations])


def families(effort) -> Check:
    """Errors, coverage, and the method of radial velocities on the same scans."""
    seeds = range(FIRST_SEED, FIRST_SEED + SCANS * effort.scale)
    lines, rows = [], []
    for name, (family, _) in FAMILIES.items():
        one = measured(name, seeds)
        normal = np.abs(one.error / one.stderr)
        inside = [float((normal < limit).mean()) for limit in (1.0, 1.96)]
        numbers = [
            (
                100 * float(np.nanmedian(np.abs(error[..., 2] / one.circulation))),
                100
                * float(np.nanmedian(np.hypot(error[..., 0], error[..., 1])))
                / family.separation,
            )
            for error in (one.error, one.peer)
        ]
        lines.append(
            (
                name,
                f"{one.valid} of {one.scans}",
                *(f"{value:.1f}" for value in numbers[0]),
                *(f"{value:.1f}" for value in numbers[1]),
                *(f"{100 * value:.0f}" for value in inside),
                f"{100 * float((normal[..., 2] < 1.96).mean()):.0f}",
            )
        )
        for value, share in zip(inside, (0.683, 0.95), strict=True):
            # errors of one scan are of the same air
            sigma = np.sqrt(share * (1 - share) / one.valid)
            rows.append(Row(f"{name}, within {share:.1%}", "as stated", share, value, sigma, 0.02))
    heads = (
        "family",
        "valid",
        "circulation, %",
        "place, % of b",
        "RV: circulation, %",
        "RV: place, % of b",
        "in 68 %",
        "in 95 %",
        "circulation in 95 %",
    )
    text = (
        "Medians of the errors; of Burnham-Hallock's vortices and of the simulated ones the mean "
        "circulation from 5 to 15 m, else the whole; place relative to the separation (of one "
        "vortex, 47 m). RV: method of radial velocities with the true core radius, on the same "
        "scans. Coverage of y, z and circulation together, and of the circulation."
    )
    return Check("Wakes", text, tuple(rows), comparison=Comparison(heads, tuple(lines)))


def false_alarms(effort) -> Check:
    """Scans of air without a wake in which one is found."""
    number = AIR_SCANS * effort.scale
    lines, rows = [], []
    limits = 0.01, 0.05, 0.2
    for name, family in AIRS.items():
        for single in (False, True):
            chances = []
            for seed in range(FIRST_OF_AIR, FIRST_OF_AIR + number):
                one = drawn(family, seed, wake=False)
                (scan,), _ = plane_scans(one.lines, None)
                lidar = lidar_of(one.lines, None, None)
                chances.append(detect(scan, lidar, Assumptions(), single=single).false_alarm)
            rates = [float((np.array(chances) < limit).mean()) for limit in limits]
            kind = "one vortex" if single else "pair"
            lines.append((name, kind, *(f"{100 * rate:.1f}" for rate in rates)))
            # a rate below the limit is as stated: "at most"
            sigma = np.sqrt(0.05 * 0.95 / number)
            rows.append(
                Row(f"{name}, {kind}", "at most 0.05", 0.05, max(rates[1], 0.05), float(sigma))
            )
    heads = ("air", "searched for", "1 %: found in %", "5 %", "20 %")
    text = f"{number} scans each of turbulence alone."
    return Check("False alarms", text, tuple(rows), comparison=Comparison(heads, tuple(lines)))


CHECKS = (families, false_alarms)
