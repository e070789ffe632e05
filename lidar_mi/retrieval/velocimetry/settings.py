"""Settings of the methods, frozen: each field with its unit and its source or its effect."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FilterSettings:
    """Band limit and interpolation of images or volumes (`band_limit`, `warping`).

    Attributes
    ----------
    margin : int
        Pixels by which images are continued, fading, beyond each edge. The interpolating spline
        forgets an edge by a factor 0.27 a pixel.
    nodes : int
        Spline nodes in a pixel along each axis. On half-pixel nodes the shortest wave loses 2.8 %
        of its amplitude, on whole ones all of it half way between (peak locking).
    smoothing : int
        Shells of wavenumber that each value of the power spectrum averages over; odd.
    threshold : float
        Standard errors by which a shell must exceed the noise to count as texture.
    antisymmetric : bool
        Continuation beyond the edges by the mirror image about the edge's value, whose slope goes
        on, in place of the mirror image itself, whose kink rings into thin volumes.
    sharpening : float
        Largest amplification of a wave that a known blur attenuated.
    """

    margin: int = 24
    nodes: int = 2
    smoothing: int = 5
    threshold: float = 2.0
    antisymmetric: bool = False
    sharpening: float = 4.0


VOLUME_FILTER = FilterSettings(margin=12, smoothing=1, antisymmetric=True)
"""Of volumes: a shell holds enough waves by itself, and memory goes with the margin cubed."""


@dataclass(frozen=True)
class MultipassSettings:
    """Multi-pass correlation (`multipass.multipass`).

    Attributes
    ----------
    widths : tuple of float
        Standard deviations of the Gaussian windows, pass by pass, over the last one.
    sigma : float
        That of the last pass over the template.
    spacing : float
        Windows of all passes but the last are so many standard deviations apart.
    gradient : float
        Standard deviation a priori of the displacement gradient, px per px: 1 would make air
        change places within a window.
    jump : float
        Vectors further from the pass before are flagged; px, or sigma if that is more.
    median_threshold, median_epsilon : float
        Median test between passes, no unit and px (2 and 0.1: Westerweel & Scarano 2005).
    continued : bool
        Whether the median test continues the field beyond the rim, see `outliers`.
    rebalanced : bool
        Whether brightness is found anew in every pass, from what is valid in both images. What
        enters and leaves a volume changes the mean of its gates by a tenth of the texture.
    filter : FilterSettings
    """

    widths: tuple[float, ...] = (1.8, 1.4, 1.0)
    sigma: float = 1 / 3
    spacing: float = 0.5
    gradient: float = 1.0
    jump: float = 2.0
    median_threshold: float = 2.0
    median_epsilon: float = 0.1
    continued: bool = False
    rebalanced: bool = False
    filter: FilterSettings = FilterSettings()


VOLUME_MULTIPASS = MultipassSettings(
    spacing=1.0, continued=True, rebalanced=True, filter=VOLUME_FILTER
)
"""Of volumes: an eighth of the windows between passes."""


@dataclass(frozen=True)
class IterativeSettings:
    """Conjugate gradients and flows drawn from the posterior (`iterative`).

    Attributes
    ----------
    tolerance, loose : float
        Residual over the first one at which a solution ends: of a flow, of a drawn one.
    steps : int
        Largest number of steps.
    draws, final_draws : int
        Flows drawn in each round, and for the standard errors.
    damping : float
        Fraction of the prior's expected energy added to both sides of the fixed point, for what is
        drawn has noise: 0 is MacKay's step.
    seed : int
        Of the draws.
    """

    tolerance: float = 1e-2
    loose: float = 1e-1
    steps: int = 60
    draws: int = 4
    final_draws: int = 16
    damping: float = 0.05
    seed: int = 0


@dataclass(frozen=True)
class VariationalSettings:
    """Variational retrieval (`variational.variational`).

    Attributes
    ----------
    knots : tuple of float
        Spacing of the knots over the template, level by level.
    rounds : tuple of int
        Rounds of flow and evidence on each level.
    weighed : int
        Round of the last level before which noise is estimated from the misfit.
    robust : float
        Residuals beyond so many standard deviations enter linearly (Huber 1964, Ann. Math. Stat.
        35, 73-101).
    path_order : int
        Terms of the path's series in time.
    coloured : bool
        Whether the misfit is weighed by wavenumber as well as by place. In a thin volume few
        shells hold the texture, and none tells its misfit from what the faces do.
    misfit_width : float
        Standard deviation over the template of the Gaussian that averages the misfit.
    noise_width : float
        The same of a known noise map, px.
    ridge : float
        Precision of each coefficient beside the prior's, px^-2: nothing for displacements of
        some px.
    ratio : float
        Strength of the divergence over the vorticity's at the start: a tenth of its standard
        deviation.
    least_vorticity : float
        Standard deviation of the vorticity (px per px) at the start, at the least: a coarse flow
        may look rigid.
    largest_ratio : float
        Most of it, images only: 0.3 % of the standard deviation. Images of weak texture that show
        no divergence do not prove that there is none.
    prior_width : float
        Standard deviation over the template within which the prior's strength varies little.
    largest_change, largest_change_divergence : float
        Factor by which a strength may change in a round.
    filter : FilterSettings
    solver : IterativeSettings
        Of volumes; images are solved directly.
    """

    knots: tuple[float, ...] = (1.25, 0.5)
    rounds: tuple[int, ...] = (6, 4)
    weighed: int = 2
    robust: float = 3.0
    path_order: int = 6
    coloured: bool = True
    misfit_width: float = 0.75
    noise_width: float = 3.0
    ridge: float = 1e-4
    ratio: float = 100.0
    least_vorticity: float = 1e-3
    largest_ratio: float = 1e5
    prior_width: float = 0.5
    largest_change: float = 4.0
    largest_change_divergence: float = 16.0
    filter: FilterSettings = FilterSettings()
    solver: IterativeSettings = IterativeSettings()


VOLUME_VARIATIONAL = VariationalSettings(
    knots=(0.625,),
    rounds=(5,),
    weighed=3,
    coloured=False,
    least_vorticity=0.03,
    filter=VOLUME_FILTER,
)
"""Of volumes: the flow of the multi-pass correlation makes a coarse level unnecessary."""
