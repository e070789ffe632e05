"""The keys of the retrieval of winds from two volumes."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from lidar_mi.retrieval.method_names import VolumeMethod
from lidar_mi.schema.section import Section, each_once
from lidar_mi.units import Number, Within


class Volume(Section):
    """Wind in three dimensions, from all gates of both scans as two volumes."""

    methods: tuple[VolumeMethod, ...] = Field(
        (VolumeMethod.CORRELATION, VolumeMethod.VARIATIONAL),
        min_length=1,
        description="cross-correlation of separate windows, or a smooth flow fitted to the volumes",
    )
    template: Annotated[int, Within(4, 1024, "wider than any volume")] = Field(
        8,
        description="voxels along each side of a window; also sets the knot spacing of the smooth "
        "flow",
    )
    search: Annotated[int, Within(6, 2048, "wider than any volume")] = Field(
        16,
        description="side of the search region, voxels; the largest displacement is half of "
        "search - template",
    )
    stride: Annotated[int, Within(1, 2048, "wider than any volume")] = Field(
        4, description="distance between vectors, voxels"
    )
    min_correlation: Annotated[Number, Within(-1, 1, "definition of a correlation")] = Field(
        0.5, description="vectors of lower correlation are flagged"
    )

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        each_once("methods", self.methods)
        return self
