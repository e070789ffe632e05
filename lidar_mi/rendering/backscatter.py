"""Images of the backscatter lidar: a Mitsuba scene from an extinction field and a scan."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.errors import InputError
from lidar_mi.instrument.attenuated_backscatter import attenuated_backscatter
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.io.exr import label_scan, unpack
from lidar_mi.rendering.batches import ALL_IMAGES, Batches, Series
from lidar_mi.rendering.memory import samples_at_once
from lidar_mi.rendering.passes import within_memory
from lidar_mi.rendering.phase import Molecules, ScatteringAir, loadable
from lidar_mi.rendering.settings import RenderSettings

MOST_CELLS = 1e8  # of an extended plane: 0.8 GB


def extrude(
    plane: xr.DataArray, plan: ScanPlan, lidar: BackscatterLidar, scans: Sequence[ScanPlan] = ()
) -> xr.DataArray:
    """A plane of air (z, y) extended to the depth and width of all beams of the scan, (x, y, z).

    Beams are wide and oblique: at the slab's faces and rims some of their light crosses outside
    the gate's planes and the outermost nodes. The plane is extended by that much (the outermost
    values repeated), so that the whole gate is filled with it.

    plane (z, y) or (time, z, y) array
    plan: the scan from farthest away.
    scans: all scans that have beams of their own: these may be more oblique, or miss the plane.

    Raises InputError: beams so wide that the extended plane would not fit into the memory.
    """
    radius = beam_reach(lidar, plan.gate_stop)
    slope = np.hypot(np.abs(plan.y).max(), np.abs(plan.z).max()) / plan.centre
    oblique = plan.obliquity().max()
    # how far outside of the plane beams cross: before and behind it along y and z
    margins = np.zeros((2, 2))
    for beams in (scan.beams for scan in scans):
        if beams is not None:
            secant = 1 / beams.direction[:, 0]
            oblique = max(oblique, secant.max())
            slope = max(slope, np.sqrt(secant.max() ** 2 - 1))
            places = beams.true_places(plan.centre + plan.position)
            ends = np.array([plane[axis].values[[0, -1]] for axis in ("y", "z")])
            outside = np.stack([ends[:, 0] - places.min(0), places.max(0) - ends[:, 1]], 1)
            margins = np.maximum(margins, outside)
    # spherical gates are curved: their rim lies nearer by the beam's obliquity
    bulge = (oblique - 1) * plan.gate_stop if plan.gate_kind == "spherical" else 0
    margin = radius * slope + bulge
    pad = {}
    for axis, sides in zip(("y", "z"), margins, strict=True):
        before, behind = np.ceil((radius + sides) / _spacing(plane, axis)).astype(int)
        pad[axis] = (int(before), int(behind))
    cells = math.prod(plane.sizes[axis] + sum(n) for axis, n in pad.items())
    if cells > MOST_CELLS:
        raise InputError(
            f"scan.range: {plan.gate_stop:g} m is not allowed with beams that spread by "
            f"{radius:.3g} m until there; the plane would have {cells:.2g} nodes, expected at most "
            f"{MOST_CELLS:g} (a narrower beam, a nearer range or a coarser wake.spacing)"
        )
    padded = plane.pad(pad, mode="edge")
    for axis, (n, _) in pad.items():
        start = float(plane[axis][0]) - n * _spacing(plane, axis)
        padded[axis] = start + _spacing(plane, axis) * np.arange(padded.sizes[axis])
    thickness = plan.gate_stop - plan.gate_start + 2 * margin
    solid = padded.expand_dims(x=[plan.centre + plan.position]).transpose(..., "x", "y", "z")
    solid["x"].attrs["cell_width"] = thickness
    return solid


def beam_reach(lidar: BackscatterLidar, distance: float) -> float:
    """Distance from a beam's axis that its light does not exceed, m, at a distance in m."""
    radius = lidar.beam_cut if np.isfinite(lidar.beam_cut) else 3 * lidar.beam_radius
    # the Gaussian divergence exceeds 2.2 times its 1/e^2 angle once in 16 000 samples
    return radius + 2.2 * lidar.divergence_full / 2 * distance


def render_scans(
    extinctions: Sequence[xr.DataArray],
    plans: Sequence[ScanPlan],
    lidar: BackscatterLidar,
    air: ScatteringAir,
    settings: RenderSettings,
    seed: int,
    series: Series = ALL_IMAGES,
) -> Iterator[xr.Dataset]:
    """Render one scan after the other in one scene; only the first compiles anything.

    extinctions (sequence of (x, y, z) arrays): extinction coefficient (m^-1) at cell centres, x
        from the telescope's place at the first scan, all on one grid; a single x plane has its
        depth in ``x.attrs["cell_width"]``. With a first dimension ``time`` (s, equally spaced, from
        the scan's reference time) every beam meets the air of its own time, linear between these
        states.
    air: around the slab and up to it; its molecules are part of all ``extinctions``.
    seed: scan k uses `RenderSettings.scan_seed`: seed + k * 2^16, well separated for neighbouring
        experiments, or with common random numbers the same seed.
    series: which of the scans to render.

    Yields
    ------
    xr.Dataset
        S0 ... S3, S0_stderr, S0_largest_share (of one sample in the variance) and, with more than
        one order, each order's S0 as ``orderK.S0``, dims (gate, z, y); Y (z, y); y and z ascending.
        With common random numbers S0_mc_error, a realisation of the Monte Carlo error of S0.
        Of polarised variants also S1_stderr, S2_stderr, S3_stderr and S0_S1_correlation.
        Where a plan has beams, also ``beam_time`` (s) and ``y_reported``, ``z_reported`` (m), where
        a beam as reported crosses the plane in the middle of the gates. One scan at a time, as soon
        as it is rendered.
    """
    renderer = None
    for index in range(len(plans)) if series.wanted is None else series.wanted:
        extinction, plan = extinctions[index], plans[index]
        if renderer is None:
            renderer = ScanRenderer(extinction, plan, lidar, air, settings)
        report = partial(series.progress, index) if series.progress else None
        store = series.batches(index) if series.batches else None
        yield renderer.render(extinction, plan, settings.scan_seed(seed, index), report, store)


class ScanRenderer:
    """A scene that is reused from scan to scan; only the first scan compiles anything.

    extinction (x, y, z): of the first scan; those of all others are on its grid.
    plan: of the first scan; all others have as many beams and gates.
    lidar, air, settings: as `render_scans` takes them.
    """

    def __init__(
        self,
        extinction: xr.DataArray,
        plan: ScanPlan,
        lidar: BackscatterLidar,
        air: ScatteringAir,
        settings: RenderSettings,
    ) -> None:
        import mitsuba as mi

        self._scene = mi.load_dict(scene_dict(extinction, plan, lidar, air, settings))
        self._parameters = mi.traverse(self._scene)
        self._lidar, self._air, self._settings = lidar, air, settings

    def render(
        self,
        extinction: xr.DataArray,
        plan: ScanPlan,
        seed: int,
        progress: Callable[[int, int], None] | None = None,
        batches: Batches | None = None,
    ) -> xr.Dataset:
        """One scan, as `render_scans` yields it.

        seed: the header of an image holds 31 bits of it.
        progress: called with (samples done, samples in all).
        batches: store of the samples while they are rendered.
        """
        import drjit as dr
        import mitsuba as mi

        _move(self._parameters, extinction, plan, self._air)
        integrator = self._scene.integrator()
        integrator.progress, integrator.batches = progress, batches
        start = time.perf_counter()
        seed %= 2**31  # a header holds 32 bits with a sign
        image = within_memory(integrator, lambda: np.array(mi.render(self._scene, seed=seed)))
        dr.flush_malloc_cache()  # the buffers of the tracing are as large as the image
        names, environment = integrator.quantities(), self._air.extinction
        scan = _as_dataset(image, names, plan, self._lidar, environment, self._settings, seed)
        earlier = batches.seconds if batches else 0.0
        scan.attrs |= {"lit_pixels": integrator.lit, "untrusted_pixels": integrator.untrusted}
        scan.attrs["render_seconds"] = earlier + time.perf_counter() - start
        return scan


def scene_dict(
    extinction: xr.DataArray,
    plan: ScanPlan,
    lidar: BackscatterLidar,
    air: ScatteringAir,
    settings: RenderSettings,
) -> dict[str, Any]:
    """The Mitsuba scene of one scan as a dictionary for ``mi.load_dict``."""
    import mitsuba as mi

    samples = settings.without_detector(plan.gate_count)
    low, high = _box(extinction)
    place = mi.ScalarTransform4f().translate(low).scale(high - low)

    def volume(field: xr.DataArray) -> dict[str, Any]:
        if "time" in field.dims:
            data = mi.TensorXf(_voxels(field)[..., 0])
            return {"type": "moving_volume", "data": data, "to_world": place, **_ends(field)}
        grid = mi.VolumeGrid(_voxels(field))
        return {"type": "gridvolume", "grid": grid, "to_world": place, "accel": False}

    phase = loadable(air.phase)
    around = within = {"albedo": air.albedo, "phase": phase}
    if air.molecules:
        mixed_albedo, fraction = _mixed(xr.DataArray(air.extinction), air.albedo, air.molecules)
        mixture = _blend(phase, air.molecules, float(fraction))
        around = {"albedo": float(mixed_albedo), "phase": mixture}
        mixed_albedo, fraction = _mixed(extinction, air.albedo, air.molecules)
        mixture = _blend(phase, air.molecules, volume(fraction))
        within = {"albedo": volume(mixed_albedo), "phase": mixture}
    return {
        "type": "scene",
        "integrator": {
            "type": "gated_volpath",
            "max_order": settings.max_order,
            "orders": settings.max_order > 1,
            "covariance": mi.is_polarized,
            "shares": True,
            "estimator": settings.estimator,
            "random_numbers": "common" if settings.common else "independent",
            "candidates": settings.candidates,
            "samples_per_pass": samples_at_once(
                settings.given_per_pass, settings.memory, mi.variant()
            ),
        },
        "environment": {"type": "homogeneous", "sigma_t": air.extinction, **around},
        "sensor": {
            "type": "scanning_lidar",
            "aperture_radius": lidar.aperture_radius,
            "fov_half_mrad": lidar.fov_half * 1e3,
            "gate_kind": plan.gate_kind,
            "gate_start": plan.gate_start,
            "gate_stop": plan.gate_stop,
            "gate_count": plan.gate_count,
            "beams": mi.TensorXf(_beams(plan)),
            "to_world": mi.ScalarTransform4f().translate([plan.position, *plan.aside]),
            "laser": {
                "type": "laser",
                "beam_radius": lidar.beam_radius,
                "beam_cut": lidar.beam_cut,
                "divergence_full_mrad": lidar.divergence_full * 1e3,
                "stokes": ", ".join(map(repr, lidar.stokes)),
                "wavelength": lidar.wavelength,
                "pulse_energy": lidar.pulse_energy,
                "pulse_duration": lidar.pulse_duration,
            },
            "film": {
                "type": "hdrfilm",
                "width": len(plan.y),
                "height": len(plan.z),
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
            "medium": {"type": "ref", "id": "environment"},
        },
        "slab": {
            "type": "cube",
            "to_world": place @ mi.ScalarTransform4f().translate(0.5).scale(0.5),
            "bsdf": {"type": "null"},
            "interior": {"type": "heterogeneous", "sigma_t": volume(extinction), **within},
            "exterior": {"type": "ref", "id": "environment"},
        },
    }


def _mixed(
    extinction: xr.DataArray, albedo: float, molecules: Molecules
) -> tuple[xr.DataArray, xr.DataArray]:
    """Albedo of air, and the fraction of its scattering that is molecular."""
    by_molecules = molecules.albedo * molecules.extinction
    # rounding may leave a little less extinction than the molecules'
    by_others = albedo * xr.ufuncs.maximum(extinction - molecules.extinction, 0)
    return (by_molecules + by_others) / extinction, by_molecules / (by_molecules + by_others)


def _blend(
    phase: dict[str, Any], molecules: Molecules, fraction: float | dict[str, Any]
) -> dict[str, Any]:
    return {"type": "blendphase", "weight": fraction, "others": phase, "molecules": molecules.phase}


def _move(parameters: Any, extinction: xr.DataArray, plan: ScanPlan, air: ScatteringAir) -> None:
    """Update the telescope, its beams and the air in the slab to a later scan."""
    import mitsuba as mi

    parameters["sensor.to_world"] = mi.Transform4f().translate([plan.position, *plan.aside])
    beams = _beams(plan)
    parameters["sensor.origins"] = mi.Float(beams[:, :3].ravel())
    parameters["sensor.directions"] = mi.Float(beams[:, 3:6].ravel())
    parameters["sensor.times"] = mi.Float(beams[:, 6])
    parameters["sensor.gate_start"] = plan.gate_start
    parameters["sensor.gate_stop"] = plan.gate_stop
    fields = {"sigma_t": extinction}
    if air.molecules:
        mixed_albedo, fraction = _mixed(extinction, air.albedo, air.molecules)
        fields |= {"albedo": mixed_albedo, "phase_function.weight": fraction}
    for name, field in fields.items():
        parameters[f"slab.interior_medium.{name}.data"] = mi.TensorXf(_voxels(field))
        if "time" in field.dims:
            for end, time in _ends(field).items():
                parameters[f"slab.interior_medium.{name}.{end}"] = time
    parameters.update()


def _beams(plan: ScanPlan) -> np.ndarray:
    """Origin in the telescope's frame, direction and time of the true beams, (n, 7)."""
    if plan.beams is None:
        directions = plan.directions()
        return np.column_stack([np.zeros_like(directions), directions, np.zeros(len(directions))])
    origins = plan.beams.origin - [plan.position, 0, 0]
    return np.column_stack([origins, plan.beams.direction, plan.beams.time])


def _voxels(extinction: xr.DataArray) -> np.ndarray:
    """Values in the order of a Mitsuba volume grid: time if there is one, z, y, x, channel."""
    return extinction.transpose(..., "z", "y", "x").values[..., None].astype(np.float32)


def _ends(field: xr.DataArray) -> dict[str, float]:
    """Times of the first and last state of moving air, s."""
    return {"time_start": float(field["time"][0]), "time_stop": float(field["time"][-1])}


def _spacing(field: xr.DataArray, axis: str) -> float:
    return float(field[axis][1] - field[axis][0])


def _box(extinction: xr.DataArray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the grid; values sit at cell centres, so it ends half a cell beyond them."""
    low, high = [], []
    for axis in ("x", "y", "z"):
        nodes = extinction[axis]
        half = (nodes.attrs["cell_width"] if len(nodes) == 1 else _spacing(extinction, axis)) / 2
        low.append(float(nodes[0]) - half)
        high.append(float(nodes[-1]) + half)
    return np.array(low), np.array(high)


def _as_dataset(
    image: np.ndarray,
    names: list[str],
    plan: ScanPlan,
    lidar: BackscatterLidar,
    environment: float,
    settings: RenderSettings,
    seed: int,
) -> xr.Dataset:
    """The rendered tensor (rows from the top, y falling) as a labelled dataset."""
    import mitsuba as mi

    variables = unpack(image, names, plan.gate_count)
    y = attenuated_backscatter(variables["S0"][1], plan, lidar.aperture_area, environment)
    variables["Y"] = (("z", "y"), y[0].astype(np.float32))
    timed = {}
    if plan.beams is not None:
        places = plan.beams.reported_places(plan.position + plan.centre)
        for name, values in (
            ("beam_time", plan.beams.time),
            ("y_reported", places[:, 0]),
            ("z_reported", places[:, 1]),
        ):
            variables[name] = (("z", "y"), plan.as_image(values).astype(np.float32))
        timed = {"timed": 1, "gridded": 0}
    attributes = {
        "software": f"lidar-mi {__version__}",
        "units": "Stokes: received over emitted energy; Y: m-1 sr-1; lengths: m; angles: rad",
        "variant": mi.variant(),
        "polarized": int(mi.is_polarized),
        "seed": int(seed),
        "samples_per_beam": settings.without_detector(plan.gate_count),
        "max_order": settings.max_order,
        "estimator": settings.estimator,
        "random_numbers": "common" if settings.common else "independent",
        "gate_kind": plan.gate_kind,
        "gate_count": plan.gate_count,
        "gate_start": float(plan.gate_start),
        "gate_stop": float(plan.gate_stop),
        "telescope_position": float(plan.position),
        "environment_extinction": float(environment),
        "wavelength": lidar.wavelength,
        "beam_radius": lidar.beam_radius,
        "beam_cut": lidar.beam_cut,
        "divergence_full": lidar.divergence_full,
        "pulse_energy": lidar.pulse_energy,
        "pulse_duration": lidar.pulse_duration,
        "stokes_emitted": list(lidar.stokes),
        "aperture_radius": lidar.aperture_radius,
        "fov_half": lidar.fov_half,
        **timed,
    }
    return label_scan(
        xr.Dataset(
            variables,
            coords={"gate": np.arange(plan.gate_count), "y": plan.y, "z": plan.z},
            attrs=attributes,
        )
    )
