"""The lidar as an object that is stepped: light, detector, and the estimate from their signals."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.arguments import checked_arguments
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.lidar.combination import Completion
from lidar_mi.encounter.lidar.computer import Cores
from lidar_mi.encounter.lidar.doppler import LineFrames, Midway, doppler_scans
from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.encounter.lidar.estimator import Estimator, SlabEstimate
from lidar_mi.encounter.lidar.line_speeds import LineSpeeds
from lidar_mi.encounter.lidar.pointing import pointing_error
from lidar_mi.encounter.lidar.scan_store import Scan, ScanStore
from lidar_mi.encounter.lidar.scan_window import ScanWindow
from lidar_mi.encounter.lidar.slab_winds import FirstImage
from lidar_mi.encounter.lidar.slabs import Air, Gates, air_of, gates_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.device import on_its_device
from lidar_mi.experiment.stages.rendering import PILOT_SEED
from lidar_mi.experiment.truth.clear_air import in_air_of_its_site
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.instrument.attenuated_backscatter import attenuated_backscatter
from lidar_mi.instrument.detector_noise import noisy_scan
from lidar_mi.instrument.products import with_products
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.backscatter import ScanRenderer
from lidar_mi.rendering.phase import ScatteringAir, molecules, scatterer
from lidar_mi.rendering.samples import choose_samples, pilot_samples
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.images.common_grid import resample
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import load_experiment

NO_EARLIER_SCAN = "no earlier scan of this slab"
LITTLE_OVERLAP = "the two scans have less than half of the image in common"

# Fraction of a period by which the time of a scan may differ from a multiple of it.
_OFF_RASTER = 0.01


@dataclass(frozen=True, eq=False)
class SlabImages:
    """Images of one slab from two scans, on one grid in the path frame.

    first, second (z, y): attenuated backscatter, m^-1 sr^-1, the second one resampled onto the
        nodes of the first.
    noise (z, y): standard deviation of the first one's noise.
    """

    first: xr.DataArray
    second: xr.DataArray
    noise: xr.DataArray


class VirtualLidar:
    """The lidars of an encounter, stepped from scan to scan by any simulation.

    Every step renders one scan of consecutive gates. The slab in the last gate of one scan is that
    in the first gate of the next, so every scan completes a pair of images of one slab; wind and
    vortices are estimated from it. Scans are instantaneous. Their images depend on the experiment,
    the number of the scan and the pose alone, with `encounter.window.follow` on the estimates
    before as well: a repeated step gives identical images, and the same estimate within rounding if
    it has no expected pair; several lidars in one process are independent. Nothing is written but
    to `scans`.

    Parameters
    ----------
    experiment : Experiment, str or path
        With a section ``encounter`` and a wake of ``vortex_pair``.
    processes : int
        2: the wind is estimated in a process of its own, at the same time as the vortices, as by an
        aircraft's computer with two cores. The estimates are the same but for rounding.
    scans : ScanStore, optional
        Stores scans; a stored one from the same pose is not rendered again.

    Raises
    ------
    InputError
        An experiment that is not that of an encounter; a `device` that is not there.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> pair = {"circulation": "300 m^2/s", "separation": "20 m", "width": "40 m", "height": "30 m"}
    >>> experiment = lm.load_experiment(
    ...     "wake_backscatter",
    ...     wake={"file": None, "time": None, "vortex_pair": pair, "spacing": "1 m"},
    ...     render={"samples_per_beam": 16, "max_order": 1},
    ...     retrieval={"methods": ["cc"]},
    ...     encounter={"path": {"start": "200 m"}},
    ... )
    >>> lidar = lm.VirtualLidar(experiment)
    >>> lidar.step(0.0).flags
    ('no earlier scan of this slab',)
    >>> estimate = lidar.step(0.1)
    >>> estimate.x, estimate.wind["v"].dims
    (151.25, ('z', 'y'))
    """

    @checked_arguments
    def __init__(
        self,
        experiment: Experiment | str | Path,
        *,
        processes: int = 1,
        scans: ScanStore | None = None,
    ) -> None:
        if not isinstance(experiment, Experiment):
            experiment = load_experiment(experiment)
        experiment = in_air_of_its_site(on_its_device(experiment), experiment.folder)
        self.experiment = experiment
        self.encounter = encounter_of(experiment)
        self.gates: Gates = gates_of(experiment)
        self.air: Air = air_of(experiment, self.gates)
        self.images: SlabImages | None = None
        self._doppler = doppler_scans(experiment, self.gates)
        speeds = LineSpeeds(self._doppler) if self._doppler else None
        self._estimator = Estimator(experiment, processes=processes, speeds=speeds)
        sizes = float(np.ptp(self.gates.y)), float(np.ptp(self.gates.z))
        self._window = ScanWindow(self.encounter, sizes)
        self._poses: dict[int, AircraftPose] = {}
        self._cores: dict[int, Cores] = {}
        self._started = False
        self._renderer: ScanRenderer | None = None
        self._scans: dict[int, Scan] = {}
        self._store = scans

    @property
    def wake(self) -> WakeAlongPath:
        """The truth: wind anywhere at any time, and the vortices in any plane."""
        return self.air.wake

    @checked_arguments
    def step(
        self, t: float, pose: AircraftPose | None = None, expected: VortexPairFit | None = None
    ) -> Estimate:
        """Scan at a time, and estimate wind and vortices in the slab that is now seen again.

        Parameters
        ----------
        t : float
            s, a multiple of the scans' period.
        pose : AircraftPose, optional
            Default: on the nominal path. Scans of a slab by a pose that is nearer or farther than
            nominal have their gates where the slab is.
        expected : VortexPairFit, optional
            The pair that a track expects in the slab, at the estimate's time: the fit starts there,
            and is faster and less often lost. Default: it starts from nothing.

        Returns
        -------
        Estimate
            In the path frame. Without wind and vortices if the scan before was not made.

        Raises
        ------
        InputError
            A time between scans or before the first one, a pose in or behind the slab.
        """
        number = self._number(t)
        pose = pose or AircraftPose(number * self.gates.stride)
        window = self._window.at(number, (pose.y, pose.z), expected)
        scan = self._store.read(number, pose, window) if self._store else None
        if scan is None:
            scan = self._scanned(number, pose, window)
            if self._store:
                self._store.write(number, pose, scan, window)
        before, came_from = self._scans.get(number - 1), self._poses.get(number - 1)
        # this scan for the next slab, the one before for a step that is repeated
        self._scans = {number: scan} | ({number - 1: before} if before else {})
        self._poses = {number: pose} | ({number - 1: came_from} if came_from else {})
        period = self.gates.period
        valid, x = (number - 0.5) * period, self.gates.slab(number - 1)
        soonest = number * period + self.encounter.fixed_latency
        nothing = partial(Estimate, valid, soonest, x, None, None, seconds={})
        if before is None or came_from is None:
            self.images = None
            return nothing(flags=(NO_EARLIER_SCAN,))
        images, flags = _on_first_grid(before, scan)
        self.images = images
        if images is None:
            return nothing(flags=flags)
        midway = Midway.between(came_from, pose, period)
        complete = self._completion(x, midway, pose)
        estimate = self._estimated(
            number,
            FirstImage(images.first, period, images.noise, expected=expected),
            images.second,
            frames=self._line_frames(number, x, valid, midway),
            complete=complete if self._doppler or complete.by_pointing else None,
            telescope=(midway.place[0] - x, midway.place[1], midway.place[2]),
        )
        delivered, wind_delivered = self._delivered(number, estimate.seconds)
        if "vortices" in estimate.seconds:
            self._window.add(delivered, estimate.pair)
        pair = estimate.pair.with_common_error(
            complete.common, complete.common, complete.rotation, complete.roll_axis
        )
        flags += estimate.flags
        if not pair.success:
            flags += tuple(f"vortices: {reason}" for reason in pair.reasons)
        return Estimate(
            valid,
            delivered,
            x,
            estimate.wind,
            pair,
            flags,
            estimate.seconds,
            estimate.lines,
            wind_delivered if estimate.wind is not None else None,
        )

    def _estimated(self, number: int, *images: Any, **about: Any) -> SlabEstimate:
        """What the cores that take this slab estimate."""
        if self.encounter.control.latency is not None:
            return self._estimator.pair_of(*images, **about)
        if not self._started:
            # what a program loads as it starts is no time of a slab
            self._estimator.pair_of(*images, **about)
            self._estimator.forget()
            self._started = True
        fits, winds = self._busy(number).take(number * self.gates.period, self.gates.period)
        # without lines the core of the wind has nothing to combine
        winds = winds and (fits or self._doppler is None)
        return self._estimator.pair_of(*images, **about, take=(fits, winds))

    def _busy(self, number: int) -> Cores:
        """The cores before a scan."""
        return self._cores.get(number - 1, Cores())

    def _delivered(self, number: int, seconds: Mapping[str, float]) -> tuple[float, float]:
        """Times at which vortices and wind of a scan's slab are there, s."""
        control, period = self.encounter.control, self.gates.period
        time = number * period
        if control.latency is not None:
            return (time + control.latency,) * 2
        charged = {part: control.computing_factor * value for part, value in seconds.items()}
        cores = self._busy(number).after(time, period, charged)
        # this scan for the next one, the one before for a step that is repeated
        self._cores = {n: c for n, c in self._cores.items() if n == number - 1} | {number: cores}
        return max(time, cores.vortices), max(time, cores.wind)

    def _line_frames(
        self, number: int, x: float, valid: float, midway: Midway
    ) -> LineFrames | None:
        """Of the Doppler lidar, if there is one."""
        if self._doppler is None:
            return None
        misalignment = pointing_error(self.experiment, number, number * self.gates.period)
        return self._doppler.frames(self.wake, number, x, valid, midway, misalignment)

    def _completion(self, x: float, midway: Midway, pose: AircraftPose) -> Completion:
        """The errors of a slab's wind by unknown pointing, and the origin of its lines of sight."""
        pointing, period = self.experiment.retrieval.pointing, self.gates.period
        # an unknown rotation between the scans displaces the second image by range times angle
        return Completion(
            pointing.stderr * (self.gates.look_ahead - self.gates.stride / 2) / period,
            pointing.roll / period,
            pointing.offset,
            midway.place,
            (pose.y, pose.z),
            x,
            self.experiment.sensor.crossflow_std if self.experiment.sensor else None,
        )

    def _number(self, t: float) -> int:
        number = round(t / self.gates.period) if np.isfinite(t) else -1
        if number < 0 or abs(t / self.gates.period - number) > _OFF_RASTER:
            raise InputError(
                f"t: {t:g} s is not allowed; expected a multiple of the {self.gates.period:g} s "
                "from scan to scan, 0 or more"
            )
        return number

    def _scanned(self, number: int, pose: AircraftPose, window: tuple[float, float]) -> Scan:
        """Both images of a scan with the detector's noise."""
        experiment, gates = self.experiment, self.gates
        ahead = pose.x - number * gates.stride
        plan = gates.plan(ahead, window)
        misalignment = pointing_error(experiment, number, number * gates.period)
        air = self.air.at_scan(number, (pose.y, pose.z), ahead, misalignment, window)
        # a lidar of another variant may have been stepped meanwhile
        use_variant(experiment.render.variant)
        if self._renderer is None:
            self._renderer = self._renderer_of(air, plan, self._settings)
        seed = self._settings.scan_seed(experiment.seed, number)
        scan = with_products(self._renderer.render(air, plan, seed))
        scan = self._detected(scan, plan, number)
        near, far = (self._image(scan, plan, gate, pose) for gate in (0, -1))
        return Scan(near[0], *far)

    def _renderer_of(
        self, air: xr.DataArray, plan: ScanPlan, settings: RenderSettings
    ) -> ScanRenderer:
        experiment = self.experiment
        lidar, scattering, wake = experiment.lidar, experiment.scattering, experiment.wake
        assert wake is not None  # of an encounter
        around = ScatteringAir(
            wake.extinction.background + self.air.molecules,
            *scatterer(scattering, experiment.folder, lidar.wavelength),
            molecules(self.air.molecules, lidar.wavelength, scattering.band),
        )
        return ScanRenderer(air, plan, lidar, around, settings)

    def _detected(self, scan: xr.Dataset, plan: ScanPlan, number: int) -> xr.Dataset:
        """A scan with the detector's noise, if there is one."""
        experiment = self.experiment
        if experiment.detector is None:
            return scan
        pulses, seed = experiment.scan.pulses_per_beam, [experiment.seed, number, 1]
        return noisy_scan(scan, experiment.lidar, experiment.detector, seed, plan, pulses)

    @cached_property
    def _settings(self) -> RenderSettings:
        """With the Monte Carlo samples per beam of all scans: as set, or by a pilot of the first.

        The pilot is of the nominal pose, so that images do not depend on the first pose.
        """
        experiment = self.experiment
        settings = experiment.render
        if settings.samples_per_beam != "auto":
            return settings
        plan = self.gates.plan()
        number = settings.without_detector(plan.gate_count)
        if experiment.detector:
            samples = pilot_samples(settings, len(plan.y) * len(plan.z), plan.gate_count)
            asked = settings.model_copy(update={"samples_per_beam": samples})
            air = self.air.at_scan(0, (0.0, 0.0))
            pilot = self._renderer_of(air, plan, asked).render(
                air, plan, experiment.seed + PILOT_SEED
            )
            number = choose_samples(self._detected(pilot, plan, 0), samples, settings).number
        return settings.model_copy(update={"samples_per_beam": number})

    def _image(
        self, scan: xr.Dataset, plan: ScanPlan, gate: int, pose: AircraftPose
    ) -> tuple[xr.DataArray, xr.DataArray]:
        """Attenuated backscatter of a gate, and the standard deviation of its noise."""
        noisy = "S0_noisy" in scan
        noise = scan["S0_stderr"].values.astype(float)
        if noisy:
            noise = np.hypot(noise, scan["S0_noise_std"].values)
        y, z = self.gates.axes(plan, gate)
        axes = {"z": ("z", pose.z + z, {"units": "m"}), "y": ("y", pose.y + y, {"units": "m"})}
        images = []
        for s0 in (scan["S0_noisy" if noisy else "S0"].values.astype(float), noise):
            values = attenuated_backscatter(
                s0, plan, self.experiment.lidar.aperture_area, scan.attrs["environment_extinction"]
            )
            images.append(xr.DataArray(values[gate], axes, ("z", "y"), attrs={"units": "m-1 sr-1"}))
        return images[0], images[1]


def _on_first_grid(before: Scan, scan: Scan) -> tuple[SlabImages | None, tuple[str, ...]]:
    """Both images of the slab on those nodes of the first that the second covers."""
    inside = {}
    for name in ("z", "y"):
        nodes, other = before.far[name].values, scan.near[name].values
        # places of the aircraft are sums of steps: their rounding must not cost an edge
        slack = 1e-6 * (other[1] - other[0])
        inside[name] = (nodes >= other[0] - slack) & (nodes <= other[-1] + slack)
    covered = inside["z"].mean() * inside["y"].mean()
    if min(inside["z"].sum(), inside["y"].sum()) < 4:
        return None, (LITTLE_OVERLAP,)
    first, noise = (
        image.isel({name: np.flatnonzero(where) for name, where in inside.items()})
        for image in (before.far, before.far_noise)
    )
    second = resample(scan.near, first["y"].values, first["z"].values)
    return SlabImages(first, second, noise), (() if covered >= 0.5 else (LITTLE_OVERLAP,))
