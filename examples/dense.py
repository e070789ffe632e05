"""Extinction of fog from the counts of a lidar: Klett's inversion against that of the renderer.

Light that fog scatters forwards stays in the field of view and is counted later. An inversion that
knows single scattering alone takes it for clearer air. The renderer knows all orders:

    python examples/dense.py        # a minute; writes dense.png

Two plumes in fog between 100 and 220 m, at optical depths of 0.3, 1 and 3. All inversions are given
the extinction of the farthest layer, 10 % too large.
"""

import argparse

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.inversion.extinction import LayeredAir, invert_extinction
from lidar_mi.rendering.backscatter import ScanRenderer
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.extinction.klett import klett

GATES, NEAR, FAR = 24, 100.0, 220.0
LIDAR = BackscatterLidar(
    beam_radius=0.02,
    beam_cut=0.05,
    divergence_full="1 mrad",
    aperture_radius=0.1,
    fov_half="10 mrad",
)
PLAN = ScanPlan(np.zeros(1), np.zeros(1), NEAR, FAR, "spherical", GATES, 0.0)
DROPLETS = {"type": "hg", "g": 0.85}
AROUND = ScatteringAir(1e-6, DROPLETS, 1.0)
BRIGHTEST, BACKGROUND = 1e5, 10.0  # counts of a gate


def middles(count: int) -> np.ndarray:
    faces = np.linspace(NEAR, FAR, count + 1)
    return (faces[1:] + faces[:-1]) / 2


def fog(depth: float) -> xr.DataArray:
    """True extinction, 1/m, every 0.5 m."""
    x = middles(240)
    profile = 0.5 + 1.5 * np.exp(-(((x - 140) / 10) ** 2)) + np.exp(-(((x - 185) / 6) ** 2))
    return xr.DataArray(depth * profile / profile.sum() / 0.5, coords={"x": x}, dims="x")


def settings(samples: int, max_order: int = 4) -> RenderSettings:
    return RenderSettings(
        variant="llvm_ad_mono", samples_per_beam=samples * GATES, max_order=max_order
    )


def observe(truth: xr.DataArray, samples: int, seed: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Counts of every gate, counts per signal, and the fraction scattered more than once."""
    sides = np.array([-120.0, 120.0])
    air = truth.expand_dims(y=sides, z=sides).transpose("x", "y", "z").copy()
    use_variant("llvm_ad_mono")
    renderer = ScanRenderer(air, PLAN, LIDAR, AROUND, settings(samples))
    scan = renderer.render(air, PLAN, seed)
    signal = scan["S0"].values.astype(float)
    per_signal = BRIGHTEST / signal.max()
    counts = np.random.default_rng(seed).poisson(per_signal * signal + BACKGROUND)
    return counts, per_signal, 1 - scan["order1.S0"].values.ravel() / signal.ravel()


def layers(truth: xr.DataArray) -> np.ndarray:
    return truth.values.reshape(GATES, -1).mean(1)


def retrieve(truth: xr.DataArray, counts: np.ndarray, per_signal: float, samples: int):
    """Extinction of the layers by Klett, and by the renderer with one and with four orders."""
    reference = 1.1 * layers(truth)[-1]
    profile = np.maximum(counts.ravel() - BACKGROUND, 1)
    by_klett = klett(profile, middles(GATES), reference)
    air = LayeredAir(middles(GATES), DROPLETS)
    by_renderer = [
        invert_extinction(
            counts,
            PLAN,
            LIDAR,
            air,
            per_signal,
            settings(samples, order),
            BACKGROUND,
            reference=(reference, 0.1),
            start=by_klett,
        )
        for order in (1, 4)
    ]
    return by_klett, *by_renderer


def error(found: np.ndarray, truth: xr.DataArray) -> float:
    """Relative rms error of the layers."""
    return float(np.sqrt(np.mean((found / layers(truth) - 1) ** 2)))


def draw(axes, truth: xr.DataArray, results: tuple, title: str) -> None:
    x = middles(GATES)
    by_klett, single, found = results
    axes.plot(truth["x"], truth * 1e3, color="black", label="truth")
    axes.plot(x, by_klett * 1e3, "--", label=f"Klett: error {error(by_klett, truth):.0%}")
    alone = single["extinction"].values
    said = error(alone, truth)
    said = f"error {said:.0%}" if said < 1 else "diverges"
    axes.plot(x, alone * 1e3, ":", label=f"renderer, one order: {said}")
    values, stderr = found["extinction"].values, found["extinction_stderr"].values
    label = f"renderer, all orders: {error(values, truth):.1%}"
    axes.errorbar(x, values * 1e3, stderr * 1e3, fmt=".", capsize=2, label=label)
    axes.set(title=title, xlabel="range / m", ylim=(0, 1.5e3 * float(truth.max())))
    axes.legend(fontsize="small")


def main(out: str | None = "dense.png", samples: int = 32_768, depths=(0.3, 1.0, 3.0)) -> list:
    """Errors of each inversion: (optical depth, fraction of the light, Klett, one order, four)."""
    figure = Figure(figsize=(5 * len(depths), 4), layout="compressed")
    panels = np.atleast_1d(figure.subplots(1, len(depths)))
    rows = []
    for axes, depth in zip(panels, depths, strict=True):
        truth = fog(depth)
        counts, per_signal, multiple = observe(truth, 8 * samples, seed=5)
        results = retrieve(truth, counts, per_signal, samples)
        by_klett, single, found = results
        values = (by_klett, single["extinction"].values, found["extinction"].values)
        fraction = multiple.mean()
        rows.append((depth, fraction, *(error(one, truth) for one in values)))
        stated = np.sqrt(np.diag(found["log_covariance"].values))
        normalised = np.log(values[2] / layers(truth)) / stated
        print(
            f"optical depth {depth:g}: {fraction:.0%} of the light scattered more than once; rms "
            f"error of Klett {rows[-1][2]:.1%}, one order {rows[-1][3]:.1%}, four orders "
            f"{rows[-1][4]:.1%} (stated {np.sqrt(np.mean(stated**2)):.1%}, variance of normalised "
            f"errors {np.mean(normalised**2):.2f}); {found.attrs['rounds']} rounds, Monte Carlo "
            f"variance {found.attrs['monte_carlo_fraction']:.2f} of the counts'"
        )
        draw(axes, truth, results, f"optical depth {depth:g}")
    panels[0].set_ylabel("extinction / km$^{-1}$")
    if out:
        figure.savefig(out, dpi=110)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=32_768, help="per beam, gate and round")
    parser.add_argument("--out", default="dense.png")
    options = parser.parse_args()
    main(options.out, options.samples)
