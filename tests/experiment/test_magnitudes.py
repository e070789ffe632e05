"""Remarks on magnitudes. Detects a likely slip of a unit that nothing is said about, a remark on a
shipped experiment, a key of the table that no experiment has.
"""

from pathlib import Path

import pytest

from lidar_mi.errors import InputError
from lidar_mi.experiment.magnitudes import USUAL, unusual
from lidar_mi.schema.keys import explain
from lidar_mi.schema.reading import load, load_variants
from lidar_mi.schema.shipped import experiments

SCENES = Path(__file__).parents[2] / "scenes"


def of(*changes, name="wake_sensor"):
    return list(unusual(load(SCENES / f"{name}.yaml", list(changes))))


def test_energies_say_their_unit():
    with pytest.raises(InputError, match="pulse_energy: 20 has no unit; expected an energy"):
        load(SCENES / "wake_sensor.yaml", ["lidar.pulse_energy=20"])


@pytest.mark.parametrize(
    ("change", "likely"),
    [
        ("lidar.pulse_energy=20 J", "20 J is more than known ones have"),
        ("lidar.pulse_energy=20 J", "is 20 mJ meant?"),
        ("doppler.lidar.pulse_energy=1e-9 J", "is 1 µJ meant?"),
        ("lidar.divergence_full=0.3 rad", "is 300 µrad meant?"),
    ],
)
def test_a_slip_of_the_unit_is_named(change, likely):
    (line,) = of(change)
    assert line.startswith(change.partition("=")[0] + ": ") and likely in line


def test_circulations_have_a_largest():
    (line,) = of("wake={vortex_pair: {circulation: 1800}}", name="wake_backscatter")
    assert line.startswith("wake.vortex_pair.circulation: 1800 m^2/s is more than known ones have")


@pytest.mark.parametrize("name", experiments())
def test_shipped_experiments_are_usual(name):
    for experiment in load_variants(SCENES / f"{name}.yaml").values():
        assert not list(unusual(experiment))


def test_idealisations_and_defaults_are_passed_over():
    assert not of("lidar.pulse_duration=0 s", "platform.speed=0")


@pytest.mark.parametrize("key", [one.key for one in USUAL])
def test_every_key_is_one_of_an_experiment(key):
    assert explain(key)
