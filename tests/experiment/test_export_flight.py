"""A flight's data for other programs. Detects values or places that differ from its files, a flight
that is taken for a run without results."""

import numpy as np
import pandas as pd
import pytest

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.experiment.export_flight import FLIGHT_FILES, flight_results
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.yaml import to_yaml
from tests.support.encounter_results import made_up_flights


@pytest.fixture
def folder(tmp_path):
    settings = {"name": "mine", "encounter": {"rate": 10}}
    (tmp_path / "experiment.yaml").write_text(to_yaml({"experiment": settings, "versions": {}}))
    return tmp_path


@pytest.fixture
def flight(folder):
    for name, file in FLIGHT_FILES.items():
        write_netcdf(getattr(made_up_flights(), name), folder / file)
    return folder


def test_tables_have_the_values_of_the_flight(flight):
    names = [path.name for path in lm.export(flight, "csv")]
    assert names == ["flight.csv", "track.csv", "slab_winds.csv"]
    table = pd.read_csv(flight / "csv" / "flight.csv")
    with_lidar = table[table["flight"] == "feedforward"]
    roll = made_up_flights().series["roll"].sel(flight="feedforward")
    np.testing.assert_allclose(with_lidar["roll [rad]"], roll, rtol=1e-6)
    assert (
        len(pd.read_csv(flight / "csv" / "track.csv")) == 3 * made_up_flights().track.sizes["slab"]
    )
    winds = pd.read_csv(flight / "csv" / "slab_winds.csv")
    assert len(winds) == made_up_flights().slabs["v"].size
    row = winds.iloc[7]
    there = (
        made_up_flights()
        .slabs.swap_dims(slab="x")["v"]
        .sel(x=row.iloc[0], y=row.iloc[1], z=row.iloc[2])
    )
    assert row["v"] == pytest.approx(float(there))


@pytest.mark.slow
def test_points_are_the_vortices(flight):
    results = dict(flight_results(flight, placed=True))
    truth, track = results["vortices_truth"], made_up_flights().track.sel(source="truth")
    slabs = track.sizes["slab"]
    np.testing.assert_allclose(truth["y"][:slabs], track["port_y"])
    np.testing.assert_allclose(truth["circulation"][slabs:], track["starboard_circulation"])
    names = {path.name for path in lm.export(flight, "vtk")}
    assert {"flight_off.vtu", "vortices_truth.vtu", "slab_images.vti"} <= names


def test_a_flight_that_was_not_flown_says_so(folder):
    with pytest.raises(InputError, match=r"a flight without results yet; expected flight\.nc, tra"):
        lm.export(folder)
