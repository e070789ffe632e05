"""Scans of a flight that was stopped, and the flight that goes on with them.

Detects images that change in their last bit on the way through a file, scans of another pose or
flight that are taken for one's own, scans that are rendered again or that stay behind.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.encounter.lidar.scan_store import Scan, ScanStore
from lidar_mi.encounter.lidar.virtual_lidar import VirtualLidar
from lidar_mi.experiment.log import silent
from tests.support.encounters import small_encounter

POSE = AircraftPose(7.5, 0.25, -0.5, roll=0.1)


def image(shape, seed):
    values = np.random.default_rng(seed).standard_normal(shape)
    axes = {"z": np.arange(shape[0]) / 3, "y": np.arange(shape[1]) / 7}
    return xr.DataArray(values, axes, ("z", "y"), attrs={"units": "m-1 sr-1"})


@pytest.fixture
def scan():
    return Scan(image((4, 5), 1), image((5, 6), 2), image((5, 6), 3))


def test_a_scan_is_read_as_it_was(tmp_path, scan):
    store = ScanStore(tmp_path / "scans", "one")
    assert store.read(3, POSE) is None and store.number == 0
    store.write(3, POSE, scan)
    found = store.read(3, replace(POSE, y=POSE.y + 1e-9))
    for name in ("near", "far", "far_noise"):
        xr.testing.assert_identical(
            getattr(found, name).drop_attrs().rename(None),
            getattr(scan, name).drop_attrs().rename(None),
        )
    assert store.number == 1
    store.remove()
    assert store.read(3, POSE) is None and not store.folder.exists()


def test_scans_of_others_do_not_count(tmp_path, scan):
    store = ScanStore(tmp_path, "one")
    store.write(3, POSE, scan)
    for axis in ("x", "y", "z", "roll", "pitch", "yaw"):
        assert store.read(3, replace(POSE, **{axis: getattr(POSE, axis) + 1e-4})) is None
    assert store.read(3, POSE, (0.0, 1e-4)) is None
    assert store.read(2, POSE) is None
    assert ScanStore(tmp_path, "another").read(3, POSE) is None
    (tmp_path / "scan_0003.nc").write_bytes(b"\x89HDF\r\n\x1a\n damaged")
    assert store.read(3, POSE) is None


@pytest.mark.slow
def test_a_flight_that_was_stopped_goes_on(tmp_path, monkeypatch):
    """The scans made before are not made again; the flight is that which was not stopped."""
    monkeypatch.setattr("lidar_mi.encounter.fly.write_report", lambda *_: None)
    experiment = small_encounter(path={"start": "170 m", "beyond": "10 m"})
    made, render = [], VirtualLidar._scanned

    def stopped(lidar, number, *where):
        if number == stop:
            raise KeyboardInterrupt
        made.append(number)
        return render(lidar, number, *where)

    monkeypatch.setattr(VirtualLidar, "_scanned", stopped)
    stop = 3
    with pytest.raises(KeyboardInterrupt) as stopping:
        lm.fly(experiment, tmp_path / "one", notice=silent)
    assert "scans that are there" in stopping.value.__notes__[0]
    stop = None
    resumed = lm.fly(experiment, tmp_path / "one", notice=silent)
    assert sorted(made) == list(range(max(made) + 1)) and max(made) > 3
    assert not (tmp_path / "one" / "scans").exists()
    assert "3 scans of the flight" in (tmp_path / "one" / "log.txt").read_text()
    whole = lm.fly(experiment, tmp_path / "other", notice=silent)
    np.testing.assert_allclose(resumed.series["roll"], whole.series["roll"], atol=1e-6)
