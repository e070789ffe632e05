"""Whether the wake is where the track predicts it: a likelihood ratio of measured rolling moments.

The rolling moment by the wind follows from the measured roll rate, L = I p' - L_p p - L_d d. With
the predicted one L* and errors of variance s^2, each independent sample has the logarithm of the
likelihood ratio of "there is no such wake" over "the wake is as predicted"

    [(L - L*)^2 - L^2] / 2 s^2.

Its sum, never below 0 (CUSUM, Page 1954, Biometrika 41, 100-115), is compared with a threshold.
This is also the comparison that matters to the controller: with a positive sum the aircraft is
better off without the preview.
"""

import math
from dataclasses import dataclass, field

from lidar_mi.aircraft.control import Preview, no_loads
from lidar_mi.aircraft.state import AircraftModel, AircraftState

FALSE_ALARMS = 1e-4
"""Of a right prediction, in each independent sample at most: the mean number of samples between
false alarms is the inverse or more (Lorden 1971, Ann. Math. Stat. 42, 1897-1908)."""

PREDICTION_ERROR = 0.19
"""Of the predicted moment over its largest: what a usable track may leave, `TrackSettings`."""

_LEAST_ERROR = 0.01  # of the largest moment of the ailerons: of gyros and of the model


@dataclass(eq=False)
class Integrity:
    """Withdraws a preview that the measured roll contradicts, and restores it.

    The preview is withdrawn when the sum reaches ln(1 / `FALSE_ALARMS`), at which it stays, and
    restored when it is back at 0. Samples are independent after the time in which the aircraft
    flies half of its span, the size of the eddies that roll it. Turbulence counts by the mean
    square of the moments that were measured where none are predicted.

    aircraft: its roll is that of the linear roll mode.
    withdrawn: whether the preview is withdrawn.
    sum: of the logarithms of the likelihood ratio.
    """

    aircraft: AircraftModel
    withdrawn: bool = False
    sum: float = 0.0
    _before: tuple[float, float, float] | None = field(default=None, repr=False)
    _largest: float = field(default=0.0, repr=False)
    _turbulence: tuple[float, float] = field(default=(0.0, 0.0), repr=False)

    def checked(
        self, preview: Preview | None, state: AircraftState, control: float
    ) -> Preview | None:
        """The preview, or that of no loads where it is withdrawn.

        ``state`` and ``control``, the rolling moment of the controls (N m), are those of now.
        """
        before, self._before = self._before, (state.time, state.roll_rate, control)
        predicted = float(preview(state.time).moment[..., 0]) if preview else 0.0
        if before is not None and state.time > before[0]:
            dt = state.time - before[0]
            rate = (state.roll_rate + before[1]) / 2
            moment = (
                self.aircraft.roll_inertia * (state.roll_rate - before[1]) / dt
                - self.aircraft.roll_damping * rate
                - (control + before[2]) / 2
            )
            self._add(moment, predicted, dt / self._independent(state))
        return no_loads if preview and self.withdrawn else preview

    def _independent(self, state: AircraftState) -> float:
        span = 2 * float(abs(self.aircraft.strips.places[:, 1]).max())
        return span / 2 / state.airspeed

    def _add(self, measured: float, predicted: float, samples: float) -> None:
        aileron = abs(self.aircraft.control_moments[0, 0]) * self.aircraft.limits.deflection[0]
        self._largest = max(self._largest, abs(predicted))
        least = _LEAST_ERROR * aileron
        if abs(predicted) <= least:
            squares, number = self._turbulence
            self._turbulence = squares + samples * measured**2, number + samples
        squares, number = self._turbulence
        variance = least**2 + (PREDICTION_ERROR * self._largest) ** 2
        variance += squares / number if number else 0.0
        change = ((measured - predicted) ** 2 - measured**2) / (2 * variance)
        most = math.log(1 / FALSE_ALARMS)
        self.sum = min(max(0.0, self.sum + samples * change), most)
        self.withdrawn = self.sum >= most or (self.withdrawn and self.sum > 0)
