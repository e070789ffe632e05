"""From the truth to the two images of the backscatter lidar: scan geometry, light, detector."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core, find_cores
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import But, Only, Store, bundle
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.brightness import check_brightness, least_samples
from lidar_mi.experiment.stages.timed_beams import timed_plans
from lidar_mi.experiment.truth.extinction import ObservedAir, Truth
from lidar_mi.experiment.truth.in_time import air_in_time, values_of_states
from lidar_mi.instrument.detector import Detector, gate_duration
from lidar_mi.instrument.detector_noise import noise_budget, noisy_scan
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.products import untrusted_pixels, with_products
from lidar_mi.instrument.scan import Scan, ScanPlan, plan_scans
from lidar_mi.instrument.speckle import speckle_modes
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.batches import ALL_IMAGES, Batches, Series
from lidar_mi.rendering.pair_error import unshared_fraction
from lidar_mi.rendering.phase import Scatterer, ScatteringAir, molecules, scatterer
from lidar_mi.rendering.samples import Samples, choose_samples, monte_carlo_fraction, pilot_samples
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import check_variant, use_variant
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.scattering import Scattering
from lidar_mi.schema.wake import Wake

IMAGES = ("image_t1", "image_t2")
"""Parts of the result of `render_images`."""

CHOOSING = ("samples_per_beam", "monte_carlo_fraction", "max_samples")
"""Settings by which the number of samples is chosen, with which images are rendered."""
PILOT_SEED = 1 << 30
"""Added to the seed for a pilot: far from those of all scans."""


def scan_plans(
    scan: Scan, platform: Platform, seed: int, truth: Truth, search_path: Path
) -> list[ScanPlan]:
    """The scans of both images, with the beams in time where `timed_plans` has any."""
    advance = (platform.speed - scan.follow) * platform.dt
    y, z = truth.wind["y"].values, truth.wind["z"].values
    plans = plan_scans(scan, y, z, (0.0, advance))
    return timed_plans(scan, platform, seed, plans, search_path)


def true_cores(wake: Wake, truth: Truth) -> list[Core]:
    """The vortices of the true wind; none are looked for in the gusts behind a turbine."""
    return [] if wake.turbine else find_cores(truth.wind)


def scattering_air(
    render: Annotated[RenderSettings, Only("variant")],
    lidar: Annotated[BackscatterLidar, Only("wavelength")],
    scattering: Scattering,
    search_path: Path,
    log: Log,
) -> Scatterer:
    """Phase function and albedo of the air; tables are read, or computed where they are missing.

    Raises InputError: a scattering table that is missing or not one.
    """
    check_variant(render.variant)
    log.bar("reading scattering matrices", None)
    medium = scatterer(scattering, search_path, lidar.wavelength, log.bar)
    if isinstance(medium.phase.get("table"), str):
        # a file that the plugin alone reads
        use_variant(render.variant)
    return medium


def environment_extinction(wake: Wake, truth: Truth) -> float:
    """Extinction coefficient around the slab and up to it, m^-1."""
    return wake.extinction.background + truth.molecules


def check_light(
    observed: ObservedAir,
    lidar: BackscatterLidar,
    detector: Detector | None,
    render: RenderSettings,
    footprint: Footprint,
    air: Scatterer,
) -> None:
    """Check that the images will not be dark or their noise undetermined.

    Raises InputError: air that does not scatter, a detector inconsistent with the pulse, beams too
    wide for the largest medium, moving air in more states than the memory holds.
    """
    truth, plans = observed.truth, observed.plans
    # refuses beams that are too wide for a medium
    _media(lidar, [truth.extinction[0]], plans)
    in_states = values_of_states(observed.observation, observed.flows, plans)
    columns, rows = len(plans[0].y), len(plans[0].z)
    # the flow may be that of another point of a campaign, with another footprint
    footprint.check_size(columns, rows)
    footprint.check_states(columns * rows, in_states)
    if detector:
        for plan in plans:
            duration = gate_duration(plan.gate_length())
            # refuses a line narrower than that of the pulse
            speckle_modes(detector, lidar, duration, plan.ranges())
    if not any(float(field.max()) > 0 for field in truth.extinction):
        raise InputError(
            "wake.extinction: 0 everywhere is not allowed; expected air that scatters, by its "
            "background, tracer or aerosol"
        )
    if not air.albedo > 0:
        raise InputError("scattering.albedo: 0 is not allowed here; expected above 0, up to 1")
    mapping = observed.observation.wake.extinction
    for plan in plans:
        check_brightness(lidar, render, detector, mapping, truth, plan, air.albedo)


def image_names() -> tuple[str, ...]:
    """Parts of the result of `render_images`."""
    return IMAGES


def given_samples(
    render: Annotated[RenderSettings, Only("samples_per_beam")],
    scan: Annotated[Scan, Only("gate_count")],
) -> int:
    """Monte Carlo samples per beam, as given or by the number of gates."""
    return render.without_detector(scan.gate_count)


def samples_by_noise(
    observed: ObservedAir,
    lidar: BackscatterLidar,
    detector: Detector,
    scattering: Scattering,
    render: RenderSettings,
    seed: int,
    air: Scatterer,
    log: Log,
) -> int:
    """Monte Carlo samples per beam, by the noise of the detector; see `chosen_samples`."""
    chosen = chosen_samples(observed, lidar, detector, scattering, render, seed, air, log)
    log(samples_text(render, chosen))
    return chosen.number


@bundle
class Light:
    """How light goes from the lidar through the air, and how that is computed."""

    lidar: Annotated[BackscatterLidar, But("pulse_energy")]
    scattering: Scattering
    render: Annotated[RenderSettings, But(*CHOOSING)]
    seed: int
    air: Scatterer


def render_images(
    observed: ObservedAir,
    light: Light,
    samples: int,
    log: Log,
    missing: Sequence[str] = IMAGES,
    store: Store | None = None,
) -> Iterator[tuple[str, xr.Dataset]]:
    """Render the scans of both times without a detector's noise, one after the other.

    Yields
    ------
    name : str
        Of `IMAGES`.
    scan : xr.Dataset, dims (gate, z, y)
        From `render_scans`, with the depolarisation and what else it gives.
    """
    use_variant(light.render.variant)
    platform, scan, plans = observed.observation.platform, observed.observation.scan, observed.plans
    wanted = [IMAGES.index(name) for name in missing]
    log(f"rendering {len(wanted)} scans of {len(plans[0].y)} x {len(plans[0].z)} beams")

    def progress(index: int, done: int, total: int) -> None:
        log.bar(f"rendering scan {index + 1} of {len(plans)}", done / total)

    chosen = samples if light.render.samples_per_beam == "auto" else None
    rendered = _rendered(
        observed,
        _fields(observed, wanted, log),
        replace(light, render=with_samples(light.render, samples)),
        Series(wanted, progress, batches_of(IMAGES, store, log, chosen)),
    )
    motion = {"platform_speed": platform.speed, "dt": platform.dt}
    for index, image in zip(wanted, rendered, strict=True):
        image = with_products(image)
        image.attrs |= motion
        if plans[index].beams is not None:
            image.attrs["reference_time"] = index * platform.dt
            image.attrs["frozen_air"] = int(scan.air == "frozen")
        if said := untrusted_pixels(image):
            log.remark(f"{IMAGES[index]}: {said}")
        yield IMAGES[index], image


def _fields(observed: ObservedAir, wanted: Sequence[int], log: Log) -> list[xr.DataArray]:
    """The extinction that the beams of each scan meet, at their times if the air moves."""
    observation, truth, plans = observed.observation, observed.truth, observed.plans
    fields = list(truth.extinction)
    if observation.scan.air == "moving":
        for index, plan in enumerate(plans):
            if index in wanted and plan.beams is not None:
                log.bar(f"moving the air of scan {index + 1} of {len(plans)}", None)
                fields[index] = air_in_time(
                    observation, truth, observed.flows, index, plan.beams.time
                )
    return fields


def _rendered(
    observed: ObservedAir, fields: Sequence[xr.DataArray], light: Light, series: Series = ALL_IMAGES
) -> Iterator[xr.Dataset]:
    """The scans of these fields, from `render_scans`."""
    truth, plans, lidar = observed.truth, observed.plans, light.lidar
    around = ScatteringAir(
        environment_extinction(observed.observation.wake, truth),
        *light.air,
        molecules(truth.molecules, lidar.wavelength, light.scattering.band),
    )
    slabs, settings = _media(lidar, fields, plans), light.render.for_winds()
    return render_scans(slabs, plans, lidar, around, settings, light.seed, series)


def chosen_samples(
    observed: ObservedAir,
    lidar: BackscatterLidar,
    detector: Detector,
    scattering: Scattering,
    render: RenderSettings,
    seed: int,
    air: Scatterer,
    log: Log,
) -> Samples:
    """Samples per beam of both scans, from pilots of both.

    The scan of more noise decides. Other pilots of the same experiment give the same number. Where
    the experiment has a number, it is that, with what its noise is.
    """
    use_variant(render.variant)
    log.bar("choosing the number of samples", None)
    observation, truth, plans = observed.observation, observed.truth, observed.plans
    beams, gates = len(plans[0].y) * len(plans[0].z), plans[0].gate_count
    number, seed = pilot_samples(render, beams, gates), seed + PILOT_SEED
    # noise is that of air at the scan's reference time, which need not be moved for it
    light = Light(lidar, scattering, with_samples(render, number), seed, air)
    pilots = list(_rendered(observed, truth.extinction, light))
    pilots = with_pair_stderr(pilots, truth.wind, observation.platform.dt)
    pulses, mapping = observation.scan.pulses_per_beam, observation.wake.extinction
    choices = []
    for plan, pilot in zip(plans, pilots, strict=True):
        noisy = noisy_scan(pilot, lidar, detector, [seed, 0, 1], plan, pulses)
        least = least_samples(lidar, render, mapping, truth, plan)
        choices.append(choose_samples(noisy, number, render, least))
    return max(choices, key=lambda choice: (choice.number, choice.fraction))


def with_samples(render: RenderSettings, number: int) -> RenderSettings:
    """Settings with a number of samples per beam."""
    return render.model_copy(update={"samples_per_beam": number})


def samples_text(render: RenderSettings, chosen: Samples) -> str:
    """A number of samples, and what their noise is relative to that of the detector."""
    text = (
        f"{chosen.number} Monte Carlo samples per beam, with {chosen.fraction:.2g} times the "
        f"variance of the detector noise (median {chosen.median:.2g}, 90 % of the beams below "
        f"{chosen.upper:.2g})"
    )
    if chosen.reached:
        return text
    asked = render.monte_carlo_fraction
    return f"{text}; {asked:g} needs {chosen.needed}"


def batches_of(
    names: Sequence[str], store: Store | None, log: Log, samples: int | None = None
) -> Callable[[int], Batches] | None:
    """Storage of an image's samples while it is rendered, by its index among the names.

    samples: per beam, where that was chosen: stored ones of an image with another number are not
        used.
    """
    if store is None:
        return None

    def batches(index: int) -> Batches:
        name = names[index]

        def load() -> dict[str, Any] | None:
            unfinished = store.unfinished(name)
            if not unfinished or unfinished.pop("samples", samples) != samples:
                return None
            log(f"resuming {name}: {unfinished['passes']} passes are stored from an earlier run")
            return unfinished

        def save(arrays: dict[str, Any]) -> None:
            number = {} if samples is None else {"samples": np.array(samples)}
            store.store_unfinished(name, arrays | number)

        return Batches(load, save)

    return batches


def detect_images(
    observation: Observation,
    lidar: BackscatterLidar,
    detector: Detector | None,
    seed: int,
    truth: Truth,
    images: Mapping[str, xr.Dataset],
    plans: Sequence[ScanPlan],
) -> list[xr.Dataset]:
    """The images of all beams, with noisy ones in addition if there is a detector.

    Of common random numbers also ``S0_pair_stderr``, see `with_pair_stderr`.
    """
    # images are per emitted energy: those of another pulse energy are the same
    scans = [
        _on_nodes(images[name].assign_attrs(pulse_energy=lidar.pulse_energy), plan)
        for name, plan in zip(IMAGES, plans, strict=True)
    ]
    scans = with_pair_stderr(scans, truth.wind, observation.platform.dt)
    if detector is None:
        return scans
    # geometry and air are in single precision in a file: here they are known exactly
    air = {"environment_extinction": environment_extinction(observation.wake, truth)}
    pulses = observation.scan.pulses_per_beam
    # random numbers different from those of the light transport
    noisy = [
        noisy_scan(scan.assign_attrs(air), lidar, detector, [seed, index, 1], plan, pulses)
        for index, (scan, plan) in enumerate(zip(scans, plans, strict=True))
    ]
    return [scan.assign_attrs(monte_carlo_fraction=monte_carlo_fraction(scan)) for scan in noisy]


def with_pair_stderr(scans: Sequence[xr.Dataset], wind: xr.Dataset, dt: float) -> list[xr.Dataset]:
    """Scans with ``S0_pair_stderr``, the Monte Carlo error that the other scan does not share.

    By `unshared_fraction`, between the nodes that the true wind moves one into the other; errors
    of beams that were reported elsewhere are compared on the nodes. Unchanged without
    ``S0_mc_error``: errors of independent random numbers.
    """
    from lidar_mi.retrieval.images.gridding import on_nodes

    if any("S0_mc_error" not in scan for scan in scans):
        return list(scans)
    names = ["S0_mc_error", "S0_stderr"]
    places = ["y_reported", "z_reported"] if "y_reported" in scans[0] else []
    first, second = (scan[names + places].transpose("gate", "z", "y") for scan in scans)
    if places:
        first, second = on_nodes(first, errors=False), on_nodes(second, errors=False)
    moved = {}
    for axis, name in (("z", "w"), ("y", "v")):
        nodes, others = first[axis], second[axis].values
        there = nodes + dt * wind[name].interp(z=first["z"], y=first["y"])
        moved[axis] = ((there - others[0]) / (others[1] - others[0])).transpose("z", "y").values
    errors = first["S0_mc_error"], second["S0_mc_error"], first["S0_stderr"]
    fractions = np.stack(
        [
            unshared_fraction(a, b, c, moved["z"], moved["y"])
            for a, b, c in zip(*(one.values.astype(float) for one in errors), strict=True)
        ]
    )
    images = []
    for scan in scans:
        fraction = xr.DataArray(fractions, first["S0_stderr"].coords, ("gate", "z", "y"))
        if places:
            at = {
                axis: scan[f"{axis}_reported"].clip(*first[axis].values[[0, -1]]) for axis in "zy"
            }
            fraction = fraction.interp(at).drop_vars(["z", "y"], errors="ignore")
        error = scan["S0_stderr"].transpose("gate", "z", "y")
        values = (error.values * np.sqrt(fraction.values)).astype(np.float32)
        images.append(scan.assign(S0_pair_stderr=(("gate", "z", "y"), values)))
    return images


def _on_nodes(scan: xr.Dataset, plan: ScanPlan) -> xr.Dataset:
    """A scan on its plan's nodes, which a file has in single precision: those of the truth."""
    nodes = {axis: (axis, getattr(plan, axis), scan[axis].attrs) for axis in ("y", "z")}
    return scan.assign_coords(nodes)


def gridded_scans(platform: Platform, detected: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """The scans, on regular nodes where beams were reported elsewhere; see `synchronised`."""
    from lidar_mi.retrieval.wind.synchronised import synchronised

    if any("y_reported" not in scan for scan in detected):
        return list(detected)
    # times in double precision, so that those of a node are not rounded twice
    scans = [scan.assign(beam_time=scan["beam_time"].astype(float)) for scan in detected]
    image = "Y_noisy" if "Y_noisy" in scans[0] else "Y"
    gridded = synchronised(scans, [platform.dt], image)
    return [scan.assign_attrs(gridded=1) for scan in gridded]


def detector_noise(
    lidar: BackscatterLidar, detector: Detector, scan: Scan, detected: Sequence[xr.Dataset]
) -> dict[str, float]:
    """Contributions to the noise of the first scan, see `noise_budget`."""
    return noise_budget(detected[0], lidar, detector, scan.pulses_per_beam)


def _media(
    lidar: BackscatterLidar, fields: Sequence[xr.DataArray], plans: Sequence[ScanPlan]
) -> list[xr.DataArray]:
    """The extinction at both times, extended to the depth and width of the beams."""
    if fields[0].sizes["x"] > 1:
        return list(fields)
    # one extent for both scans: they meet the same air
    reach = max(plans, key=lambda plan: plan.gate_stop)
    return [
        extrude(field.isel(x=0).transpose(..., "z", "y"), reach, lidar, plans) for field in fields
    ]
