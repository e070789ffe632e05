"""Settings of the variational retrieval, frozen: each field with its unit and its source or effect.

How much the errors change where a field is halved or doubled is in ``docs/settings.md``.
"""

from dataclasses import dataclass, field

from lidar_mi.retrieval.images.noise_map import MAP_WIDTH
from lidar_mi.retrieval.images.settings import VOLUME_FILTER, FilterSettings


@dataclass(frozen=True)
class IterativeSettings:
    """Conjugate gradients and flows drawn from the posterior (`iterative`).

    Attributes
    ----------
    tolerance, loose : float
        Residual over the first one at which iteration ends: for the flow, for a drawn one.
    steps : int
        Largest number of steps.
    draws : int
        Flows drawn per round.
    final_draws, final_tolerance, final_steps : int, float, int
        The same for the standard errors. Where the prior is strong draws that end too early state
        too small errors: to a tolerance of 0.1 half of the variance, to 0.01 three quarters.
    damping : float
        Fraction of the prior's expected energy added to both sides of the fixed point against the
        sampling noise of the draws: 0 is MacKay's step.
    seed : int
        Of the draws.
    """

    tolerance: float = 1e-2
    loose: float = 1e-1
    steps: int = 120
    draws: int = 4
    final_draws: int = 8
    final_tolerance: float = 1e-3
    final_steps: int = 2000
    damping: float = 0.05
    seed: int = 0


@dataclass(frozen=True)
class StripSettings:
    """Strips of large images (`strips`); lengths in cells between knots.

    Attributes
    ----------
    largest : int
        Knots along z up to which images are solved at once, which is faster up to about 60.
    core, overlap : int
        Width of a strip and its overlap with each neighbour, for the prior's strength. The
        variance of vorticity and divergence that the images remove is 2 to 3 % too large with an
        overlap of 5, which changes flow and errors by up to 0.5 and 20 % of a standard error where
        noise hides the texture; with 10 by 0.05 and 2 %.
    final_core, final_overlap : int
        The same for the standard errors, of which 1 in 100 is off by more than 5 %; in still air
        they are too large by up to 24 %.
    solved_core, solved_overlap : int
        The same for the preconditioner. Where texture fades a flow is informed from far away: an
        overlap of 12 takes up to 60 steps, one of 4 more than 200, in images of 200 x 800 to
        120 x 2400 px.
    tolerance : float
        Residual over the first one at which conjugate gradients end: each round solves again.
    loose : float
        The same for random differences that are sent through the fit.
    steps : int
        Largest number of them.
    coarse_cells : int
        Largest number along each axis for the covariance before the images.
    """

    largest: int = 64
    core: int = 12
    overlap: int = 10
    final_core: int = 15
    final_overlap: int = 12
    solved_core: int = 30
    solved_overlap: int = 12
    tolerance: float = 1e-3
    loose: float = 2e-2
    steps: int = 200
    coarse_cells: int = 24


@dataclass(frozen=True)
class VariationalSettings:
    """Variational retrieval (`variational.variational`).

    Attributes
    ----------
    knots : tuple of float
        Spacing of the knots over the template on each level.
    rounds : tuple of int
        Rounds of flow and prior on each level. In volumes further ones make the prior too
        strong: it takes vorticity for white, and that of a wake has more of its variance in long
        waves.
    noise_rounds : tuple of tuples of int
        Rounds of each level before which the components of the differences are estimated.
    robust : float
        Standard deviations beyond which residuals enter linearly (Huber 1964, Ann. Math. Stat.
        35, 73-101).
    path_order : int
        Terms of the path's series in time.
    noise_width : float
        Standard deviation of the Gaussian that averages a known noise map, px.
    ridge : float
        Precision of each coefficient in addition to the prior's, px^-2: negligible for
        displacements of some px.
    ratio : float
        Strength of divergence over that of vorticity, of images before they inform. In a plane of
        isotropic turbulence the mean squares of vorticity and divergence have the ratio 5 (Taylor
        1935, Proc. R. Soc. Lond. A 151, 421-444: <w_x^2> = 5 <(du/dx)^2>).
    modes : float
        Motions from which that ratio counts as known.
    volume_ratio : float
        Initial ratio in volumes, where divergence is small.
    least_vorticity : float
        Lower limit of the initial standard deviation of the vorticity, px per px, of volumes at
        each place: a coarse flow may be rigid.
    prior_width : float
        Standard deviation over the template within which the prior's strength varies little.
    largest_change, relaxation : float
        Factor by which a strength may change per round, and the power of that of the fixed point.
    solver : IterativeSettings
        Of volumes.
    strips : StripSettings
        Of large images; smaller ones are solved directly.
    """

    knots: tuple[float, ...] = (1.25, 0.5)
    rounds: tuple[int, ...] = (6, 7)
    noise_rounds: tuple[tuple[int, ...], ...] = ((3,), (1, 4))
    robust: float = 3.0
    path_order: int = 6
    noise_width: float = MAP_WIDTH
    ridge: float = 1e-4
    ratio: float = 5.0
    modes: float = 10.0
    volume_ratio: float = 100.0
    least_vorticity: float = 1e-3
    prior_width: float = 0.65
    largest_change: float = 16.0
    relaxation: float = 1.5
    filter: FilterSettings = field(default_factory=FilterSettings)
    solver: IterativeSettings = field(default_factory=IterativeSettings)
    strips: StripSettings = field(default_factory=StripSettings)


VOLUME_VARIATIONAL = VariationalSettings(
    knots=(0.625,),
    rounds=(7,),
    noise_rounds=((3,),),
    least_vorticity=0.03,
    prior_width=0.5,
    largest_change=4.0,
    relaxation=1.0,
    filter=VOLUME_FILTER,
)
"""Of volumes: the flow of the multi-pass correlation makes a coarse level unnecessary."""
