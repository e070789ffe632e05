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
"""Methods that winds are retrieved by, as figures and tables call them."""

SOURCE_NAMES: Mapping[str, str] = {
    Source.BACKSCATTER: "backscatter",
    Source.NOISY: "backscatter with detector noise",
    Source.EXTINCTION: "extinction",
    Source.BLURRED: "extinction blurred by the beam",
    Source.WITHOUT_TEXTURE: "extinction without texture",
}
"""What winds are retrieved from, as figures and tables call it."""

BACKSCATTER = "attenuated backscatter / 10$^{-6}$ m$^{-1}$ sr$^{-1}$"
