"""What figures, tables and reports call methods, sources and quantities."""

from collections.abc import Mapping

from lidar_mi.assessment.metrics.names import Source
from lidar_mi.retrieval.method_names import ImageMethod, VolumeMethod

METHOD_NAMES: Mapping[str, str] = {
    ImageMethod.CC: "cross-correlation",
    ImageMethod.WS: "weight shift",
    ImageMethod.MULTIPASS: "multi-pass correlation",
    ImageMethod.VARIATIONAL: "variational retrieval",
    ImageMethod.VORTEX_FIT: "vortex fit",
    VolumeMethod.CORRELATION: "correlation",
}
"""Names of the wind retrieval methods in figures and tables."""

SOURCE_NAMES: Mapping[str, str] = {
    Source.BACKSCATTER: "backscatter",
    Source.NOISY: "backscatter with detector noise",
    Source.EXTINCTION: "extinction",
    Source.BLURRED: "extinction blurred by the beam",
    Source.WITHOUT_TEXTURE: "extinction without texture",
}
"""Names of the data that winds are retrieved from in figures and tables."""

BACKSCATTER = "attenuated backscatter / 10$^{-6}$ m$^{-1}$ sr$^{-1}$"

_KINDS = (
    ("rmse_", "rms error of "),
    ("bias_", "mean error of "),
    ("error_", "error of "),
    ("stderr_", "stated error of "),
    ("coverage_68_", "coverage of 68 %, "),
    ("coverage_95_", "coverage of 95 %, "),
    ("monte_carlo_", "noise of the simulation in "),
)
_QUANTITIES = {
    "rmse": "rms error",
    "bias": "mean error",
    "v_los": "the line-of-sight speed",
    "valid_fraction": "fraction of valid vectors",
    "largest_roll": "largest bank angle",
}
_ORIGINS = {**METHOD_NAMES, **SOURCE_NAMES}


def title_of(key: str) -> str:
    """What a metric is called in headings: the quantity first, then where it is from.

    >>> title_of("backscatter_noisy.variational.all.rmse_v")
    'rms error of v, backscatter with detector noise, variational retrieval'
    """
    *places, quantity = key.split(".")
    prefix = "standard error of " if quantity.endswith("_stderr") else ""
    quantity = quantity.removesuffix("_stderr")
    start, words = next((p for p in _KINDS if quantity.startswith(p[0])), ("", ""))
    stem = quantity.removeprefix(start)
    name = _QUANTITIES.get(stem, stem)
    origin = [_ORIGINS.get(place, place) for place in places if place != "all"]
    texts = [prefix + words + name, *origin]
    return ", ".join(texts).replace("_", " ")
