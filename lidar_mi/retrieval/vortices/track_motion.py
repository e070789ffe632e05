"""Transition of the vortices of a slab of air to another slab: along the path and in time.

State: the parameters of `lidar_mi.retrieval.vortices.model.PARAMETERS` in the plane of a slab, then
the slopes along the path, `SLOPES`. Frame: x along the path, y left, z up.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.model import PARAMETERS, Profile, angular_velocity

SLOPES = ("port_dy_dx", "port_dz_dx", "starboard_dy_dx", "starboard_dz_dx")
"""Slopes of the vortices along the path, m/m; after the parameters in a state."""

PLACES = [2, 3, 6, 7]
"""Parameters that move along the slopes and with the drift."""
CIRCULATIONS = [0, 4]
CORES = [1, 5]
MEAN_WIND = [8, 9]
_OF_SLOPES = slice(len(PARAMETERS), len(PARAMETERS) + len(SLOPES))

# Along y and z the places of both vortices drift together.
_DRIFTING = np.zeros((len(PARAMETERS) + len(SLOPES), 2))
_DRIFTING[[2, 6], 0] = _DRIFTING[[3, 7], 1] = 1.0

# Kolmogorov's constants: transverse second-order structure function (4/3 of 2.0, Pope 2000,
# Turbulent Flows, 6.2 and 6.5), and that of a fluid particle in time (Pope 2000, 12.3).
_TRANSVERSE = 8 / 3
_LAGRANGIAN = 6.5
# Distance in m at which the random walk of the mean wind has the variance of the turbulence: about
# that of the vortices, over which the fit averages.
_MATCHED = 50.0


@dataclass(frozen=True)
class Wandering:
    """How much a wake departs from a straight, steady pair: standard deviations of random walks.

    A walk per root of metre grows to 7 times its value over 50 m, about a separation.

    circulation: of each circulation along the path, relative, m^-1/2: 1.4 % over 50 m. Simulated
        vortices in weak turbulence vary along their axis by some per cent (Hennemann and Holzäpfel
        2011, J. Aerosp. Eng. 24).
    log_radius: of each core radius along the path, relative, m^-1/2: 3.5 % over 50 m.
    place: of each coordinate along the path, m^1/2: curvature finer than the slabs resolve, 7 cm
        over 50 m.
    slope: of each slope along the path, m^-1/2: a sine of amplitude A and wave number k changes its
        slope by A k over a quarter of its wavelength. 0.02 over 100 m are those of Crow waves of 3
        % of the separation (8.6 separations of 47 m).
    dissipation: of turbulent energy, m^2 s^-3: the mean wind over the pair varies along the path as
        Kolmogorov's transverse structure function at 50 m, 8/3 (dissipation r)^(2/3), and in the
        air that drifts with the wake as that of fluid particles, 6.5 dissipation t. 1e-5 is a calm
        atmosphere at cruise or in the evening; 1e-3 a convective boundary layer.
    decay: unknown relative rate of both circulations, s^-1: between those of slow diffusion, about
        1/400 s^-1, and of rapid decay, about 1/60 s^-1 (Holzäpfel 2003, J. Aircr. 40, 323-331).
        Enters as rate times time in predictions: what changes steadily is no random walk.
    departure: unknown departure of each vortex's velocity from the drift of a straight pair, m/s,
        likewise times time: curved and oblique vortices induce others. Crow waves of 3 % of the
        separation grow by 0.8 per time of descent (Crow 1970), 0.035 m/s.

    Raises InputError: a value that is not a number of 0 or more.
    """

    circulation: float = 0.002
    log_radius: float = 0.005
    place: float = 0.01
    slope: float = 0.002
    dissipation: float = 1e-5
    decay: float = 0.01
    departure: float = 0.035

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value < np.inf:
                raise InputError(
                    f"wandering.{field.name}: {value!r} is not allowed; a number >= 0 is"
                )


STRAIGHT = Wandering(0, 0, 0, 0, 0, 0, 0)
"""A straight pair that keeps its parameters."""


def advected(
    state: np.ndarray, dx: float, dt: float, profile: Profile
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state dx further along the path and dt later, with derivatives.

    First along the slopes at the same time, then with the drift of the pair in that plane: exact
    for straight vortices that are parallel, as the drift depends on their distance alone.

    state (14,)
    dx, dt: m and s; of either sign.

    Returns
    -------
    state : ndarray, shape (14,)
    along, later : ndarray, shape (14, 14)
        Derivatives of the move along the path, and of that in time; the whole is later @ along.
    """
    along = np.eye(len(state))
    along[PLACES, _OF_SLOPES] += dx * np.eye(len(SLOPES))
    reached = along @ state
    given = torch.as_tensor(reached).requires_grad_()
    speed = oblique_drift(given, profile)
    slope = [torch.autograd.grad(one, given, retain_graph=True)[0] for one in speed]
    later = np.eye(len(state)) + dt * _DRIFTING @ torch.stack(slope).numpy()
    return reached + dt * _DRIFTING @ speed.detach().numpy(), along, later


def advected_states(
    state: np.ndarray, dx: np.ndarray, dt: np.ndarray, profile: Profile
) -> np.ndarray:
    """States (14, ...) of `advected` alone, for distances and times (...)."""
    reached = state.copy()
    reached[PLACES] += dx * state[_OF_SLOPES]
    speed = oblique_drift(torch.as_tensor(reached), profile).numpy()
    return reached + dt * np.einsum("ij,j...->i...", _DRIFTING, speed)


def oblique_drift(state: torch.Tensor, profile: Profile) -> torch.Tensor:
    """Velocity (2, ...) of pairs of states (14, ...) in a plane across the path, m s^-1.

    Mean wind plus mutual induction of two lines along the mean direction a of both slopes. At the
    places d apart in the plane, and at b^2 = d^2 - (d.a)^2 across their axis, port and
    starboard induce the mean velocity u = (omega_s - omega_p)/2 (a x d), with the angular velocity
    omega of each at b. In the plane the lines move with (v, w) less their slopes times u along the
    path. For lines across the plane this is `lidar_mi.retrieval.vortices.model.drift`.
    """
    dy, dz = state[2] - state[6], state[3] - state[7]
    slopes = state[_OF_SLOPES]
    along_y, along_z = (slopes[0] + slopes[2]) / 2, (slopes[1] + slopes[3]) / 2
    stretch = 1 + along_y**2 + along_z**2
    square = dy**2 + dz**2 - (dy * along_y + dz * along_z) ** 2 / stretch
    omega = [
        circulation / (2 * torch.pi) * (-2 * log_radius).exp() * value
        for circulation, log_radius in (state[0:2], state[4:6])
        for value in angular_velocity(square * (-2 * log_radius).exp(), profile)[:1]
    ]
    rate = (omega[1] - omega[0]) / 2 / stretch.sqrt()
    forward = along_y * dz - along_z * dy
    return torch.stack(
        [state[8] - rate * (dz + along_y * forward), state[9] + rate * (dy - along_z * forward)]
    )


def wandered(
    state: np.ndarray, dx: float, dt: float, wandering: Wandering
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (14, 14) of the random walks along the path and in time.

    Slopes that walk move the places by the integral: blocks q^2 (L^3/3, L^2/2; L^2/2, L), as of
    white acceleration (Bar-Shalom, Li, Kirubarajan 2001, 6.2.2).
    """
    length = abs(dx)
    path = np.zeros(len(state))
    path[CIRCULATIONS] = (wandering.circulation * state[CIRCULATIONS]) ** 2
    path[CORES] = wandering.log_radius**2
    path[PLACES] = wandering.place**2 + wandering.slope**2 * length**2 / 3
    path[MEAN_WIND] = _TRANSVERSE * (wandering.dissipation * _MATCHED) ** (2 / 3) / _MATCHED
    path[_OF_SLOPES] = wandering.slope**2
    # a walk to the back along the path has the same variance as one ahead
    along = np.diag(path * length)
    both = np.eye(len(SLOPES)) * wandering.slope**2 * length * dx / 2
    along[PLACES, _OF_SLOPES] += both
    along[_OF_SLOPES, PLACES] += both
    later = np.zeros(len(state))
    later[MEAN_WIND] = _LAGRANGIAN * wandering.dissipation * abs(dt)
    return along, np.diag(later)


def unsteady(
    state: np.ndarray, dt: float, wandering: Wandering, by_curvature: np.ndarray | float = 0.0
) -> np.ndarray:
    """Covariance (14, 14) of what unknown steady rates change in a time.

    ``by_curvature`` (2,) is a velocity along y and z, m/s: the common departure of both vortices
    from the drift where they are curved, as that is neither of the slab nor of the whole pair.
    """
    # both vortices decay together, each moves on its own, the curved pair as a whole
    decayed = np.zeros(len(state))
    decayed[CIRCULATIONS] = wandering.decay * dt * state[CIRCULATIONS]
    departed = np.zeros(len(state))
    departed[PLACES] = (wandering.departure * dt) ** 2
    together = dt * _DRIFTING * by_curvature
    return np.outer(decayed, decayed) + np.diag(departed) + together @ together.T
