"""Winds of scans whose beams have times and poses of their own, against closed forms."""

from dataclasses import replace

import numpy as np
import xarray as xr

from lidar_mi.experiment.stages.ideal_images import ideal_scan
from lidar_mi.instrument.beams import Targets, steered_beams
from lidar_mi.instrument.motion import Pose, attitude
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.instrument.scan_timing import ScanTiming
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.synchronised import synchronised

from .report import Check, Row

TITLE = "Time and pose of beams"
INTRODUCTION = (
    "Winds retrieved by `multipass` from ideal images (no noise, beams without width) of random "
    "plane waves of 4 m and longer, advected by a uniform wind. 90 x 70 beams, 0.5 m apart in a "
    "slab 501.25 m away, scan it twice, 0.1 s apart, from an aircraft at rest in the frame of the "
    "gates. Numbers are means over all valid vectors; the tolerance of 0.03 m/s is the error that "
    "a texture leaves in a mean."
)

DT, DURATION, STEP = 0.1, 0.09, 0.5
Y, Z = (STEP * (np.arange(n) - (n - 1) / 2) for n in (90, 70))
WIND = np.array([6.0, 12.0])  # along y and z, m/s
TOLERANCE = 0.03
CORRELATED = 16
"""Px, over which vectors share their texture."""


def air(times, wind):
    """Extinction at times (s) on the nodes, dims (time, z, y); smooth, so that splines carry it."""
    random = np.random.default_rng(4)
    angle, length = 2 * np.pi * random.random(120), 4 + 8 * random.random(120)
    k = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
    phase = 2 * np.pi * random.random(120)
    states = []
    for time in times:
        y, z = Y[None, :, None] - wind[0] * time, Z[:, None, None] - wind[1] * time
        states.append(1 + 0.02 * np.cos(k[0] * y + k[1] * z + phase).sum(-1))
    nodes = {name: (name, axis, {"units": "m"}) for name, axis in (("z", Z), ("y", Y))}
    return xr.DataArray(np.stack(states), {"time": times, **nodes}, ("time", "z", "y"))


PATTERNS = {
    "raster": {},
    "serpentine": {},
    "serpentine in columns": {"slow": "columns"},
    "Lissajous": {"cycles": [57, 44]},
    "Risley prisms": {"cycles": [50, -23]},
}
"""Patterns of `ScanTiming`."""


def wind_of(told, wind=WIND, pattern="raster", duration=DURATION, missed=(0.0, 0.0, 0.0)):
    """Vectors of two scans; ``missed``: unknown roll, pitch, yaw (rad) of scan 2."""
    plan = plan_scans(Scan(range="500 m"), Y, Z, [0.0])[0]
    count = Y.size * Z.size
    name = pattern.split()[0].lower()
    timing = ScanTiming(pattern=name, duration=duration, **PATTERNS[pattern])
    schedule = timing.schedule(Y, Z, plan.centre)
    time, places = schedule.time, schedule.places
    states = np.linspace(-DURATION / 2, DURATION / 2, 37)
    scans = []
    for number, angles in enumerate(((0.0, 0.0, 0.0), missed)):
        still = np.zeros((count, 3))
        level, true = (
            Pose(still, still, attitude(*(np.full(count, a) for a in turned)))
            for turned in ((0.0, 0.0, 0.0), angles)
        )
        beams = steered_beams(Targets(time, places, plan.centre), 0.0, true, level)
        seen = air(states + (number - 0.5) * DT, wind).assign_coords(time=states)
        scans.append(ideal_scan(seen, replace(plan, beams=beams), gridded=False))
    scans = synchronised(scans, [DT], "Y")
    return retrieve_wind(
        *(scan["Y"] for scan in scans),
        DT,
        "multipass",
        windows=WindowSizes(stride=2),
        times=[scan["beam_time"] for scan in scans] if told else None,
        standard_errors=False,
    )


def means(found):
    valid = found["flag"] == 0
    return [float(found[name].where(valid).mean()) for name in ("v", "w")]


def duration(effort):
    """Air followed by a raster is met later, air against it earlier."""
    per_metre = DURATION / (Y.size * Z.size - 1) / STEP * np.array([1.0, Y.size])
    # row by row from the top left: against y and z
    longer = 1 / (1 + per_metre @ WIND)
    rows = []
    for told, expected, reference in (
        (True, WIND, "the wind"),
        (False, WIND * longer, "wind / (1 - g . wind), g the slope of the beams' times"),
    ):
        how = "times told" if told else "taken for photographs"
        for name, got, right in zip("vw", means(wind_of(told)), expected, strict=True):
            rows.append(Row(f"{name}, {how}", reference, right, got, 0.0, TOLERANCE, "m/s"))
    text = (
        "A raster of 0.09 s, row by row downwards. Air that moves up meets the downward scan "
        "earlier in image 2 than in image 1: the time between its two views is shorter. A "
        "retrieval that assumes instantaneous images finds it too slow."
    )
    return Check("Scan that lasts", text, tuple(rows))


def patterns(effort):
    """Every pattern: the wind of air that moves during its scan."""
    rows = []
    for pattern in PATTERNS:
        found = wind_of(True, pattern=pattern)
        independent = np.sqrt((found["flag"] == 0).sum() * found.stride**2 / CORRELATED**2)
        for name, right, got in zip("vw", WIND, means(found), strict=True):
            sigma = float(found[name].where(found["flag"] == 0).std() / independent)
            rows.append(Row(f"{name}, {pattern}", "the wind", right, got, sigma, TOLERANCE, "m/s"))
    text = (
        "The same in other patterns, all in 0.09 s. Curves that cross themselves see a place at "
        "several times, while the air moves by 2 px: their beams are carried with the air to one "
        "instant. Without that, the Lissajous figure finds 7.1 m/s in place of 6."
    )
    return Check("Every pattern", text, tuple(rows))


def pointing(effort):
    """Errors of pose from scan to scan are a wind."""
    yaw, pitch, roll = 0.6e-3, -0.4e-3, 4e-3
    distance, rest = 501.25, np.zeros(2)
    rows = []
    found = wind_of(True, rest, missed=(0.0, pitch, yaw))
    for name, angle, got in zip("vw", (yaw, pitch), means(found), strict=True):
        rows.append(
            Row(
                f"{name}, {'yaw' if name == 'v' else 'pitch'} of {1e3 * angle:g} mrad",
                "- range x angle / dt",
                -distance * angle / DT,
                got,
                0.0,
                TOLERANCE,
                "m/s",
            )
        )
    turned = wind_of(True, rest, missed=(roll, 0.0, 0.0))
    valid = (turned["flag"] == 0).values
    y, z = (part[valid] for part in np.meshgrid(turned["y"], turned["z"]))
    v, w = (turned[name].values[valid] for name in "vw")
    rate = float((w * y - v * z).sum() / (y**2 + z**2).sum())
    rows.append(
        Row(
            f"rotation, roll of {1e3 * roll:g} mrad",
            "- angle / dt",
            -roll / DT,
            rate,
            0,
            1e-3,
            "/s",
        )
    )
    text = "Air at rest, and a pose of scan 2 that differs from the reported one."
    return Check("Unknown pointing error", text, tuple(rows))


CHECKS = (duration, patterns, pointing)
