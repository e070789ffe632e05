"""Recover the extinction of a slab from its lidar image by gradient descent.

Wide beams blur the image of a wake. The renderer is differentiable with respect to the extinction
of every cell, so the extinction can be fitted to the observed image by gradient descent:

    python examples/recover_slab.py        # half a minute; writes recover_slab.png

The descent must stop before it fits the noise of the image.
"""

import argparse

import lidar_mi  # before mitsuba: chooses LLVM, registers the plugins  # isort: skip
import drjit as dr
import mitsuba as mi
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.rendering.backscatter import extrude, scene_dict
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.schema import reading as config

LIDAR = BackscatterLidar(divergence_full="3 mrad")  # 0.38 m rms at 500 m, on nodes of 0.5 m
ENVIRONMENT = 1e-4
KEY = "slab.interior_medium.sigma_t.data"


def port_vortex(width: float, height: float) -> xr.DataArray:
    """True extinction (z, y) around the port vortex of the sample wake, 1/m."""
    wake = {"file": "wake_slab_40s.nc", "time": 40, "texture": {"rms": 0.2, "outer_scale": 5}}
    image = make_truth(config.check({"name": "slab", "wake": wake}, "example")).image(0)
    middle = image.sel(y=slice(24 - width / 2, 24 + width / 2), z=slice(-height / 2, height / 2))
    return middle.assign_coords(y=middle["y"] - 24)


def recover(truth: xr.DataArray, steps: int, samples: int, learning_rate: float = 0.03):
    """First guess and recovered extinction from the image of ``truth``, and the misfits.

    The first guess is the solution of the lidar equation for the image: the blurred extinction.
    """
    (plan,) = plan_scans(Scan(), truth["y"].values, truth["z"].values, [0.0])
    around = ScatteringAir(ENVIRONMENT, {"type": "rayleigh_polarized"}, 1.0)
    settings = RenderSettings(samples_per_beam=samples, max_order=1)
    air = extrude(truth, plan, LIDAR)
    scene = mi.load_dict(scene_dict(air, plan, LIDAR, around, settings))
    parameters = mi.traverse(scene)

    image = np.array(mi.render(scene, spp=64 * samples, seed=1))[..., 0]
    flat = xr.ones_like(truth) * 1e-3
    parameters[KEY] = _voxels(extrude(flat, plan, LIDAR))
    parameters.update()
    reference = np.array(mi.render(scene, spp=64 * samples, seed=2))[..., 0]
    guess = truth.copy(data=(1e-3 * image / reference)[::-1, ::-1])

    # the logarithm keeps extinction positive
    optimizer = mi.ad.Adam(lr=learning_rate)
    optimizer["log"] = dr.log(_voxels(extrude(guess, plan, LIDAR)))
    measured, misfits = mi.TensorXf(image), []
    for step in range(steps):
        parameters[KEY] = dr.exp(optimizer["log"])
        parameters.update()
        rendered = mi.render(scene, parameters, spp=samples, seed=10 + step)[..., 0]
        misfit = dr.mean(dr.square(rendered / measured - 1))
        dr.backward(misfit)
        optimizer.step()
        misfits.append(float(misfit.array[0]))
    solid = air.copy(data=np.exp(np.array(optimizer["log"]))[..., 0].transpose(2, 1, 0))
    found = solid.isel(x=0).transpose("z", "y").sel(y=truth["y"], z=truth["z"], method="nearest")
    return guess, found, misfits


def error(found: xr.DataArray, truth: xr.DataArray) -> float:
    """Relative rms error, without two nodes at the edges."""
    inner = (slice(2, -2), slice(2, -2))
    return float(np.sqrt(np.mean((found.values / truth.values - 1)[inner] ** 2)))


def draw(truth, guess, found, path) -> None:
    figure = Figure(figsize=(15, 4), layout="compressed")
    for axes, field, name in zip(
        figure.subplots(1, 3),
        (truth, guess, found),
        (
            "truth",
            f"first guess: error {error(guess, truth):.1%}",
            f"recovered: error {error(found, truth):.1%}",
        ),
        strict=True,
    ):
        mesh = axes.pcolormesh(
            field["y"],
            field["z"],
            field * 1e3,
            vmin=0,
            cmap="cividis",
            vmax=1e3 * float(truth.quantile(0.995)),
        )
        axes.set(title=name, xlabel="y / m (port is left)", ylabel="z / m", aspect="equal")
        axes.invert_xaxis()
        figure.colorbar(mesh, ax=axes, label="extinction / km$^{-1}$", extend="max")
    figure.savefig(path, dpi=110)


def _voxels(extinction: xr.DataArray):
    """Values in the order of a Mitsuba volume grid: z, y, x, channel."""
    return mi.TensorXf(extinction.transpose("z", "y", "x").values[..., None].astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument(
        "--samples", "--photons", type=int, default=64, help="Monte Carlo samples per beam and step"
    )
    parser.add_argument("--out", default="recover_slab.png")
    options = parser.parse_args()
    use_variant("llvm_ad_mono")
    truth = port_vortex(32, 24)
    guess, found, misfits = recover(truth, options.steps, options.samples)
    draw(truth, guess, found, options.out)
    print(
        f"lidar-mi {lidar_mi.__version__}: misfit {misfits[0]:.2e} -> {misfits[-1]:.2e}, error "
        f"{error(guess, truth):.1%} -> {error(found, truth):.1%}, {options.out}"
    )


if __name__ == "__main__":
    main()
