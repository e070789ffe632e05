"""Memory of a run, before it begins: what images, winds and states of the air take."""

from dataclasses import dataclass

from lidar_mi.atmosphere.vortices.wake import MOST_NODES
from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan
from lidar_mi.io.exr import MOST_LAYERS
from lidar_mi.rendering.memory import (
    PER_PIXEL,
    PROGRAM,
    ceiling,
    check_memory,
    host_bytes,
    image_bytes,
)
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.retrieval import Retrieval
from lidar_mi.schema.volume import Volume
from lidar_mi.schema.wake import Wake

PER_NODE = 160
"""Bytes of a node of the wake: twenty fields in double precision."""
PER_ADVECTED = 450
"""Bytes of a node of a volume while it is advected along x; measured: 360 to 440."""
PER_VECTOR = 400
"""Bytes of a vector, per method and source: 25 variables, twice where they are concatenated."""
PER_VOXEL = 200
"""Bytes of a voxel of a volume whose wind is retrieved."""
PER_SPEED = 160
"""Bytes of a pixel of the fringe camera, for every speed but the first; measured: 157."""
PER_STATE = 34
"""Bytes of a value of moving air's states: three arrays in double precision while they are made,
two scans in single precision with what is mixed of them; measured, with molecules."""


def most_samples(render: RenderSettings, detector: Detector | None, beams: int, gates: int) -> int:
    """Samples per beam that an image may have, where their number is chosen; else their number."""
    if detector is None:
        return render.without_detector(gates)
    return render.most_samples(beams, gates)


@dataclass(frozen=True)
class Footprint:
    """What the memory of a run depends on. It is known to a factor of two."""

    wake: Wake | None
    scan: Scan
    lidar: BackscatterLidar
    detector: Detector | None
    render: RenderSettings
    retrieval: Retrieval
    volume: Volume | None
    doppler: Doppler | None

    def bytes(self, beams: int, in_states: int = 0) -> float:
        """Memory of the run.

        beams: of the backscatter lidar in an image; 0: there is none.
        in_states: values of all states of moving air in a scan, see `values_of_states`.
        """
        if not beams:
            return PROGRAM + self._rings()
        render, gates = self.render, self.scan.gate_count
        samples = beams * max(most_samples(render, self.detector, beams, gates), 2 * gates)
        images = self._per_beam(gates) * beams + host_bytes(samples, render)
        return PROGRAM + PER_STATE * in_states + images + self._rings()

    def check_size(self, columns: int, rows: int) -> None:
        """Refuse images that take more memory than a run may, or more layers than files hold."""
        gates, each = self.scan.gate_count, self._layers_per_gate()
        # three layers do not belong to a gate: Y, with noise, and its error
        most = (MOST_LAYERS - 3) // each
        if gates > most:
            raise InputError(
                f"scan.gate_count: {gates} is not allowed with {each} layers each; expected at "
                f"most {most}, as an EXR file has at most {MOST_LAYERS} layers"
            )
        check_memory(
            self.bytes(columns * rows),
            self.render.memory,
            f"scan: {columns} x {rows} beams x {gates} gates",
            "a larger wake.spacing, retrieval.stride or fewer gates",
        )

    def check_states(self, beams: int, in_states: int) -> None:
        """Refuse air in more states than a run may have in memory; parameters as of `bytes`."""
        check_memory(
            self.bytes(beams, in_states),
            self.render.memory,
            f"scan.air: moving, of {in_states:.2g} values in all states of a scan,",
            "frozen air, a shorter scan or a larger wake.spacing",
        )

    def most_nodes(self) -> int:
        """Nodes of the wake that a run can have in memory.

        Each node of a plane has a beam with ``aim: grid``.
        """
        wake, each = self.wake, float(PER_NODE)
        # the memory of the gates is checked by `check_size`
        if wake is not None and wake.second == "advect_3d":
            each = PER_ADVECTED
        elif wake is not None and wake.depth == "plane" and self.scan.aim == "grid":
            each = self._per_beam(1)
        left = ceiling(self.render.memory) - PROGRAM
        return max(1, min(MOST_NODES, int(left / each)))

    def _rings(self) -> float:
        """Bytes of the images of rings while they are fitted."""
        doppler = self.doppler
        if doppler is None:
            return 0.0
        pixels = doppler.camera.width * doppler.camera.height
        return pixels * (PER_PIXEL + PER_SPEED * (len(doppler.v_los) - 1))

    def _per_beam(self, gates: int) -> float:
        """Bytes that grow with the number of beams: the wake's nodes, images, vectors."""
        orders = self.render.max_order
        # Stokes vector, errors and correlation; both products with their errors; the detector's
        quantities = 12 + (orders if orders > 1 else 0) + 2 * bool(self.detector)
        voxels = gates if self.volume else 0
        return (
            PER_NODE
            + image_bytes(1, gates, quantities)
            + PER_VOXEL * voxels
            + PER_VECTOR * self._vectors_per_beam()
        )

    def _vectors_per_beam(self) -> float:
        """Vectors of all methods and sources over the number of beams."""
        if self.volume:
            return self.scan.gate_count / self.volume.stride**3 * len(self.volume.methods)
        sources = 5 if self.detector else 4
        return len(self.retrieval.methods) * sources / self.retrieval.stride**2

    def _layers_per_gate(self) -> int:
        """Layers of an image for each of its gates."""
        render = self.render
        polarised = "polarized" in render.variant
        depolarisation = polarised and tuple(self.lidar.stokes) == (1, 1, 0, 0)
        orders = render.max_order + 2 if render.max_order > 1 else 0
        noisy = 2 * bool(self.detector)
        shared = 2 * render.for_winds().common
        return 5 + shared + 2 * polarised + 2 * depolarisation + orders + noisy
