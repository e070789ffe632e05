"""An encounter into a folder: files, resuming, what is refused, the command.

Detects a flight that is computed again or mixed with another, a report without its answer or its
slider, faults that are no one line, an experiment that the wrong command takes.
"""

import json
import re
from pathlib import Path

import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.cli.fly import fly as command
from lidar_mi.encounter.check import geometry
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.instrument.scan import Scan
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.reading import check
from tests.support.command_line import in_process
from tests.support.synthetic_lidar import SyntheticLidar, encounter_keys


def experiment(**changes):
    return check(encounter_keys(**changes), "test")


SHORT = {"start": "60 m", "beyond": "20 m"}


def test_folder_holds_the_flight(tmp_path):
    one = experiment(control={"mode": "perfect"}, path=SHORT)
    flight = lm.fly(one, tmp_path / "out", notice=silent)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == set(
        ("experiment.yaml flight.nc metrics.json report.html log.txt summary.txt figures").split()
    )
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics == flight.metrics and metrics["encounter.off.largest_roll"] > 0.02
    with xr.open_dataset(tmp_path / "out" / "flight.nc", engine="h5netcdf") as found:
        assert found["roll"].attrs["units"] == "rad" and found.sizes["flight"] == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Largest roll angles in this wake: " in page and "http" not in page
    # again: nothing is flown
    before = (tmp_path / "out" / "flight.nc").stat().st_mtime_ns
    again = lm.fly(one, tmp_path / "out", notice=silent)
    assert again.metrics == flight.metrics
    assert (tmp_path / "out" / "flight.nc").stat().st_mtime_ns == before
    # a lost report is written again, without a flight
    (tmp_path / "out" / "metrics.json").unlink()
    assert lm.fly(one, tmp_path / "out", notice=silent).metrics == flight.metrics
    assert (tmp_path / "out" / "flight.nc").stat().st_mtime_ns == before
    other = experiment(control={"mode": "off"}, path=SHORT)
    with pytest.raises(InputError, match="holds another experiment"):
        lm.fly(other, tmp_path / "out", notice=silent)
    lm.fly(other, tmp_path / "out", overwrite=True, notice=silent)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text()).keys() < metrics.keys()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is no flight's folder"):
        lm.fly(one, tmp_path / "other", notice=silent)


@pytest.mark.slow
def test_report_of_a_flight_with_a_lidar(tmp_path, monkeypatch):
    monkeypatch.setattr("lidar_mi.encounter.report.draw_all", lambda *_: [])
    monkeypatch.setattr("lidar_mi.assessment.figures.encounter_film.RATE", 2)
    one = experiment()
    flight = lm.fly(one, tmp_path, lidar=SyntheticLidar(wake_along_path(one)), notice=silent)
    assert (tmp_path / "summary.txt").read_text().split("\n")[:-1] == flight.answer
    assert flight.answer[-1].startswith("Landing, flight control, from wind vectors: ")
    page = (tmp_path / "report.html").read_text()
    assert "Beyond the autopilot, the lidar removes" in page and "own goal of 80 %" in page
    assert "Requirements, as measured in flight" in page
    row = 'data-head="measured">10 Hz</td><td data-head="required">at least 10 Hz</td>'
    assert row in page
    assert flight.metrics["encounter.normalised_innovation"] < 2
    shown = str(flight)
    assert (
        "largest roll angle / degrees" in shown and "first preview before the wake is felt" in shown
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"look_ahead": "9 m"},
            "encounter.look_ahead: 9 m is not allowed; expected more than 15 m",
        ),
        ({"look_ahead": "7 m"}, "encounter.look_ahead: 7 m is not allowed"),
        ({"control": {"latency": "2 s"}}, "encounter.look_ahead: 75 m is not allowed"),
        ({"path": {"altitude": "10 m"}}, "below the ground"),
        ({"aircraft": {"model": "paper plane"}}, "encounter.aircraft.model: 'paper plane'"),
        ({"control": {"mode": "hope"}}, "encounter.control.mode"),
    ],
)
def test_faults_are_one_line(changes, message):
    with pytest.raises(InputError) as error:
        lm.fly(experiment(**changes), notice=silent)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_lidar_without_a_step_is_refused():
    with pytest.raises(InputError, match="lidar: object is not allowed; expected Lidar or None"):
        lm.fly(experiment(), lidar=object(), notice=silent)


def test_off_needs_no_quotes(tmp_path):
    """YAML reads it as false."""
    path = tmp_path / "calm.yaml"
    path.write_text("base: encounter\nname: calm\nencounter: {control: {mode: off}}\n")
    assert lm.load_experiment(path).encounter.control.mode == "off"
    with pytest.raises(InputError, match="mode: True is not allowed"):
        lm.load_experiment(path, **{"encounter.control.mode": True})


def test_path_that_misses_is_warned_of():
    assert geometry(experiment()) == []
    (text,) = geometry(experiment(path={"miss": {"z": "400 m"}}, control={"mode": "off"}))
    assert text.startswith("encounter.path: the flight misses the wake")
    # beside the image, too
    assert len(geometry(experiment(path={"miss": {"z": "400 m"}}))) == 2


def test_keys_without_effect_are_warned_of():
    """A thickness that does not divide the 7.5 m from scan to scan, and a run's own speed."""
    depth, speed = geometry(
        experiment(control={"mode": "off"})
        .model_copy(update={"scan": Scan(thickness="3 m"), "platform": Platform(speed="100 m/s")})
        .read_from(Path())
    )
    assert depth.startswith("scan.thickness: 3 m becomes 3.75 m") and "2.5 m" in depth
    assert speed.startswith("platform.speed: 100 m/s has no effect on a flight; encounter.path.s")
    assert speed.endswith("makes it 75 m/s")


def test_each_command_takes_its_own():
    with pytest.raises(InputError, match="is a flight, not a run; expected lidar-mi fly"):
        lm.run(experiment())
    with pytest.raises(InputError, match="encounter: missing in wake_sensor"):
        lm.fly("wake_sensor", notice=silent)
    with pytest.raises(InputError, match="expected the section of a flight, or lidar-mi run"):
        command("wake_sensor")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """What the command says of a short flight without control, and its folder."""
    folder = tmp_path_factory.mktemp("flown") / "out"
    changes = ("start=60 m", "beyond=10 m", "crossing_angle=20 deg")
    sets = [part for one in changes for part in ("--set", f"encounter.path.{one}")]
    return in_process("fly", "encounter", "--mode", "off", *sets, "-o", folder), folder


def test_the_command_flies(flown):
    done, folder = flown
    assert done.returncode == 0, done.stderr
    assert "largest roll angle" in done.stdout and (folder / "flight.nc").is_file()
    assert re.search(r"without control: \d+ of \d+ s", done.stderr)


def test_info_shows_a_flight(flown):
    """Its settings in usual units, without those that have no effect, and its numbers."""
    done = in_process("info", flown[1])
    assert done.returncode == 0, done.stderr
    for words in ("encounter.path.crossing_angle", "20 deg", "532 nm", "largest roll angle"):
        assert words in done.stdout
    assert "platform.dt" not in done.stdout and "without control" in done.stdout
