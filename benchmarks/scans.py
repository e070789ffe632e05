"""The scan of the benchmarks: the paper's, over the shipped wake."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import mitsuba as mi
import xarray as xr

from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.instrument.scan import ScanPlan, plan_scans
from lidar_mi.rendering.backscatter import extrude, render_scans, scene_dict
from lidar_mi.rendering.phase import ScatteringAir, scatterer
from lidar_mi.rendering.variant import use_variant
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import load


@dataclass(frozen=True)
class PaperScan:
    """The demo experiment before rendering: extinction (x, y, z) and scan geometry at t1, t2."""

    experiment: Experiment
    fields: tuple[xr.DataArray, ...]
    plans: tuple[ScanPlan, ...]

    @property
    def thickness(self) -> float:
        """Depth of the gate, m."""
        return self.plans[0].gate_stop - self.plans[0].gate_start

    def air(self) -> ScatteringAir:
        """Around the slab."""
        experiment = self.experiment
        return ScatteringAir(
            experiment.wake.extinction.background,
            *scatterer(experiment.scattering, wavelength=experiment.lidar.wavelength),
        )

    def scene(self):
        """The scan at t1 as a Mitsuba scene, in the experiment's variant."""
        use_variant(self.experiment.render.variant)
        experiment = self.experiment
        return mi.load_dict(
            scene_dict(
                self.fields[0], self.plans[0], experiment.lidar, self.air(), experiment.render
            )
        )

    def render(self, samples: int, seed: int):
        """Both scans as in an experiment, one after the other."""
        use_variant(self.experiment.render.variant)
        settings = self.experiment.render.model_copy(update={"samples_per_beam": samples})
        return render_scans(
            self.fields, self.plans, self.experiment.lidar, self.air(), settings, seed
        )


def paper_scan(
    columns: int = 219, rows: int = 139, pulse_duration: float = 0.0, max_order: int = 1
) -> PaperScan:
    """The demo experiment; fewer columns and rows: the middle of its grid. Pulse in s."""
    path = Path(str(files("lidar_mi.scenes"))) / "wake_backscatter.yaml"
    changed = [f"render.max_order={max_order}", f"lidar.pulse_duration={pulse_duration} s"]
    experiment = load(path, changed)
    truth = make_truth(experiment)
    y, z = (_middle(truth.wind[axis], count) for axis, count in (("y", columns), ("z", rows)))
    flown = experiment.platform.speed * experiment.platform.dt
    plans = plan_scans(experiment.scan, y.values, z.values, (0.0, flown))
    fields = [
        extrude(field.isel(x=0).sel(y=y, z=z).transpose("z", "y"), plans[0], experiment.lidar)
        for field in truth.extinction
    ]
    return PaperScan(experiment, tuple(fields), tuple(plans))


def set_extinction(scene, field: xr.DataArray) -> None:
    """Put another extinction on the same grid into a scene of `PaperScan.scene`."""
    parameters = mi.traverse(scene)
    voxels = field.transpose("z", "y", "x").values[..., None]
    parameters["slab.interior_medium.sigma_t.data"] = mi.TensorXf(voxels.astype("float32"))
    parameters.update()


def _middle(axis: xr.DataArray, count: int) -> xr.DataArray:
    start = (len(axis) - count) // 2
    return axis[start : start + count]
