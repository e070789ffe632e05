"""Errors of a speed that no image shows: what differs between the reference shot and the echo.

The laser's own light sets the zero of the speeds. Three things move the zero between its frame and
the echo's: a drift of the laser's frequency, a drift of the etalon, and defects of the plates where
laser and echo fill the pupil differently. All of them move the rings as a speed does, so that
chi-square stays 1. They follow from properties of the instrument that no image shows.

A change dd of the mean gap d that the light passes changes its order 2 d / wavelength as a speed of

    v = c/2 dd/d

would (Hernandez 1986, Fabry-Perot Interferometers, chapter 3, for the order;
docs/theory/calibration.md for the means over a disc). Over a disc of radius a about (s, 0), both
over the pupil's radius,

    bow,    b 12^(1/2) (rho^2 - 1/2):   b 12^(1/2) (a^2/2 + s^2 - 1/2)
    wedge,  2 w x:                      2 w s

with b and w the rms deviations over the full pupil. Light that is scrambled by a factor q fills the
pupil evenly with the fraction q of its power, whatever enters the scrambler; the difference between
laser and echo is 1 - q times what it was. First order in dd: the profile of the rings is taken as
shifted, not as wider (0.03 m/s of 4 m/s for a wedge of wavelength/100).
"""

import math
from dataclasses import dataclass, fields, replace

from scipy.constants import speed_of_light

from lidar_mi.errors import InputError


@dataclass(frozen=True)
class Filling:
    """Disc of even light in the etalon's pupil; lengths over the pupil's radius.

    shift: of the disc's middle, along the wedge. The disc is not cut where it exceeds the pupil.
    """

    radius: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.radius <= 1 and abs(self.shift) <= 1):
            raise InputError(
                f"filling: radius {self.radius!r}, shift {self.shift!r} are not allowed; expected "
                "a radius above 0 up to 1 and a shift of -1 to 1, over the pupil's radius"
            )

    @property
    def bow(self) -> float:
        """Mean of a bow over the disc, over its rms over the pupil."""
        return math.sqrt(12) * (self.radius**2 / 2 + self.shift**2 - 1 / 2)

    @property
    def wedge(self) -> float:
        """Mean of a wedge over the disc, over its rms over the pupil."""
        return 2 * self.shift


@dataclass(frozen=True)
class ReferenceUncertainty:
    """What is known of the differences between the reference shot and the echo.

    wavelength, gap: m; the gap's optical length.
    laser_drift: rms change of the laser's frequency between reference and echo, Hz.
    etalon_drift: rms change of the etalon's temperature between them, K.
    expansion: of the gap's spacers, 1/K; fused silica if not given.
    bow, wedge: rms over the full pupil of a quadratic and of a linear deviation of the gap, m.
    scrambling: of both before the etalon: 0 none, 1 perfect.

    Raises InputError: numbers out of range.
    """

    wavelength: float
    gap: float
    laser_drift: float = 0.0
    etalon_drift: float = 0.0
    expansion: float = 5e-7
    bow: float = 0.0
    wedge: float = 0.0
    laser: Filling = Filling()
    air: Filling = Filling()
    scrambling: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name not in ("laser", "air")):
            value, positive = getattr(self, name), name in ("wavelength", "gap")
            if not (math.isfinite(value) and value >= 0 and (value > 0 or not positive)):
                allowed = "above 0" if positive else "0 or more"
                raise InputError(f"{name}: {value!r} is not allowed; expected {allowed}")
        if self.scrambling > 1:
            raise InputError(f"scrambling: {self.scrambling!r} is not allowed; expected 0 to 1")

    def terms(self) -> dict[str, float]:
        """Systematic standard error of the speed by each cause, m/s."""
        by_gap = speed_of_light / 2 / self.gap
        unlike = (1 - self.scrambling) * by_gap
        return {
            "laser drift": self.wavelength / 2 * self.laser_drift,
            "etalon drift": speed_of_light / 2 * self.expansion * self.etalon_drift,
            "bow and pupil": unlike * self.bow * abs(self.air.bow - self.laser.bow),
            "wedge and pupil": unlike * self.wedge * abs(self.air.wedge - self.laser.wedge),
        }

    @property
    def total(self) -> float:
        """Root sum of squares of all terms, m/s."""
        return math.hypot(*self.terms().values())

    def scrambling_for(self, limit: float) -> float:
        """Least scrambling with which the total does not exceed ``limit`` (m/s).

        Raises InputError: a limit below what drifts alone cause.
        """
        drifts = replace(self, scrambling=1.0).total
        unscrambled = replace(self, scrambling=0.0).terms()
        by_pupil = math.hypot(unscrambled["bow and pupil"], unscrambled["wedge and pupil"])
        if not limit >= drifts:
            raise InputError(
                f"limit: {limit!r} m/s is not allowed; expected at least {drifts:.3g} m/s, which "
                "laser and etalon drift cause"
            )
        room = math.sqrt(limit**2 - drifts**2)
        return 0.0 if room >= by_pupil else 1 - room / by_pupil
