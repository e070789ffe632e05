"""Both lidars as one sensor: the wind in three dimensions, and the error budget of u.

The Doppler lidar scans the slab observed by the backscatter lidar. All of its lines of sight and
the cross-flow wind together give (u, v, w).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.errors import commonest_flag
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.lines import LineScan
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.doppler_scan import PlatformErrors
from lidar_mi.instrument.scan import Scan
from lidar_mi.retrieval.common_error import NAMES as COMMON_ERRORS
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.sensor import Sensor

# Lines of sight per least-squares vector of the Doppler lidar alone: one and those around it.
_AROUND = 9
# Values of a negligible error and length in a budget of errors, m/s and m.
_SURE, _SHORT = 0.01, 0.1


def combined_wind(
    name: str,
    observation: Observation,
    detector: Detector | None,
    sensor: Sensor,
    slab_wind: xr.Dataset,
    lines: xr.Dataset,
    wind: xr.Dataset,
    log: Log,
) -> xr.Dataset | None:
    """The wind from the lines of sight and from the images' wind, with the truth.

    The true u, v, w of the slab are added to what `combine` gives, as ``u_true``, ``v_true``,
    ``w_true`` (m s^-1). Where there is no wind, a warning is logged.
    """
    log("combining both lidars")
    try:
        images = crossflow(sensor, detector, wind)
        settings = combine_settings(observation, sensor, images)
        combined = with_truth(name, observation.scan, slab_wind, lines, images, settings)
    except InputError as error:
        log.remark(f"no wind from both lidars: {error}")
        return None
    if not (combined["flag"] == 0).any():
        log.remark(f"no vector from both lidars is valid; {commonest_flag(combined['flag'])}")
    return combined


def doppler_alone(lines: xr.Dataset, log: Log) -> dict[str, xr.Dataset]:
    """Vectors of the Doppler lidar alone, from "triples" of lines and from "neighbours" of each.

    Empty where the valid lines do not give any, which is logged as a warning.
    """
    from lidar_mi.retrieval.combined.vectors import wind_from_neighbours, wind_from_triples

    try:
        triples = wind_from_triples(lines)
        if not (triples["flag"] == 0).any():
            raise InputError("no three neighbouring lines could be read")
        around = wind_from_neighbours(lines, min(_AROUND, lines.sizes["line"]))
    except InputError as error:
        log.remark(f"no wind from lines of sight alone: {error}")
        return {}
    shifted = _shifted(lines)
    if shifted is None:
        return {"triples": triples, "neighbours": around}
    return {
        "triples": with_systematic(triples, wind_from_triples(shifted)),
        "neighbours": with_systematic(
            around, wind_from_neighbours(shifted, min(_AROUND, lines.sizes["line"]))
        ),
    }


def _shifted(lines: xr.Dataset) -> xr.Dataset | None:
    """Lines of sight, all with the systematic error that is stated; None where none is."""
    known = lines.get("v_los_systematic")
    if known is None or not (known > 0).any():
        return None
    return lines.assign(v_los=lines["v_los"] + known)


def with_systematic(combined: xr.Dataset, shifted: xr.Dataset) -> xr.Dataset:
    """Vectors with the systematic standard errors of their components, m/s.

    found, shifted: vectors by the same method from lines as measured, and from lines that all have
        the stated systematic error of v_LOS. It is one error, common to all lines and vectors; the
        differences of the vectors are what it makes of u, v and w.
    """
    from lidar_mi.retrieval.combined.vectors import COMPONENTS

    for name in COMPONENTS:
        combined[f"{name}_systematic"] = abs(shifted[name] - combined[name]).assign_attrs(
            units="m s-1",
            long_name=f"systematic standard error of {name}, by that common to all lines of sight",
        )
    return combined


def crossflow(sensor: Sensor, detector: Detector | None, wind: xr.Dataset) -> xr.Dataset:
    """The images' wind used by the sensor for v and w."""
    source = Source.NOISY if detector else Source.BACKSCATTER
    return wind.sel(source=source, algorithm=sensor.method)


def _oblique_view(observation: Observation) -> dict[str, float]:
    """Settings of `combine` for the apparent motion in the images by motion along x."""
    if not observation.moves_along:
        return {}
    platform, scan = observation.platform, observation.scan
    # the telescope's distance at mid-time
    advance = (platform.speed - scan.follow) * platform.dt
    distance = scan.range + scan.thickness / 2 - advance / 2
    return {"distance": distance, "gate_speed": scan.follow}


def _in_time(platform: Platform, sensor: Sensor, crossflow: xr.Dataset) -> dict[str, Any]:
    """Settings of `combine` for the time of the wind, half way between both images."""
    from lidar_mi.retrieval.combined.common_time import estimated_drift

    settings: dict[str, Any] = {"time": platform.dt / 2}
    if sensor.drift == "estimated":
        drift = estimated_drift(crossflow, sensor.crossflow_std)
        settings |= {"drift": drift.velocity, "drift_std": drift.std}
    return settings


def combine_settings(
    observation: Observation, sensor: Sensor, crossflow: xr.Dataset
) -> dict[str, Any]:
    """Settings of `combine` for the cross-flow wind of a sensor."""
    settings = {"crossflow_std": sensor.crossflow_std, **_oblique_view(observation)}
    return settings | _in_time(observation.platform, sensor, crossflow)


def with_truth(
    name: str,
    scan: Scan,
    truth: xr.Dataset,
    lines: xr.Dataset,
    crossflow: xr.Dataset,
    settings: Mapping[str, Any],
) -> xr.Dataset:
    """The wind of `combine` from lines and cross-flow wind, with the truth at its nodes."""
    from lidar_mi.retrieval.combined.combine import combine
    from lidar_mi.retrieval.combined.vectors import COMPONENTS

    combined, shifted = combine(crossflow, lines, **settings), _shifted(lines)
    if shifted is not None:
        combined = with_systematic(combined, combine(crossflow, shifted, **settings))
    for component in COMPONENTS:
        at = {axis: combined[axis] for axis in ("z", "y")}
        combined[f"{component}_true"] = (
            truth[component]
            .interp(at)
            .assign_attrs(units="m s-1", long_name=f"true {component}, mean over the slab")
        )
    about = {
        "units": "m",
        "long_name": "distance ahead of the first image's telescope",
        "axis": "X",
    }
    combined["x"] = (), scan.range + scan.thickness / 2, about
    combined = combined.set_coords("x")
    combined.attrs |= {
        "title": f"Wind from both lidars of the experiment {name}",
        "source": f"lidar-mi {__version__}",
    }
    return combined


def limits_of_u(
    observation: Observation,
    line_scan: LineScan,
    detector: Detector | None,
    slab_wind: xr.Dataset,
    lines: xr.Dataset,
    wind: xr.Dataset,
    wind3d: xr.Dataset | None,
    cores: Sequence[Core],
) -> dict[str, float]:
    """Error budget of u, see `mean_squares_without`. Empty without a wind from both lidars."""
    if wind3d is None:
        return {}
    images = crossflow(line_scan.sensor, detector, wind)
    return mean_squares_without(observation, line_scan, slab_wind, lines, images, wind3d, cores)


def mean_squares_without(
    observation: Observation,
    line_scan: LineScan,
    truth: xr.Dataset,
    lines: xr.Dataset,
    crossflow: xr.Dataset,
    combined: xr.Dataset,
    cores: Sequence[Core],
) -> dict[str, float]:
    """Mean square error of u without each cause, and without all of them at once, m^2 s^-2.

    Causes: `line_noise` (from the rings' noise), `range_bin` (averaging along it, here over
    `_SHORT`), `crossflow` (errors of v and w) and, where there are any, `pointing`
    (``sensor.errors``). Without all of them the sampling error remains (`sampling`). The estimate
    without a cause also assumes that it is absent, and the result is that of one draw: in
    `wake_sensor` the noise of lines contributes, over draws, 9 % of the mean square error of u; its
    fraction is 23 % with the draw of seed 1, whose lines have a mean error of 0.05 m/s (2.9
    sigma; seeds 2 to 4 0.00).

    Returns
    -------
    dict
        By cause; with all of them as "". Valid vectors, beyond two core radii where there are
        cores. Empty without any.
    """
    from lidar_mi.retrieval.combined.combine import combine
    from lidar_mi.retrieval.combined.vectors import COMPONENTS

    sensor = line_scan.sensor
    at = {axis: crossflow[axis] for axis in ("z", "y")}
    true = {name: truth[name].interp(at).transpose("z", "y").values for name in COMPONENTS}
    surely = {f"{name}_stderr": np.full_like(true[name], _SURE) for name in ("v", "w")}
    surely |= {"v": true["v"], "w": true["w"], "vw_correlation": np.zeros_like(true["v"])}
    # exact vectors have no common error either
    known = crossflow.drop_vars(COMMON_ERRORS, errors="ignore")
    known = known.assign({name: (("z", "y"), field) for name, field in surely.items()})
    z, y = np.meshgrid(combined["z"], combined["y"], indexing="ij")
    chosen = (combined["flag"].values == 0) & outside_cores(y, z, list(cores))

    def square(causes: Sequence[str]) -> float:
        lidar, missed = line_scan.doppler.lidar, sensor.errors
        if "range_bin" in causes:
            lidar = lidar.model_copy(update={"range_bin": _SHORT})
        if "pointing" in causes:
            missed = PlatformErrors()
        changed = line_scan.true_lines(lidar, missed)
        # lines without a velocity remain without
        # the draw of the measurement: cases differ by their cause alone
        noise, std = lines["v_los"] - lines["v_los_true"], lines["v_los_std"]
        if "line_noise" in causes:
            noise, std = 0 * noise, xr.full_like(std, _SURE)
        changed = changed.assign(v_los=changed["v_los_true"] + noise, v_los_std=std)
        if "v_los_covariance" in lines and "line_noise" not in causes:
            changed["v_los_covariance"] = lines["v_los_covariance"]
        flow = known
        settings: dict[str, Any] = {}
        if "crossflow" not in causes:
            flow = crossflow
            settings = {"crossflow_std": sensor.crossflow_std, **_oblique_view(observation)}
        # time and drift are no causes: they are the same in all cases
        settings |= timed
        u = combine(flow, changed, **settings)["u"].transpose("z", "y").values
        return float(((u - true["u"])[chosen] ** 2).mean())

    if not chosen.any():
        return {}
    timed = _in_time(observation.platform, sensor, crossflow)
    full = square(())
    if not full > 0:
        return {}
    causes = ["line_noise", "range_bin", "crossflow"]
    if sensor.errors != PlatformErrors():
        causes.append("pointing")
    errors = {"": full} | {cause: square((cause,)) for cause in causes}
    return errors | {"sampling": square(causes)}
