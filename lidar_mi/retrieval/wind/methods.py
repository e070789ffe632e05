"""Methods of retrieving winds from images, by name, with what each takes and gives."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lidar_mi.retrieval.correlation.cross_correlation import cross_correlation
from lidar_mi.retrieval.correlation.multipass import multipass
from lidar_mi.retrieval.correlation.weight_shift import weight_shift
from lidar_mi.retrieval.flow.variational import variational
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.vortices.windows import vortex_windows


@dataclass(frozen=True)
class Method:
    """A way to find displacements.

    find: (image1, image2, template, search, stride, **options) -> Displacement, in pixels.
    score: what its `Displacement.score` is: name in the data set, meaning.
    options: keywords of `retrieve_wind` it takes, `min_correlation` and `noise` among them.
    centred: vectors belong to the windows' centres, not half their displacement further on.
    local: a vector depends on its window only, and is flagged without texture there or as an
        outlier among its neighbours. A field fitted as a whole has standard errors of its own.
    reach: range of its first displacements over that of its windows. 0: the method checks by itself
        whether the images are related.
    bootstrapped: standard errors are from the retrieval of a known motion (`bootstrap`). Else the
        method states its errors by itself.
    name: as data sets have it.
    """

    find: Callable[..., Displacement]
    score: tuple[str, str]
    options: tuple[str, ...] = ()
    centred: bool = False
    local: bool = True
    reach: int = 1
    bootstrapped: bool = False
    name: str = ""

    @property
    def timed(self) -> bool:
        """Whether the method takes the times of pixels and gives displacements in dt."""
        return "times" in self.options


METHODS: Mapping[str, Method] = {
    "cc": Method(
        cross_correlation,
        ("correlation", "normalised cross-correlation at the peak"),
        ("min_correlation",),
        bootstrapped=True,
        name="cc",
    ),
    "ws": Method(
        weight_shift,
        ("mismatch", "misfit of weight and centre of mass over their spread"),
        bootstrapped=True,
        name="ws",
    ),
    "multipass": Method(
        multipass,
        ("correlation", "normalised cross-correlation of the deformed windows"),
        ("min_correlation", "noise", "settings", "partly"),
        centred=True,
        reach=2,
        bootstrapped=True,
        name="multipass",
    ),
    "variational": Method(
        variational,
        ("correlation", "normalised cross-correlation of the images warped to mid-time"),
        ("min_correlation", "noise", "more", "blur", "settings"),
        centred=True,
        local=False,
        reach=2,
        name="variational",
    ),
    "vortex_fit": Method(
        vortex_windows,
        ("correlation", "correlation of the images, each warped to mid-time"),
        ("noise", "axes", "dt", "times"),
        centred=True,
        local=False,
        reach=0,
        name="vortex_fit",
    ),
}
"""Methods by name."""
