"""Scans whose beams have times and poses of their own.

Detects: an image that differs without motion, 25 mm of a scatterer's place from true or reported
poses, 0.1 % of the range correction, a layer or attribute lost in a file.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.io.exr import read_scan, write_scan
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.scene import render_file
from lidar_mi.rendering.settings import RenderSettings

pytestmark = pytest.mark.usefixtures("variant")

Y = np.arange(-24.5, 24.6, 1.0)
Z = np.arange(-14.5, 14.6, 1.0)
RAYLEIGH = {"type": "rayleigh_polarized"}
BACKSCATTER = 3 / (8 * math.pi)
ENVIRONMENT = 1e-4
VARIANTS = [
    "llvm_ad_mono_polarized",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("llvm_ad_mono", "llvm_ad_rgb")),
]


def plane(values):
    shape = (len(Z), len(Y))
    return xr.DataArray(np.broadcast_to(values, shape).astype(float), {"z": Z, "y": Y}, ("z", "y"))


def at_once(plan):
    """Beams at the scan's reference time, from the telescope's place there, to the nodes."""
    directions = plan.directions()
    origin = np.broadcast_to([plan.position, 0, 0], directions.shape)
    return replace(
        plan, beams=Beams(np.zeros(len(directions)), origin, directions, origin, directions)
    )


def in_flight(plan, duration=0.1, speed=75.0, pitch=0.002, offset=(0.0, 0.0, 0.0), seed=2):
    """A raster along the rows while the telescope flies, rises and pitches at random.

    ``offset`` is the error of the reported place.
    """
    rng = np.random.default_rng(seed)
    directions = plan.directions()
    n = len(directions)
    time = duration * ((np.arange(n) + 0.5) / n - 0.5)
    origin = np.stack([plan.position + speed * time, 2 * time, 10 * time], -1)
    angle = pitch * np.sin(2 * np.pi * 8 * time) + 1e-4 * rng.standard_normal(n)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = directions.T
    directions = np.stack([x * cos - z * sin, y, x * sin + z * cos], -1)
    return replace(plan, beams=Beams(time, origin, directions, origin + offset, directions))


def render(fields, plans, seed=1, environment=ENVIRONMENT, **settings):
    settings = RenderSettings(**({"max_order": 1} | settings))
    air = ScatteringAir(environment, RAYLEIGH, 1.0)
    return list(render_scans(fields, plans, BackscatterLidar(), air, settings, seed))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("gates", ["planar", "spherical"])
def test_beams_all_at_once_give_the_image_of_a_plan_without(variant, gates):
    """Bit by bit, with both scans and two gates."""
    rng = np.random.default_rng(1)
    plans = plan_scans(Scan(gates=gates, gate_count=2), Y, Z, (0.0, 7.5))
    timed = [at_once(plan) for plan in plans]
    field = plane(1e-3 * rng.random((len(Z), len(Y))))
    settings = {"variant": variant, "samples_per_beam": 8}
    solid = extrude(field, plans[0], BackscatterLidar())
    images = [render([solid, solid], each, **settings) for each in (plans, timed)]
    for without, with_beams in zip(*images, strict=True):
        for name in set(without.data_vars) - {"Y"}:
            assert np.array_equal(without[name], with_beams[name])
        assert (without["S0"] > 0).all()
        # ranges from places and from directions differ in the last bit
        assert with_beams["Y"].values == pytest.approx(without["Y"].values, rel=1e-6)
        assert "beam_time" not in without and not with_beams["beam_time"].any()


@pytest.mark.parametrize("gates", ["planar", "spherical"])
def test_homogeneous_air_is_flat_from_every_origin(gates):
    """Range and gate length of each beam are corrected: 4 sigma of the mean, and of rows."""
    plans = [
        in_flight(plan, duration=0.4) for plan in plan_scans(Scan(gates=gates), Y, Z, (0.0, 7.5))
    ]
    solid = extrude(plane(ENVIRONMENT), plans[0], BackscatterLidar(), plans)
    for scan in render([solid, solid], plans, samples_per_beam=256):
        ratio = scan["Y"].values.astype(float) / (ENVIRONMENT * BACKSCATTER)
        sigma = (scan["S0_stderr"] / scan["S0"]).values[0].mean()
        assert abs(ratio.mean() - 1) < 4 * sigma / math.sqrt(ratio.size) + 1e-5
        assert np.abs(ratio.mean(1) - 1).max() < 4.5 * sigma / math.sqrt(len(Y)) + 1e-5


def test_corrections_use_the_reported_range():
    """A telescope reported 5 m too far ahead: the range is 5 m too short, Y too small."""
    (plan,) = plan_scans(Scan(), Y, Z, (0.0,))
    plan = in_flight(plan, offset=(5.0, 0.0, 0.0))
    solid = extrude(plane(ENVIRONMENT), plan, BackscatterLidar(), [plan])
    (scan,) = render([solid], [plan], samples_per_beam=64)
    true = (plan.centre - plan.beams.origin[:, 0]).mean()
    expected = ((true - 5) / true) ** 2 * math.exp(-2 * ENVIRONMENT * 5)
    ratio = scan["Y"].values.astype(float) / (ENVIRONMENT * BACKSCATTER)
    sigma = (scan["S0_stderr"] / scan["S0"]).values[0].mean() / math.sqrt(ratio.size)
    assert abs(ratio.mean() - expected) < 4 * sigma + 1e-4


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.0, 0.7, -0.4)])
def test_a_scatterer_lies_where_the_reported_beams_cross_it(offset, tmp_path):
    """Its true place plus the error of the reported one; 25 mm, in the file too."""
    centre = np.array([7.3, -4.2])
    r2 = (Y[None] - centre[0]) ** 2 + (Z[:, None] - centre[1]) ** 2
    plans = [in_flight(p, offset=offset) for p in plan_scans(Scan(), Y, Z, (0.0, 7.5))]
    solid = extrude(
        plane(1e-4 + 1.7e-3 * np.exp(-r2 / (2 * 2.5**2))), plans[0], BackscatterLidar(), plans
    )
    for scan in render([solid, solid], plans, samples_per_beam=128):
        path = tmp_path / "scan.exr"
        write_scan(path, scan)
        read = read_scan(path)
        for name in ("Y", "beam_time", "y_reported", "z_reported"):
            assert np.array_equal(read[name], scan[name]) and read[name].dims == ("z", "y")
        excess = scan["Y"].values.astype(float) - np.median(scan["Y"])
        y, z = (read[name].values.astype(float) for name in ("y_reported", "z_reported"))
        # beams cross it unevenly: weight each with the area that it stands for
        area = np.gradient(y, axis=1) * np.gradient(z, axis=0)
        place = np.array([(excess * area * axis).sum() for axis in (y, z)]) / (excess * area).sum()
        near = np.hypot(y - place[0], z - place[1]) < 9
        weight = np.where(near, excess * area, 0)
        found = np.array([(weight * axis).sum() for axis in (y, z)]) / weight.sum()
        assert np.abs(found - centre - offset[1:]).max() < 0.025


def test_labels_and_attributes(tmp_path):
    (plan,) = plan_scans(Scan(), Y, Z, (7.5,))
    plan = in_flight(plan)
    solid = extrude(plane(1e-3), plan, BackscatterLidar(), [plan])
    (scan,) = render([solid], [plan], samples_per_beam=4)
    write_scan(tmp_path / "scan.exr", scan)
    scan = read_scan(tmp_path / "scan.exr")
    assert scan.attrs["timed"] == 1 and scan.attrs["gridded"] == 0
    assert scan["beam_time"].attrs["units"] == "s" and scan["Y"].attrs["units"] == "m-1 sr-1"
    assert scan["y_reported"].attrs["units"] == scan["z_reported"].attrs["units"] == "m"
    # the first beam is the top left one: largest y and z
    assert scan["beam_time"].values[-1, -1] == scan["beam_time"].min()
    assert scan["beam_time"].values[-1, -2] < scan["beam_time"].values[-2, -1]


def test_the_plane_is_extended_to_all_beams():
    """Beams that pitch by 2 degrees cross 18 m above and below the nodes."""
    plans = [in_flight(p, pitch=0.035) for p in plan_scans(Scan(), Y, Z, (0.0, 7.5))]
    solid = extrude(plane(1e-3), plans[0], BackscatterLidar(), plans)
    radius = BackscatterLidar().radius_at(500)
    for plan in plans:
        for x in (plan.gate_start, plan.gate_stop):
            places = plan.beams.true_places(plan.position + x)
            for axis, place in zip(("y", "z"), places.T, strict=True):
                assert solid[axis].min() < place.min() - radius
                assert solid[axis].max() > place.max() + radius
    assert solid.isel(x=0).sel(y=Y, z=Z).shape == (len(Y), len(Z))


def test_a_scene_file_with_beams_is_corrected_by_their_own_ranges(tmp_path):
    """Origins 40 m apart along x: 16 % in S0, nothing in Y but the transmittance."""
    rng = np.random.default_rng(5)
    table = np.zeros((12, 7))
    table[:, 0], table[:, 3] = np.linspace(-20, 20, 12), 1
    table[:, 4:6] = rng.uniform(-0.05, 0.05, (12, 2))
    table[:, 6] = np.linspace(0, 0.11, 12)
    np.savetxt(tmp_path / "beams.csv", table, delimiter=",")
    (tmp_path / "beams.xml").write_text(
        f"""<scene version="3.0.0">
          <integrator type="gated_volpath"/>
          <medium type="homogeneous" id="air">
            <float name="sigma_t" value="1e-4"/> <float name="albedo" value="1"/>
            <phase type="rayleigh_polarized"/>
          </medium>
          <sensor type="scanning_lidar">
            <string name="beams" value="{tmp_path / "beams.csv"}"/>
            <float name="gate_start" value="500"/> <float name="gate_stop" value="502.5"/>
            <emitter type="laser"/> <ref id="air"/>
            <sampler type="independent"> <integer name="sample_count" value="256"/> </sampler>
            <film type="hdrfilm">
              <integer name="width" value="4"/> <integer name="height" value="3"/>
              <rfilter type="box"/>
            </film>
          </sensor>
        </scene>"""
    )
    scan = render_file(tmp_path / "beams.xml", tmp_path / "out.exr")
    cosine = 1 / np.linalg.norm(table[:, 3:6], axis=1)
    depth = 1e-4 * (501.25 - table[:, 0]) / cosine
    expected = 1e-4 * BACKSCATTER * np.exp(-2 * depth).reshape(3, 4)[::-1, ::-1]
    sigma = (scan["S0_stderr"] / scan["S0"]).values[0]
    assert (np.abs(scan["Y"].values / expected - 1) < 5 * sigma + 1e-4).all()
    assert np.ptp(scan["S0"].values) > 0.1 * scan["S0"].values.mean()
    assert scan.attrs["grid"] == 0
    times = table[:, 6].reshape(3, 4)[::-1, ::-1]
    for kept in (scan, read_scan(tmp_path / "out.exr")):
        assert kept["beam_time"].values == pytest.approx(times, abs=1e-6)
