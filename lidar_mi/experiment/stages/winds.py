"""From two images to the cross-flow wind, by every method and from every source."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.errors import commonest_flag, truth_at_vectors
from lidar_mi.assessment.metrics.names import EXACT, RENDERED, Source
from lidar_mi.experiment.graph import bundle
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.image_pair import Noise, Pair, both, combined_noise
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.rendering.pair_error import pair_stderr
from lidar_mi.retrieval.images.window_sizes import check_window_sizes
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.retrieval import Retrieval
from lidar_mi.schema.wake import Wake

if TYPE_CHECKING:
    from lidar_mi.retrieval.wind.options import WindowSizes


_FEW_VALID = 0.25
_OF_TEMPLATES = (ImageMethod.CC, ImageMethod.MULTIPASS)
"""Methods that find each vector by itself; below that fraction, chance correlations are many."""


@bundle
class Estimation:
    """How winds are retrieved from images, and on which device."""

    retrieval: Retrieval
    device: str | None


def check_windows(retrieval: Retrieval, plans: Sequence[ScanPlan]) -> None:
    """Check that windows fit into the images.

    Raises InputError: a search region larger than the images.
    """
    image = len(plans[0].z), len(plans[0].y)
    check_window_sizes(image, retrieval.template, retrieval.search, retrieval.stride)


def cross_flow_winds(
    name: str,
    observation: Observation,
    lidar: BackscatterLidar,
    estimation: Estimation,
    truth: Truth,
    plans: Sequence[ScanPlan],
    scans: Sequence[xr.Dataset],
    log: Log,
) -> xr.Dataset:
    """Winds by every method from every image pair, with the truth at their places.

    Sources are the extinction itself, the same without sub-grid texture, the extinction blurred by
    the beam's width (the image of a noise-free lidar), the rendered backscatter and, with a
    detector, the same with its noise; of measured sources only the last one.

    Returns
    -------
    xr.Dataset, dims (source, algorithm, z, y)
        From `retrieve_wind`, with ``score`` for the score of every method;
        ``v_true``, ``w_true`` and, from `wind_bound`, ``v_bound``, ``w_bound`` (m s^-1).
    """
    from lidar_mi.retrieval.common_error import with_common_error
    from lidar_mi.retrieval.images.resampling_error import flag_resampled
    from lidar_mi.retrieval.wind.bound import wind_bound
    from lidar_mi.retrieval.wind.methods import METHODS
    from lidar_mi.retrieval.wind.pair import retrieve_wind

    log("retrieving winds")
    wake, platform, scan = observation.wake, observation.platform, observation.scan
    retrieval, device = estimation.retrieval, estimation.device
    _warn_of_wide_beams(lidar, retrieval, truth, plans, log)
    blur, times = known_blur(retrieval, lidar, plans[0]), pixel_times(wake, scan, scans)
    pairs = _image_pairs(wake, scan, lidar, retrieval, truth, plans, scans)
    lost = resampled_noise(scans)
    sources, said = [], set()
    for index, (source, (pair, noise)) in enumerate(pairs.items()):
        log.bar(f"retrieving winds from {source.replace('_', ' ')}", index / len(pairs))
        # the truth's images are photographs
        timed = times if source in RENDERED else None
        sizes = window_sizes(retrieval)
        bound = wind_bound(
            pair[0], pair[1], platform.dt, noise, sizes, timed, retrieval_device(device)
        )
        methods: list[xr.Dataset] = []
        for method in retrieval.methods:
            wind = retrieve_wind(
                pair[0],
                pair[1],
                dt=platform.dt,
                method=method,
                **window_settings(retrieval, device),
                noise=noise,
                times=timed,
                # the extinction itself has passed no instrument
                blur=0.0 if source in EXACT else blur,
            )
            if "defects" in wind.attrs and not methods:
                log.remark(f"{source}: {wind.attrs['defects']}")
            if "fixed_pattern" in wind.attrs and not methods:
                log.remark(f"{source}: {wind.attrs['fixed_pattern']} in all images")
            # once of the air itself and once of the lidar's images, not of every source
            rendered = source in RENDERED
            if "illumination" in wind.attrs and not methods and rendered not in said:
                said.add(rendered)
                log.remark(f"{source}: {wind.attrs['illumination']} between the images")
            if source in lost:
                wind = flag_resampled(wind, *lost[source])
            if retrieval.pointing.stderr or retrieval.pointing.roll:
                common = (0.0, 0.0)
                if source in RENDERED:
                    common = common_error(retrieval, platform, plans)
                wind = with_common_error(wind, common[0], retrieval.pointing.offset, common[1])
            wind = wind.assign(
                {key: (field.dims, field.data, field.attrs) for key, field in bound.items()}
            )
            true = truth_at_vectors(wind, truth.wind)
            wind = wind.assign(v_true=true["v"], w_true=true["w"])
            wind = wind.rename({METHODS[method].score[0]: "score"})
            methods.append(wind.reset_coords(["y_vector", "z_vector"]))
        sources.append(xr.concat(methods, "algorithm", combine_attrs="drop_conflicts"))
    winds = xr.concat(sources, "source", combine_attrs="drop_conflicts")
    winds = winds.assign_coords(source=list(pairs), algorithm=list(retrieval.methods))
    winds["score"].attrs = {
        "long_name": "; ".join(f"{one}: {METHODS[one].score[1]}" for one in retrieval.methods),
        "units": "1",
    }
    winds.attrs["title"] = f"Cross-flow wind of the experiment {name}"
    winds.attrs["source"] = f"lidar-mi {__version__}"
    for text in vector_remarks(winds):
        log.remark(text)
    return winds


def _image_pairs(
    wake: Wake,
    scan: Scan,
    lidar: BackscatterLidar,
    retrieval: Retrieval,
    truth: Truth,
    plans: Sequence[ScanPlan],
    scans: Sequence[xr.Dataset],
) -> dict[str, tuple[Pair, Noise]]:
    """Both images and their noise by source: of the truth, then of the lidar."""
    rendered = rendered_pairs(wake, scan, scans)
    if retrieval.sources == "measured":
        # the last ones: with the detector's noise, if there is a detector
        return dict([rendered.popitem()])
    exact: dict[str, Pair] = {
        Source.EXTINCTION: both(truth.image),
        Source.WITHOUT_TEXTURE: both(lambda k: truth.image(k, smooth=True)),
        Source.BLURRED: both(lambda k: blur_by_beam(truth.image(k), lidar, plans[k].centre)),
    }
    if scan.aim == "angles":
        grid = rendered[Source.BACKSCATTER][0][0]
        exact = {
            name: (first.interp(y=grid["y"], z=grid["z"]), second.interp(y=grid["y"], z=grid["z"]))
            for name, (first, second) in exact.items()
        }
    # the truth's images have no noise
    return {name: (pair, 0.0) for name, pair in exact.items()} | rendered


def rendered_pairs(
    wake: Wake, scan: Scan, scans: Sequence[xr.Dataset]
) -> dict[str, tuple[Pair, Noise]]:
    """Images that winds are retrieved from, on one grid, and their noise (a map or its level).

    By source: the rendered backscatter, and with a detector the same with its noise.
    """
    from lidar_mi.retrieval.images.common_grid import resample_pair

    noise = attenuated_backscatter_stderr(scans[0])
    images = both(lambda k: scans[k]["Y"])
    maps: dict[str, tuple[Pair, xr.DataArray]]
    maps = {Source.BACKSCATTER: (images, with_resampling(noise, scans, "Y"))}
    if "Y_noisy" in scans[0]:
        noisy = combined_noise(noise, scans[0]["Y_noise_std"])
        noisy = with_resampling(noisy, scans, "Y_noisy")
        maps[Source.NOISY] = both(lambda k: scans[k]["Y_noisy"]), noisy
    if scan.aim == "angles":
        # noise cannot be interpolated: its rms level is used, as a few pixels have most of it
        # where photons are few
        return {
            name: (resample_pair(*pair, wake.spacing), float((level**2).mean() ** 0.5))
            for name, (pair, level) in maps.items()
        }
    return {name: (pair, level) for name, (pair, level) in maps.items()}


def resampled_noise(scans: Sequence[xr.Dataset]) -> dict[str, tuple[xr.DataArray, xr.DataArray]]:
    """Noise of images of scattered beams without and with what resampling adds, by source."""
    noise = attenuated_backscatter_stderr(scans[0])
    noises: dict[str, tuple[xr.DataArray, xr.DataArray]] = {}
    if "Y_resampling_std" in scans[0]:
        noises[Source.BACKSCATTER] = noise, with_resampling(noise, scans, "Y")
    if "Y_noisy_resampling_std" in scans[0]:
        noise = combined_noise(noise, scans[0]["Y_noise_std"])
        noises[Source.NOISY] = noise, with_resampling(noise, scans, "Y_noisy")
    return noises


def with_resampling(noise: xr.DataArray, scans: Sequence[xr.Dataset], name: str) -> xr.DataArray:
    """Noise of an image and what resampling of beams that scatter adds, of both in the mean."""
    name = f"{name}_resampling_std"
    squares = [scan[name] ** 2 for scan in scans if name in scan]
    if not squares:
        return noise
    added = sum(square.fillna(0.0).values for square in squares) / len(scans)
    return (noise**2 + added) ** 0.5


def pixel_times(wake: Wake, scan: Scan, scans: Sequence[xr.Dataset]) -> list[xr.DataArray] | None:
    """Times of the pixels of `rendered_pairs`, as `retrieve_wind` takes them.

    None: all pixels of a scan show the air of its reference time.
    """
    from lidar_mi.retrieval.images.common_grid import resample_pair

    if any("beam_time" not in one or one.attrs.get("frozen_air") for one in scans):
        return None
    times = [one["beam_time"] for one in scans]
    if scan.aim == "angles":
        times = list(resample_pair(times[0], times[1], wake.spacing))
    return times


def attenuated_backscatter_stderr(scan: xr.Dataset) -> xr.DataArray:
    """Monte Carlo error of the attenuated backscatter Y that winds see, see `pair_stderr`."""
    first = scan.isel(gate=0)
    lit = first["S0"] > 0
    # Y is proportional to S0: relative errors are the same
    return (scan["Y"] * pair_stderr(first) / first["S0"].where(lit)).fillna(0.0)


def known_blur(retrieval: Retrieval, lidar: BackscatterLidar, plan: ScanPlan) -> float:
    """Standard deviation (m) of the blur that `retrieval.blur` states for the methods."""
    # of a Gaussian beam the 1/e^2 radius is two standard deviations
    blur = retrieval.blur
    return float(lidar.radius_at(plan.centre)) / 2 if blur == "beam" else blur


def common_error(
    retrieval: Retrieval, platform: Platform, plans: Sequence[ScanPlan]
) -> tuple[float, float]:
    """Standard errors common to all vectors by the pointing between scans.

    Of v and of w (m/s), and of a rotation about the axis of roll (rad/s).
    """
    pointing, dt = retrieval.pointing, platform.dt
    distance = sum(plan.centre for plan in plans) / len(plans)
    return pointing.stderr * distance / dt, pointing.roll / dt


def retrieval_device(device: str | None) -> str:
    """Name of torch's device, of an experiment that is on its device."""
    return device or "cpu"


def window_settings(settings: Retrieval, device: str | None) -> dict[str, Any]:
    """Sizes of windows, tests of vectors and the device, as `retrieve_wind` takes them."""
    from lidar_mi.retrieval.wind.options import VectorValidation

    limits = settings.min_correlation, settings.min_texture, settings.min_isotropy
    return {
        "windows": window_sizes(settings),
        "validation": VectorValidation(*limits),
        "device": retrieval_device(device),
    }


def window_sizes(settings: Retrieval) -> "WindowSizes":
    """Sizes of windows, as `retrieve_wind` takes them."""
    from lidar_mi.retrieval.wind.options import WindowSizes

    return WindowSizes(settings.template, settings.search, settings.stride)


def _warn_of_wide_beams(
    lidar: BackscatterLidar, retrieval: Retrieval, truth: Truth, plans: Sequence[ScanPlan], log: Log
) -> None:
    width = 2 * float(lidar.radius_at(plans[0].centre))
    y = truth.wind["y"].values
    template = retrieval.template * float(y[1] - y[0])
    if width > template:
        log.remark(
            f"beams are {width:.3g} m wide at {plans[0].centre:g} m, wider than a template of "
            f"{template:g} m: structure that the retrieval needs is blurred"
        )


def vector_remarks(winds: xr.Dataset) -> list[str]:
    """Where rendered images gave no valid vector, and why, or too few for their stated errors."""
    without: dict[tuple[str, str], list[str]] = {}
    few = []
    for source in (str(name) for name in winds["source"].values if name in RENDERED):
        for method in map(str, winds["algorithm"].values):
            wind = winds.sel(source=source, algorithm=method)
            valid = (wind["flag"] == 0) & np.isfinite(wind["v"]) & np.isfinite(wind["w"])
            fraction = float(valid.mean())
            if not fraction:
                without.setdefault((method, commonest_flag(wind["flag"])), []).append(source)
            elif fraction < _FEW_VALID and method in _OF_TEMPLATES:
                few.append(
                    f"{source}, {method}: {fraction:.0%} of the vectors are valid; where most are "
                    "flagged, stated errors of the others may be too small"
                )
    none = [
        f"{' and '.join(sources)}, {method}: no vector is valid; {why}"
        for (method, why), sources in without.items()
    ]
    return none + few
