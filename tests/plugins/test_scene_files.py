"""Plugins from XML and from dictionaries, through any change of Mitsuba's variant.

Detects: a parameter that means something else in XML, a plugin lost with a variant; a shipped scene
that does not show what it says, to 1 % of the lidar equation.
"""

import re
from importlib.resources import files
from pathlib import Path

import lidar_mi.plugins
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

XML = """
<scene version="3.0.0">
  <integrator type="gated_volpath">
    <integer name="max_order" value="1"/>
    <string  name="estimator" value="gated"/>
  </integrator>
  <medium type="homogeneous" id="environment">
    <float name="sigma_t" value="1e-4"/> <float name="albedo" value="1"/>
    <phase type="rayleigh_polarized"><float name="depolarization" value="0.028"/></phase>
  </medium>
  <sensor type="scanning_lidar">
    <float name="aperture_radius" value="0.5"/>  <float name="fov_half_mrad" value="5"/>
    <string name="gate_kind" value="planar"/>
    <float name="gate_start" value="500"/> <float name="gate_stop" value="502.5"/>
    <integer name="gate_count" value="1"/>
    <float name="azimuth_min_deg" value="-6.2"/>  <float name="azimuth_max_deg" value="6.2"/>
    <float name="elevation_min_deg" value="-3.9"/> <float name="elevation_max_deg" value="3.9"/>
    <emitter type="laser">
      <float name="beam_radius" value="0.1"/>
      <float name="beam_cut" value="0.1"/>
      <float name="divergence_full_mrad" value="2"/>
      <string name="stokes" value="1, 1, 0, 0"/>
      <float name="wavelength" value="532e-9"/> <float name="pulse_energy" value="1"/>
      <float name="pulse_duration" value="0"/>
    </emitter>
    <sampler type="independent"><integer name="sample_count" value="64"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="21"/><integer name="height" value="13"/><rfilter type="box"/>
    </film>
    <ref id="environment" name="medium"/>
  </sensor>
  <shape type="cube">
    <transform name="to_world"><scale x="2" y="60" z="40"/><translate x="501.25"/></transform>
    <bsdf type="null"/>
    <medium name="interior" type="heterogeneous">
      <volume name="sigma_t" type="gridvolume">
        <string name="filename" value="grid.vol"/>
        <transform name="to_world">
          <scale x="4" y="120" z="80"/><translate x="499.25" y="-60" z="-40"/>
        </transform>
        <boolean name="accel" value="false"/>
      </volume>
      <float name="albedo" value="1"/>
      <phase type="mueller"><string name="table" value="table.txt"/></phase>
    </medium>
    <ref id="environment" name="exterior"/>
  </shape>
</scene>
"""


def values():
    return 1e-3 * np.random.default_rng(1).uniform(0.5, 1.5, (8, 12, 3))


def table():
    """A depolarising table, so that it shows which phase function acts."""
    angle = np.linspace(0, 180, 91)
    cosine = np.cos(np.radians(angle))
    one = np.ones_like(angle)
    return np.column_stack([angle, one, 0.8 * one, 0.8 * cosine, 0.6 * cosine, 0 * one, 0 * one])


@pytest.fixture
def scene_file(tmp_path):
    """The scene with its grid and table beside it, named by bare file names."""
    mi.VolumeGrid(values()[..., None].astype(np.float32)).write(str(tmp_path / "grid.vol"))
    np.savetxt(tmp_path / "table.txt", table())
    path = tmp_path / "scene.xml"
    path.write_text(XML)
    return path


def same_scene(world):
    """The XML's scene from a dictionary."""
    low, high = [499.25, -60, -40], [503.25, 60, 40]
    phase = {"type": "mueller", "table": mi.TensorXf(table())}
    return world.scene(
        world.lidar(
            (21, 13),
            (500.0, 502.5),
            {"beam_radius": 0.1},
            environment=world.ENVIRONMENT,
            azimuth_min_deg=-6.2,
            azimuth_max_deg=6.2,
            elevation_min_deg=-3.9,
            elevation_max_deg=3.9,
        ),
        environment=world.homogeneous(
            1e-4, {"type": "rayleigh_polarized", "depolarization": 0.028}
        ),
        slab=world.box(low, high, world.grid(values(), low, high, phase), world.ENVIRONMENT),
    )


def test_xml_and_dictionary_give_the_same_image_in_every_variant(world, scene_file):
    """Back and forth between variants, in one process."""
    images = {}
    for name in (
        "llvm_ad_mono_polarized llvm_ad_rgb llvm_ad_spectral_polarized llvm_ad_mono_polarized "
        "llvm_ad_rgb"
    ).split():
        mi.set_variant(name)
        from_xml, _ = world.render(mi.load_file(str(scene_file)), seed=1)
        from_dict, _ = world.render(same_scene(world), seed=1)
        assert from_xml == pytest.approx(from_dict, rel=1e-5, abs=1e-6 * from_dict.max())
        if name in images:
            assert np.array_equal(from_xml, images[name])
        images[name] = from_xml
    polarised = images["llvm_ad_mono_polarized"]
    assert images["llvm_ad_rgb"][0, 0] == pytest.approx(polarised[0, 0], rel=1e-5)
    assert (images["llvm_ad_rgb"][0, 1:] == 0).all()
    # the slab's table acts, not the environment's phase function
    assert polarised[0, 1] / polarised[0, 0] == pytest.approx(0.8, abs=1e-3)


def test_xml_parameters_can_be_overridden(world, scene_file):
    """As the command line does with -D."""
    text = XML.replace('name="gate_stop" value="502.5"', 'name="gate_stop" value="$stop"')
    scene_file.write_text(text)
    sensor = mi.load_file(str(scene_file), stop="501").sensors()[0]
    assert float(mi.traverse(sensor)["gate_stop"][0]) == 501


def test_unknown_xml_parameter_is_named(scene_file):
    scene_file.write_text(XML.replace("fov_half_mrad", "fov_full_mrad"))
    with pytest.raises(RuntimeError, match="fov_full_mrad"):
        mi.load_file(str(scene_file))


def test_plugins_survive_every_change_of_variant():
    for name in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral"):
        mi.set_variant(name)
        lidar_mi.register_plugins()  # any number of times
        if not name.startswith("scalar"):
            for plugin in ("laser", "rayleigh_polarized", "gated_volpath"):
                assert mi.load_dict({"type": plugin}) is not None
        else:
            for plugin in ("laser", "rayleigh_polarized", "gated_volpath"):
                with pytest.raises(RuntimeError, match=f"{plugin}: the variant {name} is not"):
                    mi.load_dict({"type": plugin})
    # Mitsuba's parser takes the kinds of plugins from scalar_rgb
    states = mi.TensorXf(np.ones((2, 2, 2, 2), np.float32))
    moving = {"type": "moving_volume", "data": states, "time_start": 0.0, "time_stop": 1.0}
    assert mi.load_dict({"type": "heterogeneous", "sigma_t": moving}) is not None


# --- the scenes that ship --------------------------------------------------------------------

SCENES = Path(str(files("lidar_mi.scenes")))


def shipped(name, samples, **definitions):
    """Image of a shipped scene as channel name: (rows, columns), and its sensor."""
    mi.set_variant("llvm_ad_mono_polarized")
    mi.set_log_level(mi.LogLevel.Error)
    scene = mi.load_file(str(SCENES / name), **definitions)
    sensor = scene.sensors()[0]
    image = np.array(mi.render(scene, spp=samples, seed=1), float)
    names = scene.integrator().channel_names(sensor)
    return dict(zip(names, np.moveaxis(image, -1, 0), strict=True)), sensor


def rayleigh_back(depolarization):
    """a1 and a4 at 180 degrees, a1 averaging to one (Hansen & Travis 1974, eq. 2.15)."""
    dipole = (1 - depolarization) / (1 + depolarization / 2)
    circular = (1 - 2 * depolarization) / (1 - depolarization)
    return 1.5 * dipole + 1 - dipole, -1.5 * dipole * circular


def test_every_scene_that_ships_is_tested():
    tested = {"slab.xml", "profile.xml", "puff.xml", "cone.xml"}
    mine = {path.name for path in SCENES.glob("*.xml") if "scanning_lidar" in path.read_text()}
    assert mine == tested


@pytest.mark.slow
def test_profile_of_500_gates():
    """Lidar equation of single scattering where the overlap is complete (above 450 m): haze of
    particles with the table's own a1 at 180 degrees and air, clear air above 1 km. The mixture's
    weight in the file has three digits: 0.3 %. Pulses of 10 ns smear the edge by 1.5 m."""
    table = np.loadtxt(SCENES / "aerosol_spheroids_532nm.txt")
    rendered, _ = shipped("profile.xml", 20_000)
    single = np.array([rendered[f"gate{g:03d}.order1.S0"][0, 0] for g in range(500)])
    double = np.array([rendered[f"gate{g:03d}.order2.S0"][0, 0] for g in range(500)])
    r = 60 + 3 * (np.arange(500) + 0.5)
    air = rayleigh_back(0.0284)[0] / (4 * np.pi)
    haze = 1.132e-4 * 0.9484 * (0.877 * table[-1, 1] / (4 * np.pi) + 0.123 * air)
    depth = 1.132e-4 * np.minimum(r, 1000) + 1.2e-5 * np.maximum(r - 1000, 0)
    beta = np.where(r < 1000, haze, 1.2e-5 * air)
    found = single * r**2 / (np.pi * 0.2**2 * 3) * np.exp(2 * depth)
    clear = (r > 450) & (np.abs(r - 1000) > 6)
    np.testing.assert_allclose(found[clear] / beta[clear], 1, atol=0.01)
    assert (found[r < 100] < 0.3 * haze).all()  # hardly any overlap
    # multiple scattering grows through the haze and is left behind at its top
    fraction = np.divide(double, single, out=np.zeros(500), where=single > 0)
    inside, above = (fraction[(r > a) & (r < a + 100)].mean() for a in (890, 1100))
    assert 1e-4 < fraction[(r > 400) & (r < 500)].mean() < inside < 5e-3
    assert above < 0.5 * inside


@pytest.mark.slow
def test_puff_from_a_grid():
    """The shipped grid is the stated Gaussian; its image obeys the lidar equation along the
    axis of every beam, blurred by the beam's 0.16 m. Cells of 1 m: trilinear air lies below the
    Gaussian where that bends down, by up to h^2/8 of the second derivative, 1 %."""
    values = np.array(mi.VolumeGrid(str(SCENES / "puff.vol"))).reshape(24, 24, 24)
    cells = np.arange(24) - 11.5
    z, y, x = np.meshgrid(cells, cells, cells, indexing="ij")
    np.testing.assert_allclose(values, 0.02 * np.exp(-(x**2 + y**2 + z**2) / 32), rtol=1e-5)

    rendered, sensor = shipped("puff.xml", 256)
    s0 = rendered["gate000.S0"]
    beams = np.array(sensor.m_directions).reshape(41, 41, 3)
    steps = np.arange(-12, 1.0005, 0.01)

    def extinction(beam, along):
        place = beam / beam[0] * 300 + beam * along[:, None]
        return 0.02 * np.exp(-((place - [300, 0, 0]) ** 2).sum(1) / 32)

    table = np.loadtxt(SCENES / "aerosol_droplets_532nm.txt")
    back = table[-1, 1] / (4 * np.pi)
    for row, column in ((20, 20), (20, 27), (14, 16), (25, 20)):
        beam = beams[row, column]
        along = extinction(beam, steps)
        depth = 1e-4 * 288 + np.concatenate([[0], np.cumsum((along[1:] + along[:-1]) / 2) * 0.01])
        gate = steps > -1
        signal = (along * np.exp(-2 * depth))[gate] * back * np.pi * 0.25**2 / 300**2
        expected = np.trapezoid(signal, steps[gate])
        error = rendered["gate000.S0_stderr"][row, column] / s0[row, column]
        # multiple scattering adds up to a few per cent in a cloud as dense as this
        assert -0.02 - 4 * error < s0[row, column] / expected - 1 < 0.08 + 4 * error
    assert np.unravel_index(s0.argmax(), s0.shape) == pytest.approx((20, 20), abs=2)


def test_cone_of_beams_from_a_table():
    """36 beams alike, circular light turned round: S3/S0 = a4/a1 at 180 degrees in either order of
    the axes, no linear polarisation; the lidar equation in every gate (overlap complete)."""
    rendered, sensor = shipped("cone.xml", 2_000)
    beams = np.array(sensor.m_directions).reshape(36, 3)
    np.testing.assert_allclose(beams[:, 2], np.sin(np.radians(60)), atol=1e-6)
    azimuth = np.degrees(np.arctan2(beams[:, 1], beams[:, 0])) % 360
    np.testing.assert_allclose(azimuth, np.arange(0, 360, 10), atol=1e-3)
    a1, a4 = rayleigh_back(0.0306)
    for gate in range(20):
        s0, s1, s2, s3 = (rendered[f"gate{gate:03d}.S{k}"][0] for k in range(4))
        edges = 1000 + 30 * np.array([gate, gate + 1])
        r = np.linspace(*edges, 101)
        signal = np.exp(-2 * 2.84e-5 * r) / r**2
        expected = 2.84e-5 * a1 / (4 * np.pi) * np.pi * 0.15**2 * np.trapezoid(signal, r)
        error = rendered[f"gate{gate:03d}.S0_stderr"][0]
        assert s0.mean() == pytest.approx(expected, abs=4 * error.mean() / 6 + 1e-3 * expected)
        np.testing.assert_allclose(s3 / s0, a4 / a1, atol=1e-4)
        assert np.abs(np.stack([s1, s2]) / s0).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("scalar", ["hg", "isotropic"])
def test_blend_with_an_unpolarised_part_is_refused_where_it_would_be_wrong(world, scalar):
    """And accepted among its own kind, and without polarisation, where it is right."""

    def render(*kinds):
        blend = {"type": "blendphase", "weight": 0.4}
        blend |= {f"part{k}": {"type": kind} for k, kind in enumerate(kinds)}
        scene = world.scene(
            world.lidar((1, 1), (500.0, 502.5), environment=world.ENVIRONMENT, samples=64),
            environment=world.homogeneous(1e-4, blend),
        )
        return world.render(scene, seed=1)[0]

    with pytest.raises(RuntimeError) as error:
        render("rayleigh_polarized", scalar)
    output = f"{error.value} {error.value.__cause__} {error.value.__context__}"
    assert re.search(
        "blendphase: .*PhaseFunction' is not allowed; expected phase functions", output
    )
    both = render(scalar, "isotropic")
    assert both[0, 0, 0] > 0 and (both[0, 1:] == 0).all()
    polarised = render("rayleigh_polarized", "rayleigh_polarized")
    mi.set_variant("llvm_ad_mono")
    expected = 0.6 * render("rayleigh_polarized", "rayleigh_polarized")[0, 0]
    expected = expected + 0.4 * render(scalar, scalar)[0, 0]
    assert render("rayleigh_polarized", scalar)[0, 0] == pytest.approx(expected, rel=1e-3)
    assert polarised[0, 1] == pytest.approx(polarised[0, 0], rel=1e-4)
