"""What results do not depend on, and so may be shared by experiments that differ in it.

Detects: a setting that changes an image and is said not to, with which a campaign would take the
image of another experiment.
"""

import math

import numpy as np
import pytest

from lidar_mi.experiment.folder.run_folder import made_by, new_record
from lidar_mi.experiment.pipeline import stages_of, storing_stages
from lidar_mi.experiment.run import prepare
from lidar_mi.schema import reading
from lidar_mi.schema.reading import load_experiment
from tests.support.experiments import small

DOPPLER = {
    "camera": {"width": 64, "height": 52, "pixel": "111 um"},
    "render": {"samples_per_pixel": 4},
    "v_los": ["70 m/s"],
    "path_samples": 0,
}

# other values of every key, or of one in every section, that images do not depend on
BEHIND = {
    "name": "another",
    # but for rounding, where it has another variant
    "device": "cpu",
    "lidar.pulse_energy": "7.3 mJ",
    "detector": {"sky_radiance": "0.1 W/m^2/sr/nm", "quantum_efficiency": 0.3},
    "render.max_samples": 2e6,
    "render.monte_carlo_fraction": 0.4,
    "retrieval": {"methods": ["variational"], "stride": 4},
    "doppler": DOPPLER | {"lidar": {"pulse_energy": "1 mJ"}, "retrieval": {"images": 3}},
    "sensor": {"pulses": 3, "method": "cc"},
}
BEHIND_RINGS = {
    "name": "another",
    "device": "cpu",
    "wake": small()["wake"],
    "platform": {"speed": "70 m/s"},
    "lidar": {"pulse_energy": "2 mJ"},
    "detector": {},
    "scan": {"range": "400 m"},
    "site": {"altitude": "500 m"},
    "scattering": {"phase": "isotropic", "aerosol": None},
    "render": {"samples_per_beam": 16},
    "retrieval": {"methods": ["cc"], "stride": 2},
    "sensor": {"method": "cc"},
    "volume": None,
    "doppler.lidar.pulse_energy": "1 mJ",
    "doppler.lidar.pulse_duration": "20 ns",
    "doppler.lidar.beam_radius": "5 cm",
    "doppler.lidar.divergence_full": "1 mrad",
    "doppler.lidar.telescope_area": "0.1 m^2",
    "doppler.lidar.fov_half": "3 mrad",
    "doppler.lidar.instrument_constant": 0.2,
    "doppler.lidar.counted": "before_etalon",
    "doppler.lidar.range": "76 m",
    "doppler.lidar.range_bin": "5 m",
    "doppler.lidar.backscatter": "1e-6 / m / sr",
    "doppler.lidar.extinction": "0.2 / km",
    "doppler.lidar.sky_radiance": "0.01 W/m^2/sr/nm",
    "doppler.lidar.filter_bandwidth": "0.2 nm",
    "doppler.ccd": {"read_noise": 9},
    "doppler.speckle_modes": 300,
    "doppler.reference": {"laser_drift": "3 MHz"},
    "doppler.assumed": {"focal_length": "301 mm"},
    "doppler.calibration": {"frames": 3},
    "doppler.retrieval": {"images": 2, "slow_images": 1},
}


def changed(data, key, value):
    for part in reversed(key.split(".")):
        value = {part: value}
    return reading.check(reading.merged(data, value), "changed")


def images(experiment):
    prepared, graph = prepare(experiment), stages_of(experiment)
    found = {}
    for stage in storing_stages(graph):
        found |= graph.compute(stage, prepared.results, prepared.log, experiment.folder)
    return found


def signatures(experiment):
    record, graph = new_record(experiment, "."), stages_of(experiment)
    return {
        part: made_by(record, graph.keys(stage))
        for stage in storing_stages(graph)
        for part in graph.parts(stage)
    }


@pytest.fixture(scope="module")
def unchanged():
    """Images of the small experiment."""
    return images(reading.check(small(), "base"))


def equal(one, other):
    return all(np.array_equal(one[n].values, other[n].values, equal_nan=True) for n in one)


def leaves(settings, above=""):
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"


@pytest.mark.parametrize(("stage", "behind"), [("images", BEHIND), ("ring_images", BEHIND_RINGS)])
def test_every_key_that_images_do_not_depend_on_is_tried(stage, behind):
    sections = {"doppler": DOPPLER, "detector": {}, "sensor": {"method": "cc"}}
    whole = reading.check(small() | sections, "whole")
    graph = stages_of(whole)
    keys = graph.keys(graph[stage])
    for leaf in leaves(reading.settings(whole)):
        # a coherent lidar has no rings
        others = (*behind, "encounter", "doppler.kind")
        tried = any(leaf == key or leaf.startswith(f"{key}.") for key in others)
        assert tried == (leaf not in keys), leaf


def test_images_do_not_depend_on_what_follows_them(unchanged):
    base = small()
    before, signed = unchanged, signatures(reading.check(base, "base"))
    other = base
    for key in BEHIND:
        if key == "sensor":  # which needs both lidars and their methods
            continue
        after = changed(other, key, BEHIND[key])
        other = reading.settings(after)
    found = images(after)
    for name in ("image_t1", "image_t2"):
        assert equal(before[name], found[name]) and signatures(after)[name] == signed[name]


def test_ring_images_do_not_depend_on_what_is_beside_them():
    base = {"name": "rings", "doppler": DOPPLER}
    before, signed = images(reading.check(base, "base")), signatures(reading.check(base, "base"))
    other = base
    for key in (k for k in BEHIND_RINGS if k not in ("volume", "sensor")):
        other = reading.settings(changed(other, key, BEHIND_RINGS[key]))
    after = reading.check(other, "after")
    found = images(after)
    for name in before:
        assert equal(before[name], found[name]) and signatures(after)[name] == signed[name]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("lidar.divergence_full", "1 mrad"),
        ("lidar.pulse_duration", "10 ns"),
        ("scan.range", "400 m"),
        ("platform.dt", "0.2 s"),
        ("wake.texture.rms", 0.3),
        ("seed", 2),
        ("render.samples_per_beam", 9),
    ],
)
def test_what_changes_an_image_changes_its_signature(key, value, unchanged):
    one, other = reading.check(small(), "base"), changed(small(), key, value)
    assert signatures(one)["image_t1"] != signatures(other)["image_t1"]
    two, four = unchanged, images(other)
    assert not (
        equal(two["image_t1"], four["image_t1"]) and equal(two["image_t2"], four["image_t2"])
    )


def test_images_of_equal_experiments_are_shared_whatever_their_units():
    """The same field of view in degrees and in radians, bit for bit; another one is another."""
    degrees, radians, other = (
        made_by(new_record(load_experiment("wake_backscatter", lidar={"fov_half": text}), "."))
        for text in ("0.5 deg", f"{math.radians(0.5)!r} rad", "0.51 deg")
    )
    assert degrees == radians != other


def test_where_the_detector_chooses_the_samples_images_depend_on_it():
    """Other pulse energies and detectors have other numbers of samples, or none of their own."""
    auto = small() | {"render": {"samples_per_beam": "auto", "max_order": 1}}
    with_detector = changed(auto, "detector", {})
    signed = signatures(with_detector)["image_t1"]
    for one, key in ((with_detector, "lidar.pulse_energy"), (with_detector, "detector")):
        other = changed(reading.settings(one), key, BEHIND[key])
        assert signatures(other)["image_t1"] != signed
    for key in ("name", "retrieval", "doppler"):
        other = changed(reading.settings(with_detector), key, BEHIND[key])
        assert signatures(other)["image_t1"] == signed
    without = reading.check(auto, "base")
    other = changed(auto, "lidar.pulse_energy", BEHIND["lidar.pulse_energy"])
    assert signatures(without)["image_t1"] == signatures(other)["image_t1"] != signed
