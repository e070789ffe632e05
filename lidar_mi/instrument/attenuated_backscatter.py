"""From received energy to backscatter."""

import numpy as np

from lidar_mi.instrument.scan import ScanPlan


def attenuated_backscatter(
    s0: np.ndarray, plan: ScanPlan, aperture_area: float, environment: float
) -> np.ndarray:
    """Range-corrected attenuated backscatter coefficient, m^-1 sr^-1: S0 r^2 / (A dr T^2).

    The single-scattering lidar equation solved for the backscatter coefficient, with the
    environment's two-way transmittance to the middle of the gate. The image of a homogeneous slab
    is flat. Attenuation by the slab itself is not corrected (0.25 % to the middle of 2.5 m at
    1 / km).

    Of beams with poses of their own the reported ranges are used (`ScanPlan.ranges`), as by an
    instrument that knows no others. ``s0`` is received over emitted energy, the area in m^2,
    ``environment`` the extinction coefficient up to the gate (m^-1).
    """
    r = plan.ranges()
    transmittance = np.exp(-2 * environment * r)
    return s0 * r**2 / (aperture_area * plan.gate_length() * transmittance)
