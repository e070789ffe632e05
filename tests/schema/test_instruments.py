"""Published instruments: detects a file that cannot be run, a number without its source, a source
that is not named, a page that differs from the files, and numbers that contradict one another.
"""

import re
from pathlib import Path

import pytest
from scipy.constants import c

import lidar_mi as lm
from lidar_mi.experiment.run import prepare
from lidar_mi.schema.shipped import instrument_file, instruments

PAGE = Path(__file__).parents[2] / "docs" / "instruments.md"
# keys of the instrument, whose values are numbers with units
NUMBER = re.compile(r"^ +(\w+): [\d.e+-]+ ?[a-zA-Z%^/]")


@pytest.mark.parametrize("name", instruments())
def test_every_instrument_can_be_run(name):
    found = lm.load_experiment(instrument_file(name))
    assert found.name == name
    # that a narrow field of view sees little of the near range is so of micro-pulse lidars
    assert not [text for text in prepare(found).warnings if "overlap" not in text]


@pytest.mark.parametrize("name", instruments())
def test_every_number_has_its_source(name):
    text = instrument_file(name).read_text()
    sources = set(re.findall(r"^# Source (\[\d\]): \S", text, re.MULTILINE))
    lines = [line for line in text.splitlines() if NUMBER.match(line)]
    assert lines
    for line in lines:
        _, _, comment = line.partition("#")
        told = "assumed" in comment or "[" in comment or "lidar-mi info" in comment
        assert told or comment.strip() == "the same", line
    assert set(re.findall(r"\[\d\]", text)) == sources


@pytest.mark.parametrize("name", instruments())
def test_the_page_is_that_of_the_files(name):
    title, published = instrument_file(name).read_text().splitlines()[:2]
    published = published.removeprefix("# Published: ").removesuffix(".")
    row = f"| `{name}` | {title.removeprefix('# ')} | {published} |"
    assert row in PAGE.read_text().splitlines()


def test_the_page_has_no_other():
    assert re.findall(r"^\| `(\w+)` \|", PAGE.read_text(), re.MULTILINE) == instruments()


def test_velocities_of_a_streamline():
    """Published: up to 19.2 m/s; a real receiver of 50 MHz is unambiguous to half of that."""
    laser = lm.load_experiment(instrument_file("halo_streamline")).doppler.laser
    assert laser.wavelength * laser.bandwidth / 4 == pytest.approx(19.2, rel=0.015)


def test_pulses_of_live():
    """Published: 700 ns, and a cone of 30 degrees that takes 17 s."""
    doppler = lm.load_experiment(instrument_file("live")).doppler
    assert doppler.laser.pulse_length == pytest.approx(c * 700e-9 / 2, rel=2e-3)
    assert doppler.scan.duration == pytest.approx(17, rel=0.05)


@pytest.mark.parametrize("name, reach", [("windcube_100s", 3000), ("windcube_200s", 6000)])
def test_range_of_a_windcube(name, reach):
    laser = lm.load_experiment(instrument_file(name)).doppler.laser
    assert laser.first_gate + (laser.gates - 1) * laser.gate_spacing == reach
