"""Wind in three dimensions: all gates of two scans as volumes, the flow between them.

The backscatter lidar observes the same stack of thin slabs twice. Beams spread from gate to gate,
and the telescope moves between the scans: both stacks are interpolated to one grid in the air.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.image_pair import Pair, both, combined_noise
from lidar_mi.experiment.stages.rendering import environment_extinction
from lidar_mi.experiment.stages.winds import retrieval_device
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows
from lidar_mi.instrument.attenuated_backscatter import attenuated_backscatter
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.rendering.pair_error import pair_stderr
from lidar_mi.retrieval.images.window_sizes import check_window_sizes
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.volume import Volume
from lidar_mi.schema.wake import Wake


@dataclass(frozen=True)
class Volumes:
    """Pairs of volumes by source, and their noise.

    pairs (x, z, y): attenuated backscatter at both times, m^-1 sr^-1, by `Source`.
    noise (x, z, y): standard error of the first volume of each, same unit.
    """

    pairs: dict[str, Pair]
    noise: dict[str, xr.DataArray]


def check_volume(
    wake: Wake, scan: Scan, volume: Volume, flows: Flows, plans: Sequence[ScanPlan]
) -> None:
    """Check that a wind in three dimensions can be retrieved.

    Raises InputError: a wake without wind along x, gates that reach beyond it, fewer gates or beams
    than a window has voxels.
    """
    if "u" not in flows[0]:
        raise InputError("wake.file: no wind along x (u) in it; expected u, v and w for volume")
    _check_gates(scan, flows[0])
    shape = tuple(map(len, grid(wake, scan, plans)))
    # refuses fewer voxels than a window has
    check_window_sizes(shape, volume.template, volume.search, volume.stride)


def _check_gates(scan: Scan, flow: xr.Dataset) -> None:
    x = flow["x"].values
    # a plane fills half a step on either side
    half = (x[1] - x[0]) / 2
    if scan.range < x[0] - half or scan.range + scan.thickness > x[-1] + half:
        raise InputError(
            f"scan.thickness: gates from {scan.range:g} to {scan.range + scan.thickness:g} m reach "
            f"beyond the wake, whose planes fill {x[0] - half:g} to {x[-1] + half:g} m; expected "
            "gates inside"
        )


def grid(wake: Wake, scan: Scan, plans: Sequence[ScanPlan]) -> tuple[np.ndarray, ...]:
    """Nodes x, z, y (m) of the volumes: middles of the gates at t1, and what all gates cover.

    Along z and y whole multiples of wake.spacing, inside the beams of the nearest gate.
    """
    spacing = wake.spacing
    edges = np.linspace(0, scan.thickness, scan.gate_count + 1)
    x = scan.range + (edges[1:] + edges[:-1]) / 2
    nodes = [x]
    for axis in ("z", "y"):
        places = [_places(plan, axis)[0] for plan in plans]
        low, high = max(p[0] for p in places), min(p[-1] for p in places)
        # rounding must not lose the nodes at the rim
        first = np.ceil(low / spacing - 1e-6)
        nodes.append(spacing * np.arange(first, np.floor(high / spacing + 1e-6) + 1))
    return tuple(nodes)


def _places(plan: ScanPlan, axis: str) -> np.ndarray:
    """Positions of the beams in the middles of the gates, (gates, beams), m."""
    edges = np.linspace(plan.gate_start, plan.gate_stop, plan.gate_count + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    # beams spread in proportion to the distance, planar gates cut them at one x
    return middle[:, None] / plan.centre * getattr(plan, axis)


def scan_volume(
    s0: xr.DataArray,
    plan: ScanPlan,
    lidar: BackscatterLidar,
    environment: float,
    nodes: tuple[np.ndarray, ...],
) -> xr.DataArray:
    """Attenuated backscatter (m^-1 sr^-1) of all gates on one grid in the air, dims (x, z, y).

    Gate by gate by bicubic splines, from the beams to the nodes. Beams are wider than gates are
    thick, so that little structure is lost. The variance of white noise is reduced to 0.76 in the
    mean, that of its long waves is not.

    s0 (gate, z, y): received energy over emitted pulse energy.
    plan: planar gates.
    environment: extinction coefficient up to the gates, m^-1.
    nodes (x, z, y of the grid, m): x in the frame of the air, one per gate; inside the beams of
        every gate.
    """
    from lidar_mi.retrieval.images.common_grid import resample

    x, z, y = nodes
    values = attenuated_backscatter(
        s0.transpose("gate", "z", "y").values, plan, lidar.aperture_area, environment
    )
    volume = np.empty((len(x), len(z), len(y)))
    for gate, (row, column) in enumerate(zip(_places(plan, "z"), _places(plan, "y"), strict=True)):
        image = xr.DataArray(
            values[gate],
            {"z": ("z", row, {"units": "m"}), "y": ("y", column, {"units": "m"})},
            ("z", "y"),
        )
        volume[gate] = resample(image, y, z).values
    coords = {name: (name, axis, {"units": "m"}) for name, axis in zip("xzy", nodes, strict=True)}
    about = {
        "long_name": "attenuated backscatter coefficient, corrected for range and environment",
        "units": "m-1 sr-1",
    }
    return xr.DataArray(volume, coords, ("x", "z", "y"), attrs=about)


def noise_map(error: np.ndarray, plan: ScanPlan, nodes: tuple[np.ndarray, ...]) -> xr.DataArray:
    """Level of the noise (m^-1 sr^-1) in the voxels of `scan_volume`, dims (x, z, y).

    The variance is linear between beams. Splines between the beams take noise from short waves
    alone: their values add to the same constant everywhere. In waves as long as texture the noise
    has the spectral density of that of the beams, and this is what retrievals take. The error
    (gates, z, y) is that of the attenuated backscatter of every beam; nodes are x, z, y (m).
    """
    _, z, y = nodes
    mesh = np.stack(np.meshgrid(z, y, indexing="ij"), -1)
    variance = [
        scipy.interpolate.RegularGridInterpolator((row, column), square)(mesh)
        for square, row, column in zip(
            error**2, _places(plan, "z"), _places(plan, "y"), strict=True
        )
    ]
    coords = {name: (name, axis, {"units": "m"}) for name, axis in zip("xzy", nodes, strict=True)}
    about = {"long_name": "standard error of the backscatter", "units": "m-1 sr-1"}
    return xr.DataArray(np.sqrt(variance), coords, ("x", "z", "y"), attrs=about)


def scan_volumes(
    wake: Wake,
    scan: Scan,
    lidar: BackscatterLidar,
    detector: Detector | None,
    truth: Truth,
    plans: Sequence[ScanPlan],
    scans: Sequence[xr.Dataset],
) -> Volumes:
    """Both scans as volumes on one grid in the air, without and with a detector's noise."""
    nodes, way = grid(wake, scan, plans), environment_extinction(wake, truth)

    def of_scan(number: int, name: str) -> xr.DataArray:
        return scan_volume(scans[number][name], plans[number], lidar, way, nodes)

    def level(error: xr.DataArray) -> xr.DataArray:
        values = attenuated_backscatter(
            error.transpose("gate", "z", "y").values, plans[0], lidar.aperture_area, way
        )
        return noise_map(values, plans[0], nodes)

    first = scans[0]
    pairs: dict[str, Pair] = {Source.BACKSCATTER: both(lambda k: of_scan(k, "S0"))}
    noise: dict[str, xr.DataArray] = {Source.BACKSCATTER: level(pair_stderr(first))}
    if detector:
        pairs[Source.NOISY] = both(lambda k: of_scan(k, "S0_noisy"))
        noise[Source.NOISY] = level(combined_noise(pair_stderr(first), first["S0_noise_std"]))
    return Volumes(pairs, noise)


def volume_winds(
    name: str,
    platform: Platform,
    scan: Scan,
    volume: Volume,
    device: str | None,
    flows: Flows,
    volumes: Volumes,
    log: Log,
) -> xr.Dataset:
    """Winds by every method from every pair of volumes, with the truth at their places.

    Returns
    -------
    xr.Dataset, dims (source, algorithm, x, z, y)
        The variables of `retrieve_wind_volume` and ``u_true``, ``v_true``, ``w_true`` (m s^-1).
    """
    from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes
    from lidar_mi.retrieval.wind.volume import retrieve_wind_volume

    sources = []
    for source, pair in volumes.pairs.items():
        methods = []
        for number, method in enumerate(volume.methods):
            log(f"retrieving winds from {source.replace('_', ' ')} by {method}")
            log.bar(f"retrieving winds by {method}", number / len(volume.methods))
            methods.append(
                retrieve_wind_volume(
                    pair[0],
                    pair[1],
                    platform.dt,
                    method,
                    windows=WindowSizes(volume.template, volume.search, volume.stride),
                    validation=VectorValidation(volume.min_correlation),
                    noise=volumes.noise[source],
                    device=retrieval_device(device),
                )
            )
        # attributes of single methods are not those of all
        sources.append(xr.concat(methods, "algorithm", combine_attrs="drop_conflicts"))
    winds = xr.concat(sources, "source", combine_attrs="drop_conflicts")
    winds = winds.assign_coords(source=list(volumes.pairs), algorithm=list(volume.methods))
    # the gates move with the mean wind, which is 0 in their frame
    about = winds["u"].attrs
    winds["u"] = (winds["u"] + scan.follow).assign_attrs(about)
    for component, values in true_wind(flows[0], winds).items():
        winds[f"{component}_true"] = values
    winds.attrs |= {
        "title": f"Wind in three dimensions of the experiment {name}",
        "source": f"lidar-mi {__version__}",
    }
    return winds


def true_wind(flow: xr.Dataset, places: xr.Dataset) -> dict[str, xr.DataArray]:
    """u, v, w of a flow on (x, y, z) at the places x, z, y of a data set, by cubic splines."""
    axes = [flow[axis].values for axis in ("x", "y", "z")]
    at = [(places[axis].values - n[0]) / (n[1] - n[0]) for axis, n in zip("xyz", axes, strict=True)]
    mesh = np.stack(np.meshgrid(*at, indexing="ij"))
    coords = {axis: places[axis] for axis in ("x", "z", "y")}
    means = {}
    for name in ("u", "v", "w"):
        values = flow[name].transpose("x", "y", "z").values
        values = scipy.ndimage.map_coordinates(values, mesh, order=3, mode="nearest").transpose(
            0, 2, 1
        )
        about = {"long_name": f"true {name}", "units": "m s-1"}
        means[name] = xr.DataArray(values.astype(np.float32), coords, ("x", "z", "y"), attrs=about)
    return means
