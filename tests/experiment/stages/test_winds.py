"""What is said of retrieved winds. Detects silence where nothing or little is valid, and the same
thing said twice."""

import numpy as np
import xarray as xr

from lidar_mi.experiment.stages.winds import vector_remarks
from lidar_mi.flags import Flag


def winds(valid, methods=("cc",)):
    """Of 100 vectors, so many are valid; the same of both kinds of images."""
    sources = ["extinction", "backscatter", "backscatter_noisy"]
    flag = np.full((3, len(methods), 10, 10), int(Flag.LOW_CORRELATION), "int16")
    flag.reshape(3, len(methods), 100)[..., :valid] = 0
    dims = "source", "algorithm", "z", "y"
    about = {
        "flag_masks": np.array([int(one) for one in Flag], "int16"),
        "flag_meanings": " ".join(one.name.lower() for one in Flag),
    }
    fields = {name: (dims, np.ones(flag.shape)) for name in ("v", "w")}
    return xr.Dataset(
        {**fields, "flag": (dims, flag, about)}, {"source": sources, "algorithm": list(methods)}
    )


def test_nothing_valid_is_said_once():
    (text,) = vector_remarks(winds(0))
    assert text.startswith("backscatter and backscatter_noisy, cc: no vector is valid; ")


def test_few_valid_vectors_of_templates_are_remarked_on():
    first, second = vector_remarks(winds(11))
    assert first.startswith("backscatter, cc: 11% of the vectors are valid; where most are flagged")
    assert second.startswith("backscatter_noisy, cc: 11%")
    assert vector_remarks(winds(60)) == []
    assert vector_remarks(winds(11, ["variational"])) == []
