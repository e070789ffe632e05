"""The integrator: estimators, error bars, passes, variants, kernels, memory and errors.

Detects: 3 % between the two estimators, a standard error wrong by 5 %, rounding beyond float32
between ways to do the same thing, a kernel compiled twice.
"""

import functools
import gc
import math
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2, kstest

pytestmark = pytest.mark.usefixtures("variant")

SCAN = {
    "azimuth_min_deg": -6.2,
    "azimuth_max_deg": 6.2,
    "elevation_min_deg": -3.9,
    "elevation_max_deg": 3.9,
}


def textured(
    world, seed=0, contrast=0.5, mean=1e-3, low=(498.0, -65.0, -45.0), high=(506.0, 65, 45)
):
    """A slab whose cells differ, in an environment."""
    rng = np.random.default_rng(seed)
    values = mean * rng.uniform(1 - contrast, 1 + contrast, (9, 13, 8))
    return world.box(low, high, world.grid(values, low, high), world.ENVIRONMENT)


def scan(world, size=(12, 8), gate=(500.0, 502.5), integrator=None, seed=0, **parameters):
    return world.scene(
        world.lidar(size, gate, environment=world.ENVIRONMENT, **(SCAN | parameters)),
        integrator,
        environment=world.homogeneous(1e-4),
        slab=textured(world, seed),
    )


class TestAnalogAgreesWithGated:
    """Free flights as nature draws them: no forcing, no inversion of the path, no Jacobian.

    A dense slab, 0.12 / m over 8 m, three gates, and a field of view that cuts the beam.
    """

    def compare(self, world, statistics, seed):
        rendered = {}
        for estimator, samples in (("gated", 60_000), ("analog", 150_000)):
            low, high = (498.0, -65.0, -45.0), (506.0, 65.0, 45.0)
            values = 0.12 * np.random.default_rng(1).uniform(0.5, 1.5, (9, 13, 8))
            scene = world.scene(
                world.lidar(
                    (4, 3),
                    (499.0, 505.0),
                    environment=world.ENVIRONMENT,
                    gate_count=3,
                    fov_half_mrad=0.8,
                    **SCAN,
                ),
                {"estimator": estimator},
                environment=world.homogeneous(1e-4),
                slab=world.box(low, high, world.grid(values, low, high), world.ENVIRONMENT),
            )
            rendered[estimator] = world.render(scene, seed=seed, spp=samples)
        (gated, gated_error), (analog, analog_error) = rendered.values()
        both = np.hypot(gated_error, analog_error)
        z = (analog[:, 0] - gated[:, 0]) / both
        assert (np.abs(z) < 4).all()
        assert abs((z**2).sum() - z.size) < 4 * math.sqrt(2 * z.size)
        # gate by gate over the scan: 3 sigma
        total = (analog[:, 0] - gated[:, 0]).sum((1, 2)) / np.sqrt((both**2).sum((1, 2)))
        assert (np.abs(total) < 3).all()
        assert (both / gated[:, 0]).mean() < 0.03
        return gated, analog

    def test_polarised(self, world, statistics):
        gated, analog = self.compare(world, statistics, seed=1)
        for found in (gated, analog):
            assert np.abs(found[:, 1] / found[:, 0] - 1).max() < 1e-5
            assert np.abs(found[:, 2:] / found[:, :1]).max() < 1e-4

    @pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
    def test_unpolarised(self, world, statistics, variant):
        self.compare(world, statistics, seed=2)


@pytest.mark.parametrize("case", ["gated", "gated, half in view", "analog"])
def test_standard_error_is_correct(world, statistics, case):
    """100 seeds x 100 equal beams: z-scores have unit variance, in all, per seed, per beam.

    All beams see the same (spherical gates, homogeneous air), so their grand mean is the truth.
    """
    estimator = case.split(",")[0]
    photons, gate, extinction, fov = {
        "gated": (400, (500.0, 502.5), 1e-3, 5.0),
        "gated, half in view": (400, (500.0, 502.5), 1e-3, 1.0),
        "analog": (1000, (20.0, 40.0), 3e-2, 100.0),
    }[case]
    scene = world.scene(
        world.lidar(
            (10, 10),
            gate,
            environment=world.homogeneous(extinction),
            gate_kind="spherical",
            fov_half_mrad=fov,
            **SCAN,
        ),
        {"estimator": estimator},
    )
    seeds = 100
    scans = [world.render(scene, seed=1000 + seed, spp=photons) for seed in range(seeds)]
    values = np.array([stokes[0, 0].ravel() for stokes, _ in scans])
    errors = np.array([error[0].ravel() for _, error in scans])
    z = statistics.assert_agree(values, errors, values.mean(), photons, skewness=2)
    z = z.reshape(values.shape)
    expected = (photons - 1) / (photons - 3)
    for axis in (0, 1):
        p = chi2.sf((z**2 / expected).sum(axis), z.shape[axis])
        assert kstest(p, "uniform").pvalue > 1e-3
    # beams and seeds are independent: their means scatter as they should
    for axis in (0, 1):
        means = z.mean(axis) * math.sqrt(z.shape[axis])
        assert abs(means.var() - 1) < 4 * math.sqrt(2 / means.size)


class TestVariants:
    @pytest.mark.parametrize(
        "variant",
        (
            "llvm_ad_mono llvm_ad_rgb llvm_ad_spectral llvm_ad_spectral_polarized "
            "cuda_ad_mono_polarized cuda_ad_rgb"
        ).split(),
        indirect=True,
    )
    def test_same_seed_same_intensity_in_every_variant(self, world, variant):
        """S0 of horizontally polarised and of natural light differ by 1e-6 in backscatter."""
        integrator = {"estimator": "gated"}
        stokes, error = world.render(scan(world, integrator=integrator, gate_count=2), seed=1)
        analog, _ = world.render(scan(world, integrator={"estimator": "analog"}), seed=1, spp=4000)
        mi.set_variant("llvm_ad_mono_polarized")
        expected, spread = world.render(scan(world, integrator=integrator, gate_count=2), seed=1)
        assert stokes[:, 0] == pytest.approx(expected[:, 0], rel=1e-5)
        assert error == pytest.approx(spread, rel=1e-3)
        free, _ = world.render(scan(world, integrator={"estimator": "analog"}), seed=1, spp=4000)
        assert analog[:, 0] == pytest.approx(free[:, 0], rel=1e-4)

    def test_rgb_uses_the_channel_of_the_laser(self, world):
        """A medium that scatters in one colour only is seen by the laser of that colour."""
        mi.set_variant("llvm_ad_rgb")
        for wavelength, channel in ((633e-9, 0), (532e-9, 1), (355e-9, 2)):
            for colour in range(3):
                sigma = [1e-9, 1e-9, 1e-9]
                sigma[colour] = 1e-3
                medium = world.homogeneous(0.0) | {"sigma_t": {"type": "rgb", "value": sigma}}
                scene = world.scene(
                    world.lidar(
                        (1, 1), (500.0, 502.5), {"wavelength": wavelength}, environment=medium
                    )
                )
                signal = world.render(scene)[0][0, 0, 0, 0]
                assert (signal > 1e-11) == (channel == colour)


class TestPasses:
    @pytest.mark.slow
    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    @pytest.mark.parametrize("at_once", [1, 7, 50, 70])
    def test_samples_per_pass_do_not_change_the_result(self, world, estimator, at_once):
        """Beams in several passes, and the samples of a beam: the same photons, 1e-6 rounding."""
        size, gates, samples = (3, 2), 3, 21
        rendered = [
            world.render(
                scan(
                    world,
                    size,
                    (500.0, 505.0),
                    gate_count=gates,
                    integrator={"estimator": estimator, "samples_per_pass": n},
                ),
                seed=3,
                spp=samples,
            )
            for n in (1 << 22, at_once)
        ]
        (whole, whole_error), (parts, parts_error) = rendered
        assert parts == pytest.approx(whole, rel=2e-6, abs=1e-6 * whole[:, 0].mean())
        assert parts_error == pytest.approx(whole_error, rel=1e-4)

    def test_progress_counts_up_to_all_samples(self, world):
        scene = scan(world, (5, 3), integrator={"samples_per_pass": 300})
        calls = []
        scene.integrator().progress = lambda done, total: calls.append((done, total))
        mi.render(scene, spp=100)
        done, total = zip(*calls, strict=True)
        assert set(total) == {1500} and done == (300, 600, 900, 1200, 1500)

    @pytest.mark.slow
    def test_a_million_beams_stay_below_2_gb(self, tmp_path):
        """1000 x 1000 beams x 16 samples in a process of its own; peak of its resident memory."""
        script = tmp_path / "million.py"
        script.write_text(MILLION)
        done = subprocess.run(
            [sys.executable, str(script)], capture_output=True, text=True, timeout=600, check=True
        )
        shape, mean, peak = done.stdout.split(";")
        assert shape == "(1000, 1000, 5)"
        assert float(mean) == pytest.approx(1, abs=1e-4)
        assert float(peak) < 2e9


MILLION = """
import resource
import lidar_mi, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_mono_polarized")
mi.set_log_level(mi.LogLevel.Error)
phase = {"type": "rayleigh_polarized"}
air = {"type": "homogeneous", "sigma_t": 1e-3, "albedo": 1.0, "phase": phase}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "gated_volpath"},
    "sensor": {
        "type": "scanning_lidar", "gate_start": 500.0, "gate_stop": 502.5,
        "gate_kind": "spherical", "azimuth_min_deg": -6.2, "azimuth_max_deg": 6.2,
        "elevation_min_deg": -3.9, "elevation_max_deg": 3.9, "medium": air,
        "laser": {"type": "laser", "beam_cut": 0.1, "divergence_full_mrad": 2.0},
        "film": {"type": "hdrfilm", "width": 1000, "height": 1000, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 16},
    },
})
image = np.array(mi.render(scene))
r = np.linspace(500, 502.5, 10001)
truth = np.trapezoid(3 / 32 * 1e-3 * np.exp(-2e-3 * r) / r**2, r)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(image.shape, image[..., 0].mean(dtype=float) / truth, peak, sep=";")
"""


def kernels(render, least=0):
    """Hashes of the kernels that a function launches, of those of so many operations."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        render()
        history = dr.kernel_history()
    large = (entry for entry in history if entry.get("operation_count", 0) >= least)
    return {entry["hash"] for entry in large if "hash" in entry}


class TestKernels:
    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_nothing_is_compiled_again(self, world, estimator):
        """New seed, sample count, air, gates, pose and beams: the kernels of the first scan."""
        scene = scan(world, integrator={"estimator": estimator, "samples_per_pass": 10_000})
        first = kernels(lambda: dr.eval(mi.render(scene, seed=1, spp=64)))
        assert first
        assert kernels(lambda: dr.eval(mi.render(scene, seed=2, spp=64))) <= first
        for samples in (16, 65, 1000):
            assert kernels(lambda n=samples: dr.eval(mi.render(scene, seed=3, spp=n))) <= first

        parameters = mi.traverse(scene)
        table = np.array(parameters["sensor.directions"])
        parameters["sensor.directions"] = mi.Float(table + 0.01)
        parameters["sensor.gate_start"] = 485.0
        parameters["sensor.gate_stop"] = 487.5
        parameters["sensor.to_world"] = mi.Transform4f().translate([15, 0, 0])
        air = np.array(parameters["slab.interior_medium.sigma_t.data"])
        parameters["slab.interior_medium.sigma_t.data"] = mi.TensorXf(1.7 * air)
        assert kernels(parameters.update) & first == set()  # the update's own, small ones
        assert kernels(lambda: dr.eval(mi.render(scene, seed=4, spp=64))) <= first

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "integrator", [{}, {"orders": True}, {"estimator": "analog"}, {"candidates": 4}], ids=str
    )
    def test_scenes_of_other_gates_orders_pulses_and_polarisations(self, world, integrator):
        """The kernel that traces is the first scene's."""

        def traced(gates=2, order=3, **laser):
            sensor = world.lidar(
                (1, 1),
                (499.0, 505.0),
                laser={"pulse_duration": 1e-8, **laser},
                environment=world.ENVIRONMENT,
                gate_count=gates,
            )
            scene = world.scene(
                sensor,
                {"max_order": order, **integrator},
                environment=world.homogeneous(1e-4),
                slab=textured(world),
            )
            found = kernels(functools.partial(mi.render, scene, spp=64), least=500)
            # a scene that lives is in the kernels of others
            del scene, sensor
            gc.collect()
            gc.collect()
            return found

        first = traced()
        assert len(first) == 1
        assert traced(gates=5) == first
        assert traced(order=4) == first
        assert traced(pulse_duration=3e-8) == first
        assert traced(stokes="1, 0.3, -0.5, 0.1") == first

    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_samples_are_traced_once(self, world, estimator):
        """One large kernel a pass: statistics must not make Dr.Jit trace them again."""
        scene = scan(world, integrator={"estimator": estimator})
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(scene))
            history = dr.kernel_history()
        assert sum(entry.get("operation_count", 0) > 500 for entry in history) == 1


class TestSeeds:
    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_same_seed_same_image_other_seed_another(self, world, estimator):
        scene = scan(world, integrator={"estimator": estimator})
        one, again, other = (world.render(scene, seed=s, spp=2000)[0] for s in (5, 5, 6))
        if estimator == "gated":
            assert np.array_equal(one, again)
        else:  # sums in the order in which threads come
            assert again == pytest.approx(one, rel=1e-6, abs=1e-7 * one.max())
        lit = one[0, 0] > 0
        assert lit.any() and (one[0, 0][lit] != other[0, 0][lit]).all()

    def test_more_samples_add_to_the_same_ones(self, world):
        """A sample's random numbers depend on seed, beam and number, not on the scan's size."""
        small = scan(world, (1, 1), azimuth_min_deg=0.0, azimuth_max_deg=0.0)
        large = world.scene(
            world.lidar(
                (3, 2),
                (500.0, 502.5),
                environment=world.ENVIRONMENT,
                directions=mi.TensorXf(np.tile([1.0, 0, 0], (6, 1))),
            ),
            environment=world.homogeneous(1e-4),
            slab=textured(world),
        )
        assert np.array_equal(
            world.render(small, seed=7)[0][0, :, 0, 0], world.render(large, seed=7)[0][0, :, 0, 0]
        )

    def test_neighbouring_beams_and_seeds_are_uncorrelated(self, world):
        """4 sigma on correlations of 2500 equal beams."""
        scene = world.scene(
            world.lidar(
                (50, 50),
                (500.0, 502.5),
                environment=world.homogeneous(1e-3),
                gate_kind="spherical",
                fov_half_mrad=0.5,
                **SCAN,
            )
        )
        a, b = (world.render(scene, seed=s, spp=64)[0][0, 0].ravel() for s in (8, 9))
        for one, two in [(a, b), (a[1:], a[:-1]), (a[50:], a[:-50]), (a[1:], b[:-1])]:
            assert abs(np.corrcoef(one, two)[0, 1]) < 4 / math.sqrt(one.size)


class TestOpaqueTargets:
    def wall(self, x, low_y=-100.0, high_y=100.0):
        t = mi.ScalarTransform4f()
        middle, half = (low_y + high_y) / 2, (high_y - low_y) / 2
        place = t.translate([x, middle, 0]).rotate([0, 1, 0], -90).scale([100, half, 1])
        return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}

    def scene(self, world, wall, estimator):
        return world.scene(
            world.lidar((8, 3), (500.0, 502.5), environment=world.ENVIRONMENT, **SCAN),
            {"estimator": estimator},
            environment=world.homogeneous(1e-4),
            slab=world.box(
                [490, -65, -45], [510, 65, 45], world.homogeneous(0.1), world.ENVIRONMENT
            ),
            wall=wall,
        )

    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    @pytest.mark.parametrize("x", [300.0, 495.0])
    def test_no_light_from_behind_a_wall(self, world, estimator, x):
        stokes, error = world.render(self.scene(world, self.wall(x), estimator), spp=2000)
        assert (stokes == 0).all() and (error == 0).all()

    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_a_wall_behind_the_gate_changes_nothing(self, world, estimator):
        behind = world.render(self.scene(world, self.wall(505.0), estimator), seed=1, spp=2000)[0]
        far = world.render(self.scene(world, self.wall(5000.0), estimator), seed=1, spp=2000)[0]
        assert behind[0, 0] == pytest.approx(far[0, 0], rel=1e-5)

    def test_half_a_wall_hides_the_beams_on_its_side(self, world):
        """A wall on the port side (+y): the left half of the image is dark."""
        stokes, _ = world.render(self.scene(world, self.wall(300.0, 0.0, 100.0), "gated"))
        assert (stokes[0, 0, :, :4] == 0).all() and (stokes[0, 0, :, 4:] > 0).all()


class TestErrors:
    @pytest.mark.parametrize(
        ("parameters", "message"),
        [
            ({"max_order": 0}, "gated_volpath.max_order: 0 is not allowed; expected"),
            ({"estimator": "magic"}, "gated_volpath.estimator: 'magic' is not allowed; expected"),
            ({"samples_per_pass": 0}, "gated_volpath.samples_per_pass: 0 is not allowed"),
        ],
    )
    def test_bad_values_are_named(self, parameters, message):
        with pytest.raises(RuntimeError) as error:
            mi.load_dict({"type": "gated_volpath", **parameters})
        assert message in str(error.value).splitlines()[-1]

    def render_error(self, scene, **options):
        """Message of the ValueError at the root of what mi.render raises."""
        with pytest.raises(Exception) as error:
            mi.render(scene, **options)
        cause = error.value
        while cause.__cause__ is not None:
            cause = cause.__cause__
        assert isinstance(cause, ValueError)
        return str(cause)

    @pytest.mark.parametrize("gate", [(400.0, 402.5), (600.0, 610.0)])
    @pytest.mark.parametrize("position", [0.0, 50.0])
    def test_gates_that_miss_every_medium(self, world, gate, position):
        """The telescope in a vacuum; slab from 498 to 506 m."""
        low, high = (498.0, -65.0, -45.0), (506.0, 65.0, 45.0)
        scene = world.scene(
            world.lidar(
                (1, 1),
                tuple(g - position for g in gate),
                to_world=mi.ScalarTransform4f().translate([position, 0, 0]),
            ),
            slab=world.box(low, high, world.homogeneous(1e-3)),
        )
        message = self.render_error(scene)
        assert message.startswith("gated_volpath.gates: '")
        assert f"'{gate[0] - position:g} to {gate[1] - position:g} m'" in message
        assert "expected ranges with a medium (there is one: " in message

    def test_no_medium_at_all(self, world):
        message = self.render_error(world.scene(world.lidar((1, 1), (500.0, 502.5))))
        assert "nowhere" in message

    def test_gates_that_meet_a_medium_are_rendered(self, world):
        low, high = (498.0, -65.0, -45.0), (506.0, 65.0, 45.0)
        scene = world.scene(
            world.lidar((2, 2), (500.0, 502.5), **SCAN),
            slab=world.box(low, high, world.homogeneous(1e-3)),
        )
        assert (world.render(scene)[0][0, 0] > 0).all()

    def test_another_sensor(self, world):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "gated_volpath"},
                "sensor": {"type": "perspective"},
            }
        )
        message = self.render_error(scene)
        assert message.startswith("gated_volpath.sensor: ")
        assert "expected a sensor of type 'scanning_lidar'" in message

    def test_one_analog_sample_has_no_error_bar(self, world):
        message = self.render_error(scan(world, integrator={"estimator": "analog"}), spp=1)
        assert message.startswith(
            "gated_volpath.sample_count: 1 is not allowed; expected at least 2"
        )

    @pytest.mark.parametrize("integrator", [{"estimator": "analog"}, {}])
    def test_gradients_are_refused_where_there_are_none(self, world, integrator):
        scene = scan(world, (2, 2), integrator=integrator)
        with pytest.raises(ValueError, match=r"gated_volpath\.gradients"):
            scene.integrator().render_forward(scene, None)
        with pytest.raises(ValueError, match=r"gated_volpath\.gradients"):
            scene.integrator().render_backward(scene, None, None)


def test_channels_are_named_gate_by_gate(world):
    scene = scan(world, (4, 3), gate_count=2)
    names = scene.integrator().channel_names(scene.sensors()[0])
    assert names == [
        f"gate00{gate}.{quantity}"
        for gate in (0, 1)
        for quantity in ("S0", "S1", "S2", "S3", "S0_stderr")
    ]
    image = mi.render(scene)
    assert image.shape == (3, 4, len(names))


def test_one_sample_a_gate_is_raised_to_two(world):
    scene = scan(world, (4, 3))
    stokes, error = world.render(scene, spp=1)
    assert np.array_equal(stokes, world.render(scene, spp=2)[0])
    assert (error > 0).all()


class TestCovariance:
    """S1's error bar and its correlation with S0's, against many renderings of the same scan."""

    def images(self, world, estimator, **parameters):
        integrator = {"estimator": estimator, "max_order": 2, "covariance": True, **parameters}
        scene = scan(world, (12, 8), integrator=integrator)
        names = scene.integrator().quantities()
        spp = 200 if estimator == "gated" else 5_000
        seeds = 30 if estimator == "gated" else 20
        found = np.stack([np.array(mi.render(scene, spp=spp, seed=s)) for s in range(seeds)])
        return {name: found[..., k].astype(float) for k, name in enumerate(names)}

    @pytest.mark.slow
    @pytest.mark.parametrize("estimator", ["gated", "analog"])
    def test_is_that_over_seeds(self, world, estimator):
        if not mi.is_polarized:
            pytest.skip("unpolarised variants have no S1")
        found = self.images(world, estimator)
        number = found["S0"].shape[0]
        off = {k: found[k] - found[k].mean(0) for k in ("S0", "S1")}
        product = (off["S0"] * off["S1"]).sum(0) / (number - 1)
        output = found["S0_S1_correlation"] * found["S0_stderr"] * found["S1_stderr"]
        beams = product.size
        for observed, expected in (
            ((off["S1"] ** 2).sum(0) / (number - 1), found["S1_stderr"] ** 2),
            (product, output),
        ):
            ratio = observed.mean() / expected.mean()
            # the mean of `beams` sample variances of `number` draws
            sigma = np.sqrt(2 / (beams * (number - 1)))
            assert abs(ratio - 1) < 4 * sigma + 0.01, (ratio, sigma)

    def test_does_not_depend_on_the_passes(self, world):
        if not mi.is_polarized:
            pytest.skip("unpolarised variants have no S1")
        whole = scan(world, (4, 3), integrator={"covariance": True})
        parts = scan(world, (4, 3), integrator={"covariance": True, "samples_per_pass": 50})
        one, many = (np.array(mi.render(s, spp=64, seed=3)) for s in (whole, parts))
        np.testing.assert_allclose(many[..., 5:], one[..., 5:], rtol=2e-4)

    def test_single_scattering_by_molecules_is_fully_correlated(self, world):
        """Backscatter without depolarisation: S1 = S0 of every photon."""
        if not mi.is_polarized:
            pytest.skip("unpolarised variants have no S1")
        image = np.array(mi.render(scan(world, (4, 3), integrator={"covariance": True}), spp=200))
        np.testing.assert_allclose(image[..., 5], image[..., 4], rtol=1e-3)
        np.testing.assert_allclose(image[..., 6], 1, atol=1e-3)


def test_nothing_is_freed_while_kernels_are_recorded(world, monkeypatch):
    """A scene freed between two virtual calls makes Dr.Jit 1.5 emit a function twice and abort."""
    scene = world.scene(
        world.lidar((1, 1), (500.0, 502.5)),
        {"max_order": 2},
        slab=world.box((490.0, -5.0, -5.0), (510.0, 5.0, 5.0), world.homogeneous(1e-2)),
    )
    render = type(scene.integrator()).render
    lidar = render.__globals__["Lidar"]
    single, collecting = lidar.single, []

    def watched(*arguments):
        collecting.append(gc.isenabled())
        return single(*arguments)

    monkeypatch.setattr(lidar, "single", watched)
    mi.render(scene, spp=4)
    assert collecting == [False] and gc.isenabled()
