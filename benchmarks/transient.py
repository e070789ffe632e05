"""The renderer against mitransient's volumetric integrator, single scattering, homogeneous air.

The same air for both: vacuum up to 1 m, the environment behind it, in it a slab from 485 to 515 m,
Rayleigh scattering, unpolarised (``llvm_ad_mono``); one time gate of 500 to 502.5 m range. The slab
is thicker than the gate, so that both see the gate filled everywhere.

mitransient traces paths from a pinhole camera (``perspective``) through ``transient_hdr_film``;
light is from a point emitter at the same place. A pixel's solid angle is the field of view: with an
intensity of 1 W/sr its radiance times the telescope's area is the energy received by a lidar that
emits 1 J into that field of view. All its rays are in illuminated air, unlike rays off the axis of
a real laser beam. Paths scatter in the gate only by chance, which costs efficiency. Both values are
compared with the lidar equation.
"""

import gc
import math
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from lidar_mi.rendering.variant import use_variant

from .measure import fresh_process, in_turns
from .report import Comparison, missing, row

VARIANT = "llvm_ad_mono"
GATE = (500.0, 502.5)
SLAB = (485.0, 515.0)
AIR = (1.0, 600.0)
PEAK, ENVIRONMENT = 1.8e-3, 1e-4
APERTURE_RADIUS = 0.5
FOV_HALF = 5e-3
# half angle of the scan across; rows follow with square pixels
SCAN_TAN = math.tan(math.radians(6.2))
NOISE = 0.01
# longer renders are timed with this many samples and scaled
LONGEST = 1 << 22


def compare(repeats: int = 5, columns: int = 219, rows: int = 139, samples: int = 64) -> Comparison:
    """Noise, time and error of both; ``samples`` per beam, for the measurement of the noise."""
    title = f"Single scattering against mitransient, one gate, {NOISE:.0%} standard error"
    sides = ("lidar-mi", "mitransient")
    if reason := missing("mitransient"):
        return Comparison(title, *sides, reason=reason)
    use_variant(VARIANT)
    lines = []
    with fresh_process() as peer:
        peer.submit(_start_peer).result()
        for name, extinction in (("peak", PEAK), ("environment", ENVIRONMENT)):
            case = f"slab at {name} extinction, {1e3 * extinction:.1f} / km"
            lines += _case(case, peer, extinction, repeats, columns, rows, samples)
    return Comparison(
        title,
        *sides,
        tuple(lines),
        (
            (
                f"Same air, gate ({GATE[0]:g} to {GATE[1]:g} m), phase function, {VARIANT}; "
                "separate processes take turns. Differences: lidar-mi has a laser of 2 mrad "
                "and a telescope of 0.5 m radius in a field of view of 5 mrad; mitransient a "
                "point emitter and a pinhole at the same place, a pixel being the field of view "
                "(10 mrad for the single beam, 1 mrad in the scan), so that none of its rays "
                "misses the light."
            ),
            (
                "Scan: lidar-mi renders all beams at once as a lidar; mitransient renders all "
                "pixels at once as a flash lidar, which equals a scan for single scattering only."
            ),
            (
                "mitransient times are scaled linearly from renders of "
                f"{LONGEST:,} samples (single beam) and {samples} samples per pixel (scan) where "
                "1 % requires more."
            ),
            (
                "mitransient fills all its time bins with one render: for a profile of G gates "
                "divide the ratios by G. Homogeneous air only: its time of flight is wrong in "
                "heterogeneous media. There gated samples of lidar-mi vary more, see the "
                "estimators."
            ),
        ),
    )


class _Scan(NamedTuple):
    """Both sides' scans: relative variance of a sample, seconds, value over the lidar equation."""

    variance: tuple[float, float]
    sample_seconds: tuple[list[float], list[float]]
    need_seconds: list[float]
    value: tuple[float, float]


def _case(case, peer, extinction, repeats, columns, rows, samples):
    beams = columns * rows
    scan = _scans(peer, extinction, repeats, columns, rows, samples)
    variance, other_variance = scan.variance
    need, other_need = _enough(variance), other_variance / NOISE**2
    at_once = min(math.ceil(other_need), LONGEST)
    seconds, other_seconds, lone = _beams(peer, extinction, repeats, need, at_once)

    # the error of mitransient, from the mean of all its samples
    weights = beams * samples, at_once
    value, other_value = scan.value[0], np.average([scan.value[1], lone], weights=weights)
    error = math.sqrt(variance / (beams * samples * repeats))
    other_error = math.sqrt(other_variance / (sum(weights) * repeats))
    time, other_time = scan.sample_seconds
    return [
        row(
            case,
            "value / lidar equation - 1",
            "%",
            [100 * (value - 1)],
            [100 * (other_value - 1)],
            note=f"+- {100 * error:.2g} and {100 * other_error:.2g}",
        ),
        row(case, "relative variance of one sample", "", [variance], [other_variance], "lower"),
        row(
            case,
            "samples per beam for 1 %",
            "",
            [need],
            [other_need],
            "lower",
            "lidar-mi: at least 2",
        ),
        row(
            case,
            "time of one sample in a scan",
            "ns",
            [1e9 * t for t in time],
            [1e9 * t for t in other_time],
            "lower",
        ),
        row(
            case,
            "variance x time of one sample",
            "ns",
            [1e9 * variance * t for t in time],
            [1e9 * other_variance * t for t in other_time],
            "lower",
            "ratio of efficiencies",
        ),
        row(
            case,
            "one beam to 1 %",
            "s",
            seconds,
            [t * other_need / at_once for t in other_seconds],
            "lower",
            "lidar-mi: time to launch a kernel",
        ),
        row(
            case,
            f"scan of {beams} beams to 1 %",
            "s",
            scan.need_seconds,
            [t * other_need * beams for t in other_time],
            "lower",
        ),
    ]


def _scans(peer, extinction, repeats, columns, rows, samples) -> _Scan:
    """All beams with ``samples`` each, ours also with as many as 1 % requires."""
    beams = columns * rows
    truth = lidar_equation(extinction, scan_directions(columns, rows)[:, 0])
    scene = _our_scene(extinction, columns, rows)
    peer.submit(_load_peer, extinction, columns, rows).result()

    def render(count):
        return lambda turn: np.array(mi.render(scene, spp=count, seed=turn), float).reshape(-1, 5)

    def render_peer(turn):
        return peer.submit(_render_peer, samples, turn).result()

    found = in_turns({"ours": render(samples), "theirs": render_peer}, repeats)
    images = [image for _, image in found["ours"]]
    values = [image.ravel() / truth for _, image in found["theirs"]]
    variance = np.mean([(image[:, 4] / truth) ** 2 for image in images]) * samples
    enough = in_turns({"ours": render(_enough(variance))}, repeats)["ours"]
    return _Scan(
        (variance, np.var(values, ddof=1) * samples),
        tuple([s / (beams * samples) for s, _ in found[side]] for side in ("ours", "theirs")),
        [seconds for seconds, _ in enough],
        (np.mean([image[:, 0] / truth for image in images]), np.mean(values)),
    )


def _beams(peer, extinction, repeats, our_samples, samples):
    """Seconds of a single beam on both sides, and mitransient's value over the lidar equation."""
    gc.collect()  # live scenes enter each other's kernels
    scene = _our_scene(extinction, 1, 1)
    peer.submit(_load_peer, extinction, 1, 1).result()
    found = in_turns(
        {
            "ours": lambda turn: np.array(mi.render(scene, spp=our_samples, seed=turn)),
            # other seeds: lanes of equal number and seed have the same random numbers in any render
            "theirs": lambda turn: peer.submit(_render_peer, samples, 1000 + turn).result(),
        },
        repeats,
    )
    truth = lidar_equation(extinction, np.ones(1))
    value = np.mean([image.ravel() / truth for _, image in found["theirs"]])
    return *([seconds for seconds, _ in found[side]] for side in ("ours", "theirs")), value


def _enough(variance: float) -> int:
    """Samples for the required noise; a standard error requires two."""
    return max(2, math.ceil(variance / NOISE**2))


def scan_directions(columns: int, rows: int) -> np.ndarray:
    """Unit vectors through the pixel centres of a square-pixel camera, top left first."""
    pixel = 2 * SCAN_TAN / columns
    y = (np.arange(columns)[::-1] - (columns - 1) / 2) * pixel
    z = (np.arange(rows)[::-1] - (rows - 1) / 2) * pixel
    vertical, lateral = np.meshgrid(z, y, indexing="ij")
    beams = np.stack([np.ones_like(lateral), lateral, vertical], -1).reshape(-1, 3)
    return beams / np.linalg.norm(beams, axis=1, keepdims=True)


def lidar_equation(extinction: float, cosine: np.ndarray) -> np.ndarray:
    """Received over emitted energy, single scattering: A integral of beta T^2 / r^2 over the gate.

    ``cosine`` is between the beam and the normal of the slab. Rayleigh: beta = 3 / (8 pi) of the
    extinction at 180 degrees.
    """
    edges = np.linspace(*GATE, 257)
    r = (edges[1:] + edges[:-1])[:, None] / 2
    outside, inside = AIR[0] / cosine, SLAB[0] / cosine
    depth = ENVIRONMENT * (inside - outside) + extinction * (r - inside)
    mean = (np.exp(-2 * depth) / r**2).mean(axis=0)
    area = math.pi * APERTURE_RADIUS**2
    return area * extinction * 3 / (8 * math.pi) * mean * (GATE[1] - GATE[0])


def _air(extinction: float) -> dict:
    def medium(sigma_t):
        return {
            "type": "homogeneous",
            "sigma_t": sigma_t,
            "albedo": 1.0,
            "phase": {"type": "rayleigh"},
        }

    def box(near, far):
        place = mi.ScalarTransform4f().translate([(near + far) / 2, 0, 0])
        return {
            "type": "cube",
            "to_world": place.scale([(far - near) / 2, 200, 200]),
            "bsdf": {"type": "null"},
        }

    environment = {"type": "ref", "id": "environment"}
    return {
        "environment": medium(ENVIRONMENT),
        "air": {**box(*AIR), "interior": environment},
        "slab": {**box(*SLAB), "interior": medium(extinction), "exterior": environment},
    }


def _our_scene(extinction: float, columns: int, rows: int):
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "gated_volpath"},
            "sensor": {
                "type": "scanning_lidar",
                "aperture_radius": APERTURE_RADIUS,
                "fov_half_mrad": 1e3 * FOV_HALF,
                "gate_kind": "spherical",
                "gate_start": GATE[0],
                "gate_stop": GATE[1],
                "directions": mi.TensorXf(scan_directions(columns, rows)),
                "laser": {
                    "type": "laser",
                    "beam_radius": 0.1,
                    "beam_cut": 0.1,
                    "divergence_full_mrad": 2.0,
                },
                "film": {
                    "type": "hdrfilm",
                    "width": columns,
                    "height": rows,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            **_air(extinction),
        }
    )


# The other side, in a separate process, which keeps its scene from call to call.
_peer_scene = None


def _start_peer() -> None:
    use_variant(VARIANT)
    import mitransient  # noqa: F401  registers its plugins in the variant in force


def _load_peer(extinction: float, columns: int, rows: int) -> None:
    global _peer_scene
    _peer_scene = None
    gc.collect()
    half = SCAN_TAN if columns > 1 else math.tan(FOV_HALF)
    look = mi.ScalarTransform4f().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])
    _peer_scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_prbvolpath", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": math.degrees(2 * math.atan(half)),
                "fov_axis": "x",
                "near_clip": 1e-2,
                "far_clip": 2e3,
                "to_world": look,
                "film": {
                    "type": "transient_hdr_film",
                    "width": columns,
                    "height": rows,
                    "temporal_bins": 1,
                    "start_opl": 2 * GATE[0],
                    "bin_width_opl": 2 * (GATE[1] - GATE[0]),
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            "light": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
            **_air(extinction),
        }
    )


def _render_peer(samples: int, seed: int) -> np.ndarray:
    """Received over emitted energy, (rows, columns)."""
    _, gates = _peer_scene.integrator().render(_peer_scene, spp=samples, seed=seed)
    return np.array(gates, float)[:, :, 0, 0] * math.pi * APERTURE_RADIUS**2
