"""Unlike vortices and the parameters of a pair, for the tests of vortex fits."""

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import Vortex


def vector(*vortices, mean=(0.0, 0.0)):
    """Parameters of a port and a starboard vortex."""
    values = [p for o in vortices for p in (o.circulation, np.log(o.core_radius), o.y, o.z)]
    return np.array([*values, *mean])


def uneven(profile="lamb_oseen"):
    """Port and starboard, with unlike circulations, radii and heights."""
    return Vortex(300.0, 2.5, 13.0, 1.0, profile), Vortex(-260.0, 3.5, -12.0, -2.0, profile)
