"""Which winds a vortex pair is fitted to. Detects a choice that depends on the order of methods."""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.assessment.report.vortices import vortex_chapter
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.stages.vortices import image_vectors, vectors_method
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST, ImageMethod


def winds(methods):
    """Winds that tell by their value which method they are from; the last source counts."""
    values = np.arange(2 * len(methods), dtype=float).reshape(2, -1, 1, 1)
    dims = ("source", "algorithm", "z", "y")
    place = (("z", "y"), [[0.0]])
    return xr.Dataset(
        {"v": (dims, values), "y_vector": place, "z_vector": place},
        {"algorithm": methods, "source": ["extinction", "backscatter"]},
    )


def test_every_method_with_vectors_has_a_rank():
    assert {*MOST_ACCURATE_FIRST} == {*ImageMethod} - {ImageMethod.VORTEX_FIT}


@pytest.mark.parametrize(
    ("methods", "best"),
    [
        (["cc", "vortex_fit", "variational"], "variational"),
        (["variational", "cc", "vortex_fit"], "variational"),
        (["ws", "cc", "vortex_fit"], "cc"),
        (["vortex_fit", "cc", "multipass"], "multipass"),
    ],
)
def test_the_most_accurate_method_is_taken_in_any_order(methods, best):
    experiment = lm.load_experiment("wake_backscatter", retrieval={"methods": methods})
    found = call(image_vectors, experiment, wind=winds(methods))
    assert str(found["algorithm"].values) == best == call(vectors_method, experiment)
    assert float(found["v"].item()) == len(methods) + methods.index(best)
    assert {"y_vector", "z_vector"} <= set(found.coords)


def test_vortex_fit_alone_has_no_vectors():
    experiment = lm.load_experiment("wake_backscatter", retrieval={"methods": ["vortex_fit"]})
    assert call(image_vectors, experiment, wind=winds(["vortex_fit"])) is None


def test_a_sensor_s_own_method_is_used_and_reported():
    experiment = lm.load_experiment("wake_sensor")
    assert call(vectors_method, experiment) == experiment.sensor.method
    chapter = vortex_chapter({}, {}, {}, [], "multipass")
    assert "vectors of the multi-pass correlation" in chapter.lead[0]
