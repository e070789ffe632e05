"""From an extinction field to a scan: the slab is where it should be, flat where it is flat.

Detects: 0.1 % of the normalised image, 0.05 pixel of a displacement, a mirrored or shifted axis,
a scan that is rendered with another scan's air, gates, beams or place.
"""

import math

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr

from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.io.exr import read_scan, write_scan
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.batches import Series
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings

pytestmark = pytest.mark.usefixtures("variant")

Y = np.arange(-54.5, 54.6, 0.5)
Z = np.arange(-34.5, 34.6, 0.5)
RAYLEIGH = {"type": "rayleigh_polarized"}
BACKSCATTER = 3 / (8 * math.pi)
ENVIRONMENT = 1e-4


def plane(values, y=Y, z=Z):
    return xr.DataArray(
        np.broadcast_to(values, (len(z), len(y))).astype(float), {"z": z, "y": y}, ("z", "y")
    )


def render(fields, plans, lidar=None, seed=1, environment=ENVIRONMENT, albedo=1.0, **settings):
    settings = RenderSettings(**({"max_order": 1} | settings))
    return list(
        render_scans(
            fields,
            plans,
            lidar or BackscatterLidar(),
            ScatteringAir(environment, RAYLEIGH, albedo),
            settings,
            seed,
        )
    )


class TestExtrude:
    @pytest.mark.parametrize("gates", ["planar", "spherical"])
    def test_keeps_the_plane_and_repeats_its_rim(self, gates):
        rng = np.random.default_rng(1)
        field = plane(rng.random((len(Z), len(Y))))
        (plan,) = plan_scans(Scan(gates=gates), Y, Z, (0.0,))
        solid = extrude(field, plan, BackscatterLidar())
        assert solid.dims == ("x", "y", "z") and solid.sizes["x"] == 1
        assert float(solid["x"][0]) == plan.centre
        assert solid["x"].attrs["cell_width"] >= 2.5
        inner = solid.isel(x=0).sel(y=Y, z=Z).transpose("z", "y")
        assert np.array_equal(inner.values, field.values)
        for axis in ("y", "z"):
            assert np.diff(solid[axis]) == pytest.approx(0.5)
        assert (solid.isel(x=0, y=0).sel(z=Z) == field.isel(y=0)).all()
        assert (solid.isel(x=0, z=-1).sel(y=Y) == field.isel(z=-1)).all()

    def test_later_scans_get_the_slab_where_it_is(self):
        """The grid's x is counted from the telescope's place at the first scan."""
        first, second = plan_scans(Scan(), Y, Z, (0.0, 15.0))
        one, two = (extrude(plane(1e-3), plan, BackscatterLidar()) for plan in (first, second))
        assert float(one["x"][0]) == float(two["x"][0]) == 501.25

    @pytest.mark.parametrize("gates", ["planar", "spherical"])
    @pytest.mark.parametrize("cut", [0.1, math.inf])
    def test_whole_gates_lie_in_the_slab(self, gates, cut):
        """Collisions drawn from the beams' geometry, without the renderer: 1 in 2000 outside.

        The divergence has no end; 2.2 times its 1/e^2 angle is exceeded by 6e-5 of the photons
        across the gate's planes or the rim, and the telescope's extent adds 0.3 mm to a range.
        """
        rng = np.random.default_rng(2)
        lidar = BackscatterLidar(beam_cut=cut)
        (plan,) = plan_scans(Scan(gates=gates), Y, Z, (0.0,))
        solid = extrude(plane(1e-3), plan, lidar)
        axis = plan.directions()
        axis = axis[rng.integers(0, len(axis), 200_000)]
        number = len(axis)
        across = np.stack([-axis[:, 1], axis[:, 0], np.zeros(number)], -1)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        up = np.cross(axis, across)

        def disc(sigma):
            a, b = rng.normal(0, sigma, (2, number, 1))
            return a * across + b * up

        direction = axis + disc(lidar.divergence_full / 4)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        origin = np.clip(disc(lidar.beam_radius / 2), -lidar.beam_cut, lidar.beam_cut)
        slant = 1 / axis[:, :1] if gates == "planar" else 1.0
        distance = rng.uniform(500, 502.5, (number, 1)) * slant
        place = origin + distance * direction
        half = solid["x"].attrs["cell_width"] / 2
        outside = np.abs(place[:, 0] - plan.centre) > half
        for k, name in ((1, "y"), (2, "z")):
            edge = float(solid[name].max()) + 0.25
            outside |= np.abs(place[:, k]) > edge
        assert outside.mean() < 5e-4


class TestHomogeneousSlab:
    SIGMA = 1e-3

    def expected(self, plan, solid, scan):
        """Apparent backscatter: what the slab takes away in excess of the environment is left in.

        One gate from the slab's front to its gate; A dr / r^2 cancels but for (dr / r)^2.
        """
        front = float(solid["x"][0]) - solid["x"].attrs["cell_width"] / 2 - plan.position
        oblique = plan.obliquity()
        fraction = np.linspace(0, 1, 401)[:, None, None]
        slant = oblique if plan.gate_kind == "planar" else np.ones_like(oblique)
        r = (plan.gate_start + fraction * (plan.gate_stop - plan.gate_start)) * slant
        middle = plan.centre * slant
        depth = (self.SIGMA - ENVIRONMENT) * (r - front * oblique)
        value = np.exp(-2 * ENVIRONMENT * (r - middle) - 2 * depth) * (middle / r) ** 2
        length = (plan.gate_stop - plan.gate_start) * slant
        return self.SIGMA * BACKSCATTER * np.trapezoid(value, r, axis=0) / length

    def test_a_block_without_texture_is_flat_in_every_pixel(self):
        """The grid's transmittance must not add noise of its own: 0.2 % with 256 samples."""
        plans = plan_scans(Scan(), Y[::6], Z[::6], (0.0,))
        solid = extrude(plane(self.SIGMA, Y[::6], Z[::6]), plans[0], BackscatterLidar())
        (scan,) = render([solid], plans, samples_per_beam=256)
        image = scan["Y"].values.astype(float)
        assert np.abs(image / image.mean() - 1).max() < 2e-3


class TestMovingBlob:
    """A blob of 2 m rms moves by +1 m in y and +0.5 m in z between the scans, 15 m flown."""

    START, SHIFT = np.array([20.3, -10.2]), np.array([1.0, 0.5])

    def fields(self, plans, lidar):
        for centre in (self.START, self.START + self.SHIFT):
            r2 = (Y[None] - centre[0]) ** 2 + (Z[:, None] - centre[1]) ** 2
            yield extrude(plane(1e-4 + 1.7e-3 * np.exp(-r2 / (2 * 2.0**2))), plans[0], lidar)

    @staticmethod
    def centroid(image):
        """Of what rises above the background, within 6 rms of its peak; (y, z) in m."""
        excess = image.values.astype(float) - np.median(image)
        z, y = image["z"].values[:, None], image["y"].values[None]
        row, column = np.unravel_index(excess.argmax(), excess.shape)
        near = (np.abs(y - y[0, column]) < 12) & (np.abs(z - z[row, 0]) < 12)
        weight = np.where(near, excess, 0)
        return np.array([(weight * y).sum(), (weight * z).sum()]) / weight.sum()

    def test_an_asymmetric_field_is_not_mirrored(self):
        """An L of blobs: the long arm towards +z, the short one towards +y."""
        lidar = BackscatterLidar()
        y, z = Y[::2], Z[::2]
        (plan,) = plan_scans(Scan(), y, z, (0.0,))
        field = np.full((len(z), len(y)), 1e-5)
        marks = [(0.0, 0.0), (0.0, 10.0), (0.0, 20.0), (8.0, 0.0)]
        for a, b in marks:
            r2 = (y[None] - a) ** 2 + (z[:, None] - b) ** 2
            field = field + 1e-3 * np.exp(-r2 / 2)
        (scan,) = render([extrude(plane(field, y, z), plan, lidar)], [plan], samples_per_beam=64)
        for a, b in marks:
            for mirrored in ((a, b), (-a, b), (a, -b), (b, a)):
                value = float(scan["Y"].sel(y=mirrored[0], z=mirrored[1], method="nearest"))
                lit = any(math.dist(mirrored, mark) < 0.1 for mark in marks)
                assert (value > 0.3e-3 * BACKSCATTER) == lit


class TestVolume:
    def test_layers_lie_where_their_cells_are(self):
        """Gates of 1 m through a slab of 5 layers of 2 m: each layer in two gates."""
        sigma = np.array([1.0, 5.0, 2.0, 8.0, 3.0]) * 1e-5
        x = 501.0 + 2 * np.arange(5)
        y, z = np.arange(-20, 21, 4.0), np.arange(-16, 17, 4.0)
        field = xr.DataArray(
            np.broadcast_to(sigma[:, None, None], (5, len(y), len(z))),
            {"x": x, "y": y, "z": z},
            ("x", "y", "z"),
        )
        lidar = BackscatterLidar(divergence_full="0.2 mrad")
        inner = (y[2:-2], z[2:-2])
        plans = plan_scans(Scan(thickness=10.0, gate_count=10), *inner, (0.0, 15.0))
        for scan in render([field, field], plans, lidar, environment=0.0, samples_per_beam=40_000):
            s0 = scan["S0"].values.mean((1, 2), dtype=float)
            plan = plans[0] if scan.attrs["telescope_position"] == 0 else plans[1]
            apparent = s0 * plan.ranges().mean((1, 2)) ** 2 / lidar.aperture_area
            apparent /= plan.gate_length().mean()
            # extinction is linear between cell centres: at gate centres 25 % of the way
            expected = np.interp(500.5 + np.arange(10), x, sigma) * BACKSCATTER
            assert apparent == pytest.approx(expected, rel=3e-3)


class TestScans:
    def plans(self, flown=(0.0, 15.0), **scan):
        return plan_scans(Scan(**scan), Y[::20], Z[::20], flown)

    def fields(self, plans):
        rng = np.random.default_rng(3)
        for _ in plans:
            yield extrude(
                plane(1e-3 * rng.uniform(0.5, 1.5, (len(Z), len(Y)))), plans[0], BackscatterLidar()
            )

    def test_a_moved_scene_gives_the_image_of_a_new_one(self):
        """The second and third scan from the first's scene, and each rendered alone."""
        plans = self.plans((0.0, 15.0, 30.0))
        fields = list(self.fields(plans))
        for index, moved in enumerate(render(fields, plans)):
            (alone,) = render_scans(
                fields,
                plans,
                BackscatterLidar(),
                ScatteringAir(ENVIRONMENT, RAYLEIGH, 1.0),
                RenderSettings(max_order=1),
                1,
                Series([index]),
            )
            for name in ("S0", "S1", "S2", "S3", "S0_stderr", "Y"):
                assert np.array_equal(alone[name], moved[name])
            assert alone.attrs["telescope_position"] == 15 * index

    def test_scans_differ_in_their_random_numbers(self):
        """Equal air, equal place: only the seeds differ, and the images do."""
        first = self.plans()[0]
        field = next(iter(self.fields([first])))
        one, two = render([field, field], [first, first])
        assert (one["S0"] != two["S0"]).all()
        z = (one["S0"] - two["S0"]) / np.hypot(one["S0_stderr"], two["S0_stderr"])
        assert float(np.abs(z).max()) < 5

    def test_the_largest_seed_is_recorded_as_used(self, tmp_path):
        """In the file too, whose whole numbers have 32 bits with a sign."""
        plans = self.plans()
        fields = list(self.fields(plans))
        scans = render(fields, plans, seed=2**31 - 1)
        for scan in scans:
            write_scan(tmp_path / "scan.exr", scan)
            assert read_scan(tmp_path / "scan.exr").attrs["seed"] == scan.attrs["seed"] >= 0
        (again,) = render(fields[1:], plans[1:], seed=scans[1].attrs["seed"])
        assert np.array_equal(again["S0"], scans[1]["S0"])

    def test_seed_and_albedo(self):
        plans = self.plans()[:1]
        fields = list(self.fields(plans))
        (one,), (again,), (other,), (dark,) = (
            render(fields, plans, seed=seed, albedo=albedo)
            for seed, albedo in ((1, 1.0), (1, 1.0), (2, 1.0), (1, 0.5))
        )
        assert np.array_equal(one["S0"], again["S0"])
        assert (one["S0"] != other["S0"]).all()
        assert (dark["S0"] / one["S0"]).values == pytest.approx(0.5, rel=1e-6)

    def test_labels_and_attributes(self):
        plans = self.plans(gate_count=3)
        lidar = BackscatterLidar(pulse_energy="2 mJ", stokes=(1, 0, 0, 1))
        calls = []
        # the header has the variant in force
        settings = RenderSettings(max_order=1, samples_per_beam=30, variant="llvm_ad_mono")
        scans = list(
            render_scans(
                list(self.fields(plans)),
                plans,
                lidar,
                ScatteringAir(ENVIRONMENT, RAYLEIGH, 1.0),
                settings,
                5,
                Series(progress=lambda *call: calls.append(call)),
            )
        )
        for k, scan in enumerate(scans):
            assert scan["S0"].dims == ("gate", "z", "y") and scan["S0"].shape == (3, 7, 11)
            assert np.array_equal(scan["y"], Y[::20]) and np.array_equal(scan["z"], Z[::20])
            assert scan["Y"].dims == ("z", "y")
            assert scan.attrs["gate_start"] == 500 - 15 * k
            assert scan.attrs["telescope_position"] == 15 * k
            assert scan.attrs["gate_count"] == 3 and scan.attrs["samples_per_beam"] == 30
            assert scan.attrs["variant"] == "llvm_ad_mono_polarized"
            assert scan.attrs["pulse_energy"] == pytest.approx(2e-3)
            assert scan.attrs["stokes_emitted"] == [1, 0, 0, 1]
            # circular light comes back with V turned
            assert (scan["S3"] / scan["S0"]).values == pytest.approx(-1, abs=1e-5)
        assert [call for call in calls if call[1] == call[2]] == [
            (k, 77 * 30, 77 * 30) for k in (0, 1)
        ]

    def test_one_scene_serves_all_scans(self, monkeypatch):
        loaded = []
        load = mi.load_dict
        monkeypatch.setattr(
            mi, "load_dict", lambda d, **k: loaded.append(d["type"]) or load(d, **k)
        )
        plans = self.plans()
        render(list(self.fields(plans)), plans)
        assert loaded.count("scene") == 1
