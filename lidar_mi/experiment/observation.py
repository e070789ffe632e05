"""What a backscatter lidar observes, and from where: the sections that stages take together."""

from lidar_mi.experiment.graph import bundle
from lidar_mi.instrument.scan import Scan
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.volume import Volume
from lidar_mi.schema.wake import Wake


@bundle
class Observation:
    """A wake, the platform that flies towards it, and the scans of a slab or a volume of it."""

    wake: Wake
    platform: Platform
    scan: Scan
    volume: Volume | None

    @property
    def moves_along(self) -> bool:
        """Whether air moves along x between the images; a plane of air is uniform along it."""
        wake = self.wake
        in_volume = wake.second == "advect_3d" and wake.depth == "volume"
        return wake.turbine is not None or self.volume is not None or in_volume
