"""Plugins from XML and from dictionaries, through any change of Mitsuba's variant.

Detects: a parameter that means something else in XML, a plugin lost with a variant.
"""

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


def test_xml_and_dictionary_give_the_same_picture_in_every_variant(world, scene_file):
    """Back and forth between variants, in one process."""
    pictures = {}
    for name in (
        "llvm_ad_mono_polarized", "llvm_ad_rgb", "llvm_ad_spectral_polarized",
        "llvm_ad_mono_polarized", "llvm_ad_rgb",
    ):  # fmt: skip
        mi.set_variant(name)
        from_xml, _ = world.render(mi.load_file(str(scene_file)), seed=1)
        from_dict, _ = world.render(same_scene(world), seed=1)
        assert from_xml == pytest.approx(from_dict, rel=1e-5, abs=1e-6 * from_dict.max())
        if name in pictures:
            assert np.array_equal(from_xml, pictures[name])
        pictures[name] = from_xml
    polarised = pictures["llvm_ad_mono_polarized"]
    assert pictures["llvm_ad_rgb"][0, 0] == pytest.approx(polarised[0, 0], rel=1e-5)
    assert (pictures["llvm_ad_rgb"][0, 1:] == 0).all()
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
        lidar_mi.plugins.register()  # any number of times
        if not name.startswith("scalar"):
            for plugin in ("laser", "rayleigh_polarized", "gated_volpath"):
                assert mi.load_dict({"type": plugin}) is not None
