"""A lidar for flights in tests: the truth with noise of known covariance, without images."""

import numpy as np

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.retrieval.vortices.pair import VortexPairFit

STDERR = np.array([4.0, 0.03, 0.15, 0.15, 4.0, 0.03, 0.15, 0.15, 0.1, 0.1])
"""Of the parameters of a pair."""


def encounter_keys(**encounter):
    """A short flight through a wake of 30 m, as the dictionary of an experiment."""
    path = {"start": "150 m", "beyond": "75 m", "crossing_angle": "20 deg"}
    pair = {"circulation": 350, "separation": 30, "core_radius": 3, "width": 100, "height": 70}
    return {
        "name": "flight",
        "wake": {"vortex_pair": pair, "spacing": 1, "extinction": {"molecules": 0}},
        "encounter": {"look_ahead": "75 m"}
        | encounter
        | {"path": path | encounter.get("path", {})},
    }


class SyntheticLidar:
    """Delivers the pair of the wake in the slab, with Gaussian errors; refuses none.

    Parameters
    ----------
    wake : WakeAlongPath
    rate, speed, look_ahead : float
        Hz, m/s, m.
    seed : int
    latency : float
        s.
    blind : callable, optional
        Called with the number of a scan; True: no estimate.
    """

    def __init__(
        self,
        wake: WakeAlongPath,
        rate=10.0,
        speed=75.0,
        look_ahead=75.0,
        seed=1,
        latency=0.02,
        blind=lambda number: False,
    ):
        self.wake, self.blind = wake, blind
        self._rate, self._speed, self._far, self._latency = rate, speed, look_ahead, latency
        self._random = np.random.default_rng(seed)
        self.steps: list[float] = []

    def step(self, t: float, pose: AircraftPose | None = None, expected=None) -> Estimate:
        self.steps.append(t)
        time, x = t - 0.5 / self._rate, self._speed * (t - 1 / self._rate) + self._far
        pair = None
        noise = self._random.normal(size=10) * STDERR
        if len(self.steps) > 1 and not self.blind(len(self.steps) - 1):
            parameters = []
            for vortex in self.wake.vortices(x, time):
                parameters += [vortex.circulation, np.log(vortex.core_radius), vortex.y, vortex.z]
            pair = VortexPairFit(
                np.array([*parameters, 0.0, 0.0]) + noise,
                np.diag(STDERR**2),
                "lamb_oseen",
                1.0,
                0.9,
                0.0,
                1.0,
            )
        return Estimate(time, t + self._latency, x, None, pair, (), {"vortices": 0.01})
