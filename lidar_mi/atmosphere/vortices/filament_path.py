"""A wake of bent vortex filaments along a flight path: waves up to linking, and rings."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.crow import crow_filaments
from lidar_mi.atmosphere.vortices.filament_table import FilamentTable
from lidar_mi.atmosphere.vortices.filaments import Filaments
from lidar_mi.atmosphere.vortices.vortex import Vortex, tangential_speed
from lidar_mi.atmosphere.vortices.wake_path import (
    CROW_WAVELENGTH,
    Components,
    PairAlongPath,
    check_cut,
    cut_radius,
)
from lidar_mi.errors import InputError


@dataclass(frozen=True)
class FilamentsAlongPath:
    """Lines with Crow's waves, or rings, along an axis that crosses the flight path.

    The velocity is that of Biot-Savart's law, from a table. The shape stays as it is when the
    aircraft arrives; it moves with the mean velocity that the lines induce on themselves, and its
    circulation decays. What the lines do to their own shape in the seconds between scan and
    passage is neglected.

    pair: circulation, separation, core, place, time, decay, wavelength and phase of the waves. Its
        `mean_wind` and `crow_amplitude` are 0.
    amplitude: of the waves, m; from that of linking on there are rings.
    """

    pair: PairAlongPath
    amplitude: float

    def __post_init__(self) -> None:
        if self.pair.crow_amplitude or any(self.pair.mean_wind):
            raise InputError(
                "filaments.pair: a mean wind or an amplitude is not allowed; expected neither"
            )

    @property
    def wavelength(self) -> float:
        """Wavelength, m."""
        return self.pair.crow_wavelength or CROW_WAVELENGTH * self.pair.separation

    @cached_property
    def filaments(self) -> Filaments:
        """The lines, of circulation 1 m^2/s, in the wake's axes."""
        pair = self.pair
        return crow_filaments(
            self.amplitude,
            pair.separation,
            self.wavelength,
            pair.core_radius,
            pair.model,
            pair.crow_phase,
        )

    @property
    def rings(self) -> bool:
        """Whether the vortices have linked."""
        return len(self.filaments.curves) == 1

    @cached_property
    def _table(self) -> FilamentTable:
        crest = (0.25 - self.pair.crow_phase / (2 * np.pi)) * self.wavelength
        return FilamentTable(self.filaments, crest)

    @cached_property
    def _descent(self) -> float:
        """Descent speed over that of the straight pair."""
        pair = self.pair
        straight = tangential_speed(pair.separation, 1.0, pair.core_radius, pair.model)
        return float(-self.filaments.drift[2] / straight)

    def centre_at(self, time: ArrayLike) -> np.ndarray:
        """Place (3, ...) at a time of the point that is at x_c and ``miss`` at t_c, m."""
        straight, at_arrival = (np.stack(self.pair.centre_at(t)) for t in (time, self.pair.t_c))
        at_arrival = at_arrival.reshape(3, *[1] * np.ndim(time))
        up = self.pair.axes[2].reshape(at_arrival.shape)
        sunk = ((straight - at_arrival) * up).sum(0)
        return straight + (self._descent - 1) * sunk * up

    def wind(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> Components:
        """u, v, w (m s^-1) at places (m) and times (s), which broadcast."""
        place = np.stack(
            np.broadcast_arrays(
                *(
                    np.asarray(a, float) - c
                    for a, c in zip((x, y, z), self.centre_at(time), strict=True)
                )
            )
        )
        rotation = np.stack(self.pair.axes)
        unit = self._table.velocity(np.einsum("ki,i...->k...", rotation, place))
        # rows are the wake's unit vectors: their transpose leads back to the path frame
        u, v, w = np.einsum("ki,k...->i...", rotation, self.pair.circulation_at(time) * unit)
        return u, v, w

    def extinction(self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike) -> None:
        """None: analytic vortices have the background everywhere."""

    def vortices(self, x: float, time: float) -> tuple[Vortex, Vortex]:
        """Port and starboard vortex in the plane x at a time.

        Their places are where the lines cross the plane; cores are given by the circle of their
        area.

        Raises InputError: a plane that does not cut both vortices once: between rings, along their
        ends, or along the wake.
        """
        pair = self.pair
        check_cut(pair.axes[0], pair.crossing_angle)
        rotation = np.stack(pair.axes)
        centre, strength = self.centre_at(time), float(pair.circulation_at(time))
        vortices: list[Vortex] = []
        for curve in self.filaments.curves:
            places, steps = curve.places @ rotation + centre, curve.steps @ rotation
            # the period whose nodes are nearest to the plane, and its neighbours
            advance = self.wavelength * rotation[0]
            nearest = round((x - places[:, 0].mean()) / advance[0])
            for number in range(nearest - 2, nearest + 3):
                vortices += self._crossings(places + number * advance, steps, x, strength)
        port = [vortex for vortex in vortices if vortex.circulation > 0]
        starboard = [vortex for vortex in vortices if vortex.circulation < 0]
        if len(port) != 1 or len(starboard) != 1:
            raise InputError(
                f"x: the plane at {x:g} m cuts {len(port)} port and {len(starboard)} starboard "
                "vortices; expected one of each"
            )
        return port[0], starboard[0]

    def _crossings(
        self, places: np.ndarray, steps: np.ndarray, x: float, strength: float
    ) -> list[Vortex]:
        """Vortices where a curve's nodes (path frame) cross the plane."""
        # a line that ends with the period goes on in the next one, a ring closes
        following = np.roll(places, -1, axis=0)
        if not self.rings:
            following[-1] = places[0] + self.wavelength * self.pair.axes[0]
        before, after = places[:, 0] - x, following[:, 0] - x
        vortices = []
        for k in np.flatnonzero((before < 0) != (after < 0)):
            part = before[k] / (before[k] - after[k])
            _, y, z = places[k] + part * (following[k] - places[k])
            radius = cut_radius(self.pair.core_radius, steps[k])
            circulation = float(np.sign(steps[k][0])) * strength
            vortices.append(Vortex(circulation, radius, float(y), float(z), self.pair.model))
        return vortices
