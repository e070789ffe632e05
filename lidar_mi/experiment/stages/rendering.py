"""From the truth to the two images of the backscatter lidar: scan geometry, light, detector."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.cores import Core, find_cores
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import Keeper
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.memory import check_size, check_states
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.stages.brightness import check_brightness, least_samples
from lidar_mi.experiment.stages.timed_beams import timed_plans
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows, read_flows
from lidar_mi.experiment.truth.in_time import air_in_time, values_of_states
from lidar_mi.instrument.detector import gate_duration
from lidar_mi.instrument.detector_noise import noise_budget, noisy_scan
from lidar_mi.instrument.products import untrusted_pixels, with_products
from lidar_mi.instrument.scan import ScanPlan, plan_scans
from lidar_mi.instrument.speckle import speckle_modes
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.batches import Batches
from lidar_mi.rendering.phase import Scatterer, molecules, scatterer
from lidar_mi.rendering.samples import Samples, choose_samples, monte_carlo_fraction, pilot_samples
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.wind.synchronised import synchronised

IMAGES = ("image_t1", "image_t2")
"""Parts of the result of `render_images`."""

PILOT_SEED = 1 << 30
"""Added to the seed for a pilot: far from those of all scans."""


def scan_plans(
    experiment: Experiment, truth: Truth, beside: str | Path | None = None
) -> list[ScanPlan]:
    """The scans of both images, with the beams in time where `timed_plans` has any.

    Parameters
    ----------
    beside : path, optional
        Folder in which files of directions and of the trajectory are searched first. Default: the
        experiment's.
    """
    flown = (experiment.platform.speed - experiment.scan.follow) * experiment.platform.dt
    y, z = truth.wind["y"].values, truth.wind["z"].values
    plans = plan_scans(experiment.scan, y, z, (0.0, flown))
    return timed_plans(experiment, plans, experiment.folder if beside is None else beside)


def read_truth(experiment: Experiment, beside: str | Path, *, log: Log) -> Flows:
    """The flow at both times; see `read_flows`.

    Raises
    ------
    InputError
        A wake that cannot be read, or images of it that a run cannot hold: before more is made of
        it.
    """
    log.bar("reading the wake", None)
    scan = experiment.scan
    if scan.aim == "angles":
        check_size(experiment, scan.columns, scan.rows)
    flows = read_flows(experiment, beside)
    if scan.aim == "grid":  # a beam for every node
        check_size(experiment, flows[0].sizes["y"], flows[0].sizes["z"])
    return flows


def true_cores(experiment: Experiment, truth: Truth) -> list[Core]:
    """The vortices of the true wind; none are looked for in the gusts behind a turbine."""
    return [] if experiment.wake.turbine else find_cores(truth.wind)


def scattering_air(experiment: Experiment, beside: str | Path, *, log: Log) -> Scatterer:
    """Phase function and albedo of the air; tables are read, or computed where they are missing.

    Raises
    ------
    InputError
        A scattering table that is missing or not one.
    """
    use_variant(experiment.render.variant)
    log.bar("reading scattering matrices", None)
    return scatterer(experiment.scattering, beside, experiment.lidar.wavelength, log.bar)


def environment_extinction(experiment: Experiment) -> float:
    """Extinction coefficient around the slab and up to it, m^-1."""
    mapping = experiment.wake.extinction
    return mapping.background + mapping.molecules


def check_light(
    experiment: Experiment, truth: Truth, plans: Sequence[ScanPlan], air: Scatterer, flows: Flows
) -> None:
    """Check that the images will not be dark or their noise undetermined.

    Raises
    ------
    InputError
        Air that does not scatter, a detector inconsistent with the pulse, beams too wide for the
        largest medium, moving air in more states than the memory holds.
    """
    _media(experiment, truth.extinction, plans)
    in_states = values_of_states(experiment, flows, plans)
    check_states(experiment, len(plans[0].y) * len(plans[0].z), in_states)
    if experiment.detector:
        for plan in plans:
            duration = gate_duration(plan.gate_length())
            speckle_modes(experiment.detector, experiment.lidar, duration, plan.ranges())
    if not max(float(field.max()) for field in truth.extinction) > 0:
        raise InputError(
            "wake.extinction: 0 everywhere is not allowed; expected air that scatters, by its "
            "background, tracer or aerosol"
        )
    if not air.albedo > 0:
        raise InputError("scattering.albedo: 0 is not allowed here; expected above 0, up to 1")
    for plan in plans:
        check_brightness(experiment, truth.extinction, plan, air.albedo)


def render_images(
    experiment: Experiment,
    truth: Truth,
    plans: Sequence[ScanPlan],
    air: Scatterer,
    flows: Flows,
    *,
    log: Log,
    missing: Sequence[str] = IMAGES,
    keeper: Keeper | None = None,
) -> Iterator[tuple[str, xr.Dataset]]:
    """Render the scans of both times without a detector's noise, one after the other.

    Yields
    ------
    name : str
        Of `IMAGES`.
    scan : xr.Dataset, dims (gate, z, y)
        From `render_scans`, with the depolarisation and what else it gives.
    """
    use_variant(experiment.render.variant)
    wanted = [IMAGES.index(name) for name in missing]
    number: int | None = None
    if experiment.render.samples_per_beam == "auto":
        chosen = chosen_samples(experiment, truth, plans, air, flows, log=log)
        number = experiment.render.without_detector(plans[0].gate_count)
        if chosen:
            number = chosen.number
            log(samples_text(experiment, chosen))
        experiment = with_samples(experiment, number)
    log(f"rendering {len(wanted)} scans of {len(plans[0].y)} x {len(plans[0].z)} beams")

    def progress(scan: int, done: int, total: int) -> None:
        log.bar(f"rendering scan {scan + 1} of {len(plans)}", done / total)

    batches = batches_of(IMAGES, keeper, log, number)
    rendered = _rendered(
        experiment, truth, plans, air, flows, wanted, log, progress=progress, batches=batches
    )
    platform = {"platform_speed": experiment.platform.speed, "dt": experiment.platform.dt}
    for index, scan in zip(wanted, rendered, strict=True):
        scan = with_products(scan)
        scan.attrs |= platform
        if plans[index].beams is not None:
            scan.attrs["reference_time"] = index * experiment.platform.dt
            scan.attrs["frozen_air"] = int(experiment.scan.air == "frozen")
        if said := untrusted_pixels(scan):
            log.remark(f"{IMAGES[index]}: {said}")
        yield IMAGES[index], scan


def _rendered(
    experiment: Experiment,
    truth: Truth,
    plans: Sequence[ScanPlan],
    air: Scatterer,
    flows: Flows,
    wanted: Sequence[int],
    log: Log,
    seed: int | None = None,
    **how: Any,
) -> Iterator[xr.Dataset]:
    """Some of the scans, of the air at their times, from `render_scans`."""
    fields = list(truth.extinction)
    if experiment.scan.air == "moving":
        for index, plan in enumerate(plans):
            if index in wanted and plan.beams is not None:
                log.bar(f"moving the air of scan {index + 1} of {len(plans)}", None)
                fields[index] = air_in_time(experiment, truth, flows, index, plan.beams.time)
    mapping = experiment.wake.extinction
    return render_scans(
        _media(experiment, fields, plans),
        plans,
        experiment.lidar,
        environment_extinction(experiment),
        *air,
        experiment.render,
        experiment.seed if seed is None else seed,
        scans=wanted,
        molecules=molecules(
            mapping.molecules, experiment.lidar.wavelength, experiment.scattering.band
        ),
        **how,
    )


def chosen_samples(
    experiment: Experiment,
    truth: Truth,
    plans: Sequence[ScanPlan],
    air: Scatterer,
    flows: Flows,
    *,
    log: Log,
) -> Samples | None:
    """Samples per beam of both scans, from pilots of both; None without a detector.

    The scan of more noise decides. Other pilots of the same experiment give the same number. Where
    the experiment has a number, it is that, with what its noise is.
    """
    detector = experiment.detector
    if detector is None:
        return None
    use_variant(experiment.render.variant)
    log.bar("choosing the number of samples", None)
    beams, gates = len(plans[0].y) * len(plans[0].z), plans[0].gate_count
    samples, seed = pilot_samples(experiment.render, beams, gates), experiment.seed + PILOT_SEED
    # noise is that of air at the scan's reference time, which need not be moved for it
    frozen = experiment.scan.model_copy(update={"air": "frozen"})
    asked = with_samples(experiment.model_copy(update={"scan": frozen}), samples)
    pilots = _rendered(asked, truth, plans, air, flows, range(len(plans)), log, seed)
    pulses, found = experiment.scan.pulses_per_beam, []
    for plan, pilot in zip(plans, pilots, strict=True):
        seen = noisy_scan(pilot, experiment.lidar, detector, [seed, 0, 1], plan, pulses)
        least = least_samples(experiment, truth.extinction, plan)
        found.append(choose_samples(seen, samples, experiment.render, least))
    return max(found, key=lambda one: (one.number, one.fraction))


def with_samples(experiment: Experiment, number: int) -> Experiment:
    """The experiment with a number of samples per beam."""
    render = experiment.render.model_copy(update={"samples_per_beam": number})
    found = experiment.model_copy(update={"render": render})
    return found.read_from(experiment.folder)


def samples_text(experiment: Experiment, chosen: Samples) -> str:
    """A number of samples, and what their noise is beside that of the detector."""
    text = (
        f"{chosen.number} Monte Carlo samples per beam, with {chosen.fraction:.2g} times the "
        f"variance of the detector noise (median {chosen.median:.2g}, 90 % of the beams below "
        f"{chosen.upper:.2g})"
    )
    if chosen.reached:
        return text
    asked = experiment.render.monte_carlo_fraction
    return f"{text}; {asked:g} needs {chosen.needed}"


def batches_of(
    names: Sequence[str], keeper: Keeper | None, log: Log, samples: int | None = None
) -> Callable[[int], Batches] | None:
    """Storage of an image's samples while it is rendered, by its index among the names.

    Parameters
    ----------
    samples : int, optional
        Per beam, where that was chosen: stored ones of an image with another number are not used.
    """
    if keeper is None:
        return None

    def batches(index: int) -> Batches:
        name = names[index]

        def load() -> dict | None:
            found = keeper.unfinished(name)
            if not found or found.pop("samples", samples) != samples:
                return None
            log(f"resuming {name}: {found['passes']} passes are kept from an earlier run")
            return found

        def save(arrays: dict) -> None:
            number = {} if samples is None else {"samples": np.array(samples)}
            keeper.keep_unfinished(name, arrays | number)

        return Batches(load, save)

    return batches


def detect_images(
    experiment: Experiment, images: Mapping[str, xr.Dataset], plans: Sequence[ScanPlan]
) -> list[xr.Dataset]:
    """The images of all beams, with noisy ones in addition if there is a detector."""
    # images are per emitted energy: those of another pulse energy are the same
    energy = experiment.lidar.pulse_energy
    scans = [
        _on_nodes(images[name].assign_attrs(pulse_energy=energy), plan)
        for name, plan in zip(IMAGES, plans, strict=True)
    ]
    if experiment.detector is None:
        return scans
    lidar, detector, seed = experiment.lidar, experiment.detector, experiment.seed
    # geometry and air are in single precision in a file: here they are known exactly
    air = {"environment_extinction": environment_extinction(experiment)}
    pulses = experiment.scan.pulses_per_beam
    # random numbers different from those of the light transport
    found = [
        noisy_scan(scan.assign_attrs(air), lidar, detector, [seed, index, 1], plan, pulses)
        for index, (scan, plan) in enumerate(zip(scans, plans, strict=True))
    ]
    return [scan.assign_attrs(monte_carlo_fraction=monte_carlo_fraction(scan)) for scan in found]


def _on_nodes(scan: xr.Dataset, plan: ScanPlan) -> xr.Dataset:
    """A scan on its plan's nodes, which a file has in single precision: those of the truth."""
    nodes = {axis: (axis, getattr(plan, axis), scan[axis].attrs) for axis in ("y", "z")}
    return scan.assign_coords(nodes)


def gridded_scans(experiment: Experiment, detected: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """The scans, on regular nodes where beams were reported beside them; see `synchronised`."""
    if any("y_reported" not in scan for scan in detected):
        return list(detected)
    # times in double precision, so that those of a node are not rounded twice
    scans = [scan.assign(beam_time=scan["beam_time"].astype(float)) for scan in detected]
    image = "Y_noisy" if "Y_noisy" in scans[0] else "Y"
    found = synchronised(scans, [experiment.platform.dt], image)
    return [scan.assign_attrs(gridded=1) for scan in found]


def detector_noise(experiment: Experiment, detected: Sequence[xr.Dataset]) -> dict[str, float]:
    """Contributions to the noise of the first scan, see `noise_budget`."""
    return noise_budget(
        detected[0], experiment.lidar, experiment.detector, experiment.scan.pulses_per_beam
    )


def _media(
    experiment: Experiment, fields: Sequence[xr.DataArray], plans: Sequence[ScanPlan]
) -> list[xr.DataArray]:
    """The extinction at both times, extended to the depth and width of the beams."""
    if fields[0].sizes["x"] > 1:
        return list(fields)
    reach = max(plans, key=lambda plan: plan.gate_stop)
    return [
        extrude(field.isel(x=0).transpose(..., "z", "y"), reach, experiment.lidar, plans)
        for field in fields
    ]
