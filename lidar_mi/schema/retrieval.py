"""The keys of the retrieval of cross-flow winds from two images."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.section import Section, each_once
from lidar_mi.units import Angle, Length, Number, Within


class Pointing(Section):
    """What is known of the pointing from one scan to the next."""

    offset: Literal["known", "free"] = Field(
        "known",
        description="whether the combination with lines of sight may estimate the apparent wind "
        "by unknown pointing",
    )
    stderr: Annotated[Angle, Within(0, 0.1, "displaced by more than the image")] = Field(
        0.0, description="standard error of pitch and of yaw between the scans"
    )
    roll: Annotated[Angle, Within(0, 0.1, "displaced by more than the image")] = Field(
        0.0, description="standard error of roll between the scans"
    )

    @model_validator(mode="after")
    def _free_by_how_much(self) -> Self:
        if self.offset == "free" and not self.stderr:
            raise ValueError(
                "stderr: 0 rad is not allowed with offset free; expected above 0 rad, the standard "
                "error of the pointing before"
            )
        return self


class Retrieval(Section):
    """How winds are retrieved from the image pair."""

    methods: tuple[ImageMethod, ...] = Field(
        (ImageMethod.VARIATIONAL, ImageMethod.CC),
        min_length=1,
        description="cross-correlation, weight shift, multi-pass correlation, a smooth flow or a "
        "vortex pair fitted to the whole images",
    )
    template: Annotated[int, Within(2, 4096, "wider than any image")] = Field(
        8, description="side of the template, pixels"
    )
    search: Annotated[int, Within(4, 8192, "wider than any image")] = Field(
        16, description="side of the search region, pixels; at least template + 2"
    )
    stride: Annotated[int, Within(1, 8192, "wider than any image")] = Field(
        1, description="distance between vectors, pixels"
    )
    min_correlation: Annotated[Number, Within(-1, 1, "definition of a correlation")] = Field(
        0.5, description="vectors of lower correlation are flagged (not of ws)"
    )
    min_texture: Annotated[Number, Within(0, 1000, "noise without signal has about 1")] = Field(
        0.01, description="templates of lower relative gradient are flagged, 1/px"
    )
    min_isotropy: Annotated[Number, Within(0, 1, "definition of a ratio")] = Field(
        0.2, description="templates with structure in one direction only are flagged"
    )
    blur: Literal["beam"] | Annotated[Length, Within(0, 1000, "the widest beam")] = Field(
        0.0,
        description="standard deviation of the beam's blur, corrected by variational; beam: half "
        "the 1/e^2 radius of the beam at the slab",
    )
    pointing: Pointing = Pointing()
    error_budget: bool = Field(
        False, description="also retrieve winds without each cause of error in turn"
    )
    sources: Literal["all", "measured"] = Field(
        "all",
        description="winds also from ideal images of the truth, for comparison; or from the "
        "lidar's images alone, four times faster",
    )

    @model_validator(mode="after")
    def _budget_compares(self) -> Self:
        if self.error_budget and self.sources != "all":
            raise ValueError(
                "sources: 'measured' is not allowed with error_budget; expected all, or "
                "retrieval.error_budget=false"
            )
        return self

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        each_once("methods", self.methods)
        return self

    @model_validator(mode="after")
    def _region_holds_template(self) -> Self:
        if self.search < self.template + 2:
            raise ValueError(
                f"search: {self.search} is not allowed; expected at least template + 2 = "
                f"{self.template + 2}"
            )
        return self
