"""Cross-correlation against OpenPIV on one image pair with exactly known wind.

Two Lamb-Oseen vortices advect a band-limited texture, a sum of plane waves that is evaluated at the
origin of the air of every pixel: without interpolation and noise, so all error is the method's.
Vectors are compared at the same places, each with the wind at its position. The vector of a
template of the first image is half its displacement further on; that of windows in both images (or
in images deformed symmetrically) is at the windows' centre. OpenPIV's own coordinates lie half a
pixel beyond that centre; this is corrected.
"""

import contextlib
import io
import warnings
from dataclasses import dataclass

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

from .cases import (
    CIRCULATION,
    CONTRAST,
    CORE_RADIUS,
    CORRELATION_LENGTH,
    DT,
    SEPARATION,
    SPACING,
    Pair,
    vortex_pair_images,
)
from .measure import in_turns
from .report import Comparison, missing, row


@dataclass(frozen=True)
class Field:
    """Displacements (px) of windows one pixel apart.

    ``start`` is the position of the first window's centre in the image (px along z and y),
    ``moved`` the fraction of its displacement by which a vector's position is further on.
    """

    dz: np.ndarray
    dy: np.ndarray
    start: float
    moved: float


def compare(repeats: int = 5, columns: int = 219, rows: int = 139) -> Comparison:
    """Errors and times for windows of 8 and 16 pixels, one pass and iterated deformation.

    As calls are short, there are twice as many turns as ``repeats``.
    """
    title = f"Wind from an image pair of {columns} x {rows} px against OpenPIV"
    sides = ("lidar-mi cc", "OpenPIV")
    if reason := missing("openpiv"):
        return Comparison(title, *sides, reason=reason)
    pair = vortex_pair_images(columns=columns, rows=rows)
    cases = {
        # the one of its four correlations with the smallest error in each case
        "8 px windows: cc 8 in 16 | extended search 8 in 16": (
            (8, 16),
            lambda: extended_search(pair, 8, 16, "linear"),
        ),
        "8 px windows: cc 8 in 16 | window deformation 32, 16, 8, 8": (
            (8, 16),
            lambda: window_deformation(pair, (32, 16, 8, 8), (8, 4, 2, 1)),
        ),
        "16 px windows: cc 16 in 24 | one pass 16": (
            (16, 24),
            lambda: extended_search(pair, 16, 16, "circular"),
        ),
        "16 px windows: cc 16 in 24 | window deformation 32, 16, 16, 16, 16": (
            (16, 24),
            lambda: window_deformation(pair, (32, 16, 16, 16, 16), (16, 8, 4, 2, 1)),
        ),
    }
    lines = []
    for case, (windows, theirs) in cases.items():
        found = in_turns(
            {
                "ours": lambda _, windows=windows: cross_correlation(pair, *windows),
                "theirs": lambda _, theirs=theirs: theirs(),
            },
            2 * repeats,
        )
        ours, other = (found[side][0].result for side in ("ours", "theirs"))
        errors, vectors = wind_errors(pair, ours, other)
        remark = f"{vectors} vectors of both"
        for (where, component), (left, right) in errors.items():
            lines.append(
                row(
                    case,
                    f"rms error of {component}, {where}",
                    "m/s",
                    [left],
                    [right],
                    "lower",
                    remark,
                )
            )
            remark = ""
        per_vector = [
            [1e6 * seconds / field.dz.size for seconds, field in found[side]]
            for side in ("ours", "theirs")
        ]
        lines.append(row(case, "time of one vector", "us", *per_vector, "lower"))
        fastest = [[min(times)] for times in per_vector]
        lines.append(row(case, "time of one vector, fastest turn", "us", *fastest, "lower"))
    return Comparison(
        title,
        *sides,
        tuple(lines),
        (
            (
                f"Vortex pair of {CIRCULATION:g} m2/s, {SEPARATION:g} m apart, core radius "
                f"{CORE_RADIUS:g} m; {SPACING:g} m pixels, {DT:g} s; texture with "
                f"{CORRELATION_LENGTH:g} px correlation length and {CONTRAST:.0%} contrast, no "
                "noise; one vector per pixel."
            ),
            (
                "lidar-mi's time includes its quality flags, which OpenPIV's one-pass times do "
                "not; it computes on all cores, OpenPIV on one."
            ),
            "Flagged vectors are included: rms over all that both sides return.",
            (
                "extended search and one pass: extended_search_area_piv with normalised "
                "correlation, Gaussian sub-pixel fit, vectorised. Window deformation: "
                "windef.simple_multipass, default correlation, windows as named, the last at one "
                "vector per pixel."
            ),
        ),
    )


def cross_correlation(pair: Pair, template: int, search: int) -> Field:
    wind = retrieve_wind(
        pair.first,
        pair.second,
        DT,
        "cc",
        windows=WindowSizes(template=template, search=search, stride=1),
    )
    moved = [wind[f"displacement_{axis}"].values / SPACING for axis in ("z", "y")]
    return Field(*moved, start=(search - template) // 2 + (template - 1) / 2, moved=0.5)


def extended_search(pair: Pair, window: int, search: int, correlation: str) -> Field:
    from openpiv.pyprocess import extended_search_area_piv

    with _quiet():
        dy, dz, _ = extended_search_area_piv(
            pair.first.values,
            pair.second.values,
            window_size=window,
            search_area_size=search,
            overlap=search - 1,
            correlation_method=correlation,
            normalized_correlation=True,
            subpixel_method="gaussian",
            sig2noise_method=None,
            use_vectorized=True,
        )
    # windows of one size contain the same air in both images: the vector is at their centre
    return Field(dz, dy, start=(search - 1) / 2, moved=0.5 if window < search else 0.0)


def window_deformation(pair: Pair, windows: tuple[int, ...], steps: tuple[int, ...]) -> Field:
    from openpiv.settings import PIVSettings
    from openpiv.windef import simple_multipass

    settings = PIVSettings(
        windowsizes=windows,
        overlap=tuple(w - s for w, s in zip(windows, steps, strict=True)),
        num_iterations=len(windows),
        subpixel_method="gaussian",
        deformation_method="symmetric",
        sig2noise_method=None,
        sig2noise_validate=False,
    )
    with _quiet():
        _, _, dy, up, _ = simple_multipass(pair.first.values, pair.second.values, settings)
    # rows are z, ascending; OpenPIV assumes descending ones, and inverts the sign
    return Field(-up, dy, start=(windows[-1] - 1) / 2, moved=0.0)


def wind_errors(pair: Pair, ours: Field, other: Field) -> tuple[dict, int]:
    """Rms errors of both, m/s, over the vectors that both have.

    Returns ``{(where, component): (ours, other)}`` for everywhere and beyond two core radii, and
    the number of vectors.
    """
    first = max(ours.start, other.start)
    size = [min(int(f.start - first) + f.dz.shape[axis] for f in (ours, other)) for axis in (0, 1)]
    place = [
        float(pair.first[name][0]) + (first + np.arange(n)) * SPACING
        for name, n in zip(("z", "y"), size, strict=True)
    ]
    z, y = np.meshgrid(*place, indexing="ij")
    errors = []
    for field in (ours, other):
        skip = int(first - field.start)
        part = slice(skip, skip + size[0]), slice(skip, skip + size[1])
        dz, dy = field.dz[part] * SPACING, field.dy[part] * SPACING
        v, w = velocity(pair.vortices, y + field.moved * dy, z + field.moved * dz)
        errors.append({"v": dy / DT - v, "w": dz / DT - w})
    both = np.all([np.isfinite(e[c]) for e in errors for c in "vw"], axis=0)
    distance = np.min([np.hypot(y - o.y, z - o.z) for o in pair.vortices], axis=0)
    regions = {"everywhere": both, "beyond 2 core radii": both & (distance > 2 * CORE_RADIUS)}
    found = {
        (where, component): tuple(
            float(np.sqrt(np.mean(e[component][chosen] ** 2))) for e in errors
        )
        for where, chosen in regions.items()
        for component in "vw"
    }
    return found, int(both.sum())


@contextlib.contextmanager
def _quiet():
    """Without OpenPIV's messages and warnings about every peak that it cannot fit."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
