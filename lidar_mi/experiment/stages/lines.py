"""Lines of sight of the Doppler lidar through the slab, each from images of rings."""

from collections.abc import Mapping

import numpy as np
import torch
import xarray as xr

from lidar_mi.assessment.metrics.requirements import RequirementTable, read_requirements
from lidar_mi.atmosphere.line import laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.ring_instrument import pixel_noise
from lidar_mi.experiment.ring_reference import (
    drifts,
    plate_error,
    plate_uncertainty,
    reference_frames,
)
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.ring_images import Rings, exposed_frames, reference_photons
from lidar_mi.experiment.stages.ring_velocities import FRAMES, REFERENCES, speeds_to_laser
from lidar_mi.experiment.truth import Flows, Truth, find_file, slab_mean
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.doppler import photons
from lidar_mi.instrument.doppler_scan import scan_wind, sight_volumes, wind_of_lines
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.retrieval.lines.vectors import COMPONENTS
from lidar_mi.retrieval.method_names import RingCentre, RingMethod

# Speeds at which noise-free images are rendered; those between are interpolated (Chebyshev).
_NODES = 7
# First number of the lines' images, which selects their random streams.
_PULSES = "sensor.pulses"
_STREAMS = 1 << 24


def requirement_tables(
    experiment: Experiment, beside
) -> Mapping[tuple[str, str], RequirementTable]:
    """The tables that the sensor is compared with, as `read_requirements` gives them.

    Raises
    ------
    InputError
        A requirement table that is missing or not one.
    """
    path = experiment.sensor.requirements
    if path:
        return read_requirements(find_file(path, beside, "sensor.requirements"))
    # the paper's are those of flight control: they do not apply to a platform at rest
    return read_requirements() if experiment.platform.speed else {}


def slab_wind(experiment: Experiment, truth: Truth) -> xr.Dataset:
    """True u, v, w (m s^-1) on (z, y), averaged over the slab; u is 0 in a wake without it."""
    wind = truth.wind
    return wind if "u" in wind else wind.assign(u=xr.zeros_like(wind["v"]))


def states_of_wind(experiment: Experiment, wind: xr.Dataset, flows: Flows) -> xr.Dataset:
    """The wind that lines of sight meet: that of `slab_wind`, or its states at both images' times.

    Dims (time, z, y) with the times 0 and dt where a wake has a second state.
    """
    if flows[1] is None:
        return wind
    gates = wind.attrs["gates"]
    states = [
        xr.Dataset({n: slab_mean(flow[n], gates) for n in COMPONENTS if n in flow})
        for flow in flows
    ]
    states = [s if "u" in s else s.assign(u=xr.zeros_like(s["v"])) for s in states]
    return xr.concat(states, xr.Variable("time", [0.0, experiment.platform.dt]))


def check_lines(
    experiment: Experiment, wind: xr.Dataset, rings: Rings, beams: Beams | None
) -> None:
    """Check that both lidars observe the same air, in the Doppler lidar's velocity range.

    Raises
    ------
    InputError
        Lidars that do not observe the same slab, lines that leave the wake, speeds beyond the
        unambiguous range.
    """
    reference_frames(experiment.sensor.pulses, experiment.doppler.reference.every, _PULSES)
    lidar = experiment.doppler.lidar
    middle = experiment.scan.range + experiment.scan.thickness / 2
    if abs(lidar.range - middle) > lidar.range_bin / 2:
        raise InputError(
            f"doppler.lidar.range: {lidar.range:g} m is not allowed with sensor; expected the slab "
            f"of scan, {middle - lidar.range_bin / 2:g} to {middle + lidar.range_bin / 2:g} m"
        )
    # lines that leave the wake, bins that reach the telescope
    directions = experiment.sensor.directions
    try:
        going = directions.directions() if beams is None else beams.direction
        volumes = sight_volumes(going, directions.ranges(lidar, beams), lidar)[0]
        wind_of_lines(wind, volumes if beams is None else volumes + beams.origin[:, None])
    except InputError as error:
        raise InputError(f"sensor.directions: {error}") from None
    fastest = experiment.platform.speed + float(
        np.sqrt(sum(wind[n] ** 2 for n in COMPONENTS)).max()
    )
    limit = rings.model.velocity_range / 2
    if fastest > limit:
        raise InputError(
            f"platform.speed: {experiment.platform.speed:g} m/s is not allowed with sensor; "
            f"expected less than {limit:.0f} m/s with the wind, half an order of doppler.etalon"
        )


def measure_lines(
    experiment: Experiment,
    truth: xr.Dataset,
    rings: Rings,
    beams: Beams | None,
    assumed: Rings,
    *,
    log: Log,
) -> xr.Dataset:
    """Line-of-sight velocities retrieved from the Doppler lidar's rings.

    ``assumed`` has the models of the instrument that the retrieval assumes.

    Images without noise are made at a few speeds and interpolated between them (their rings
    move by far less than an order); each line's are drawn by the CCD and evaluated by the annular
    fit, which states its standard error.

    Returns
    -------
    xr.Dataset, dim (line)
        From `scan_wind`, with ``v_los``, its random ``v_los_std`` and ``v_los_systematic``, which
        all lines share (m s^-1), as retrieved; NaN where an image gives none.
    """
    sensor, doppler = experiment.sensor, experiment.doppler
    lines = scan_wind(
        truth,
        sensor.directions,
        doppler.lidar,
        0.0,
        experiment.seed,
        experiment.platform.speed,
        sensor.errors,
        beams,
    )
    true = lines["v_los_true"].values
    log(f"measuring {len(true)} lines of sight, {sensor.pulses} pulses each")
    middle, half = (true.max() + true.min()) / 2, max(np.ptp(true) / 2, 1e-3)
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    light, counted = photons(doppler.lidar), doppler.lidar.counted
    images = torch.stack(
        [
            fringe_image(doppler.camera, doppler.etalon, rings.line, speed, light, counted)
            for speed in middle + half * nodes
        ]
    )
    line = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    own = fringe_image(doppler.camera, doppler.etalon, line, 0.0, reference_photons(doppler, rings))
    every = doppler.reference.every
    frames_of_line, sharing = reference_frames(sensor.pulses, every, _PULSES)
    noises = [pixel_noise(doppler.ccd, rings.modes, n) for n in (sensor.pulses, frames_of_line)]
    weights = torch.from_numpy(_lagrange(nodes, (true - middle) / half)).to(images.dtype)
    retrieved = np.empty((3, len(true)))
    for start in range(0, len(true), FRAMES):
        log.bar(f"retrieving line of sight {start + 1} of {len(true)}", start / len(true))
        chunk = range(start, min(start + FRAMES, len(true)))
        frames, laser = [], []
        for index in chunk:
            farther = doppler.lidar.model_copy(update={"range": float(lines["range"][index])})
            image = torch.tensordot(weights[index], images, 1) * (photons(farther) / light)
            # random streams different from those of the images of the Doppler lidar's chapter
            frames.append(
                exposed_frames(
                    doppler, rings, image, sensor.pulses, experiment.seed, [_STREAMS + index]
                )
            )
            laser.append(
                exposed_frames(
                    doppler,
                    rings,
                    own,
                    frames_of_line,
                    experiment.seed,
                    [REFERENCES + _STREAMS + index // sharing],
                )
            )
        retrieved[:, start : chunk.stop] = speeds_to_laser(
            torch.cat(frames),
            torch.cat(laser),
            doppler,
            assumed,
            noises,
            RingMethod.ANNULAR,
            RingCentre.FREE,
        )
    v_los, std, systematic = retrieved
    drift, drift_std = drifts(
        doppler, sensor.pulses, [experiment.seed, _STREAMS], range(len(true)), _PULSES
    )
    return lines.assign(
        v_los=("line", v_los + drift + plate_error(doppler), lines["v_los"].attrs),
        v_los_std=("line", np.hypot(std, drift_std), lines["v_los_std"].attrs),
        v_los_systematic=(
            "line",
            np.hypot(systematic, plate_uncertainty(doppler)),
            {"units": "m s-1", "long_name": "systematic standard error common to all lines"},
        ),
    )


def _lagrange(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Weights (places, nodes) of values at the nodes in the polynomial through them, at places."""
    others = ~np.eye(len(nodes), dtype=bool)
    return np.stack(
        [
            ((places[:, None] - nodes[o]) / (node - nodes[o])).prod(1)
            for node, o in zip(nodes, others, strict=True)
        ],
        axis=1,
    )
