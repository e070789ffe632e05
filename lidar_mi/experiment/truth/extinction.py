"""The truth of an experiment: extinction at both times and wind, in the frame of the lidar."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

import lidar_mi.plots  # noqa: F401 - truth.wind.lidar.plot()
from lidar_mi.arguments import checked_arguments
from lidar_mi.atmosphere.extinction import extinction_from_speed, extinction_from_tracer
from lidar_mi.atmosphere.texture import corrsin_obukhov
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import bundle, call
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.truth.clear_air import ClearAir, clear_air
from lidar_mi.experiment.truth.flows import Advection, Flows, advection_by, flows_of, mean_flow
from lidar_mi.experiment.truth.slab import slab_mean
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.wake import ExtinctionMapping


class Later(Sequence[xr.DataArray]):
    """A field at t1 and t2; that at t2 is advected on first use.

    Advection of a volume takes seconds, and nothing that is checked before a run needs it.
    """

    def __init__(self, first: xr.DataArray, second: Callable[[], xr.DataArray]) -> None:
        self._at = (lambda: first, functools.cache(second))

    def __len__(self) -> int:
        return len(self._at)

    def __getitem__(self, which: int) -> xr.DataArray:  # type: ignore[override]
        return self._at[which]()


@dataclass(frozen=True)
class Truth:
    """The observed air, in the lidar's frame at t1 (metres, m^-1, m s^-1).

    ``extinction`` and ``smooth`` (without sub-grid texture) hold the fields at t1 and t2, dims
    (x, y, z), of them ``molecules`` by clear air; ``wind`` has v, w on (z, y), averaged over the
    depth of the first gate.
    """

    extinction: Sequence[xr.DataArray]
    smooth: Sequence[xr.DataArray]
    wind: xr.Dataset
    molecules: float = 0.0

    def image(self, which: int, smooth: bool = False) -> xr.DataArray:
        """Extinction averaged over depth as an image (z, y): that of an ideal lidar."""
        field = (self.smooth if smooth else self.extinction)[which]
        return slab_mean(field, self.wind.attrs["gates"])


@bundle
class ObservedAir:
    """What images are made from: the true air, and the scans of it."""

    observation: Observation
    flows: Flows
    truth: Truth
    plans: Sequence[ScanPlan]


@checked_arguments
def make_truth(
    experiment: Experiment,
    beside: str | Path | None = None,
    flows: Flows | None = None,
    advected: Advection | None = None,
) -> Truth:
    """The flow and the extinction at both times, on the scan's grid, in the lidar's frame.

    Parameters
    ----------
    experiment : Experiment
    beside : path, optional
        Folder in which the wake's file is searched first. Default: the experiment's.
    flows : optional
        From `read_flows` of an experiment that differs in extinction and texture alone.
    advected : callable, optional
        From `advection_by` the same flows.

    Returns
    -------
    Truth
        ``wind`` (Dataset, m/s), ``extinction`` (at t1 and at t2, 1/m); ``image(k)`` is the
        extinction over (z, y) as the lidar images it.

    Raises
    ------
    InputError
        A file that is missing or inconsistent with the experiment; an experiment without a wake.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> experiment = lm.load_experiment("wake_backscatter")
    >>> truth = lm.make_truth(experiment)
    >>> truth.wind["v"].dims, len(truth.extinction)
    (('z', 'y'), 2)
    """
    if experiment.imaged_wake is None:
        raise InputError(
            f"wake: missing in {experiment.name}; expected the section of a wake that a "
            "backscatter lidar observes"
        )
    search_path = experiment.folder if beside is None else Path(beside)
    if flows is None:
        flows = flows_of(experiment, search_path)
    clear = call(clear_air, experiment, search_path=search_path)
    return call(true_air, experiment, flows=flows, clear_air=clear, advected=advected)


def true_air(
    observation: Observation,
    seed: int,
    flows: Flows,
    clear_air: ClearAir,
    *,
    advected: Advection | None = None,
) -> Truth:
    """As `make_truth`.

    Flows come from `read_flows`, the clear air is that at the site.
    """
    first, second = flows
    wake, scan = observation.wake, observation.scan
    mapping, molecules = wake.extinction, clear_air.extinction
    flow = mean_flow((first, second))
    advected = advected or advection_by(observation, flows)
    smooth1 = extinction_of(first, mapping, first, second)
    texture = wake.texture
    factor = xr.DataArray(1.0)
    if texture.rms > 0:
        x = first["x"].values if first.sizes["x"] > 1 else None
        factor = corrsin_obukhov(
            first["y"].values, first["z"].values, texture.rms, texture.outer_scale, seed, x=x
        )
        if x is None:
            factor = factor.expand_dims(x=first["x"].values)
        factor = factor.assign_coords(first.coords).transpose("x", "y", "z")
    textured1 = smooth1 * factor if texture.rms > 0 else smooth1

    @functools.cache
    def smooth2() -> xr.DataArray:
        if second is None:
            return advected(smooth1)
        return extinction_of(second, mapping, first, second)

    def textured2() -> xr.DataArray:
        if texture.rms == 0:
            return smooth2()
        return advected(textured1) if second is None else smooth2() * advected(factor)

    # winds are retrieved from the first gate
    depth = scan.thickness / scan.gate_count
    gates = (scan.range, scan.range + depth)
    components = [name for name in ("u", "v", "w") if name in flow]
    wind = xr.Dataset({name: slab_mean(flow[name], gates) for name in components})
    wind.attrs["gates"] = gates

    def with_molecules(field: xr.DataArray) -> xr.DataArray:
        return field.copy(data=field.values + molecules)

    return Truth(
        Later(with_molecules(textured1), lambda: with_molecules(textured2())),
        Later(with_molecules(smooth1), lambda: with_molecules(smooth2())),
        wind,
        molecules,
    )


def extinction_of(
    flow: xr.Dataset, mapping: ExtinctionMapping, first: xr.Dataset, second: xr.Dataset | None
) -> xr.DataArray:
    """Extinction (m^-1) of one state of a flow, scaled by the largest value of both."""
    limits = {"background": mapping.background, "maximum": mapping.maximum}
    states = [s for s in (first, second) if s is not None]
    if mapping.source == "speed":
        fastest = max(float(np.hypot(s["v"], s["w"]).max()) for s in states)
        field = extinction_from_speed(flow, **limits, stretch=mapping.stretch, reference=fastest)
    else:
        # an analytic flow has neither: then there is only the background
        tracer = "tracer" if mapping.tracer and "tracer" in flow else None
        aerosol = "aerosol" if mapping.aerosol and "aerosol" in flow else None
        if tracer is None and aerosol is None:
            field = xr.full_like(flow["v"], mapping.background)
            field.attrs = {"long_name": "extinction coefficient", "units": "m-1"}
            return field.transpose("x", "y", "z")
        densest = max(float(s[tracer].max()) for s in states) if tracer else None
        field = extinction_from_tracer(
            flow,
            **limits,
            stretch=mapping.stretch,
            tracer=tracer,
            aerosol=aerosol,
            reference=densest,
        )
    return field.transpose("x", "y", "z")
