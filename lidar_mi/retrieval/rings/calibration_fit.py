"""An instrument as its laser frames show it: focal length, tilt, distortion, blur, finesse, light.

Frames of a narrow line of known width are fitted all together. The instrument is the same in all of
them; every frame has its own level of light, background and fractional order at the centre (laser
and etalon drift). Maximum likelihood times normal priors, by Gauss-Newton steps: after each step
pixels are put where the improved instrument has them.

Frames of one line do not determine the gap (only focal length^2 / gap enters: a gap that is wrong
by 1e-3 changes speeds by 1e-3; `calibration_lines` has it from several lines), and defects of the
plates together with the way in which the light fills the pupil, which differs between laser and
air.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import median_filter
from scipy.optimize import brentq

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import fisher_matrix
from lidar_mi.retrieval.rings.analysis import analyse_rings
from lidar_mi.retrieval.rings.calibration import Calibration
from lidar_mi.retrieval.rings.centre import gradient_centre
from lidar_mi.retrieval.rings.frames import checked, inside, spots
from lidar_mi.retrieval.rings.likelihood_fit import MISFIT, annular_waves, fit_rings
from lidar_mi.retrieval.rings.mean_image import mean_and_jacobian, mean_image
from lidar_mi.retrieval.rings.model import INSTRUMENT, LIGHT, PARAMETERS, PixelNoise, RingModel
from lidar_mi.retrieval.rings.scoring import OUTLIER, cell_variance
from lidar_mi.retrieval.rings.smooth import term_names

TOLERANCES: Mapping[str, float] = {
    "focal_length": 0.05,
    "tilt_x": 0.05,
    "tilt_y": 0.05,
    "distortion": 0.02,
    "blur": 400.0,
    "damping": 0.2,
    "roughness": 0.1,
}
"""Standard deviations of the priors on `INSTRUMENT`: a focal length to 5 %, a camera
mounted to 3 degrees, a lens distorting by 2 %, a focus to 20 px, mirrors to 0.2 of -ln R."""

_STEPS = 25
_CLOSE = 0.1  # standard deviations, largest last step
_UNDETERMINED = 0.9  # of the tolerance: what remains uncertain by that much was not determined
_BAD = 6.0  # standard deviations of a pixel's mean over the frames
_SHARED = ("x", "y", "falloff")  # and terms of the light, and the instrument
_LOCAL = ("v_los", "level", "background")
_MEDIAN = 0.455  # of chi-square with one degree of freedom
# Longest steps: from one to the next, rings move by less than their width.
_LONGEST = {
    "focal_length": 3e-3,
    "tilt_x": 0.03,
    "tilt_y": 0.03,
    "distortion": 5e-3,
    "blur": 10.0,
    "damping": 0.1,
    "roughness": 0.02,
}
_BLOCK = 16  # px, of the map of the misfit


def calibrate_rings(
    frames: torch.Tensor,
    model: RingModel,
    noise: PixelNoise | None = None,
    *,
    response: torch.Tensor | None = None,
    tolerances: Mapping[str, float] = TOLERANCES,
    light_degree: int = 2,
    background_degree: int = 0,
    max_chi_square: float = 2.0,
) -> Calibration:
    """Fit one instrument to frames of one narrow line.

    frames (frames, height, width): electrons; two frames or more, of one exposure each or means of
        several.
    model: of the nominal instrument and the line.
    noise: of a frame; Poisson alone if not given.
    response (height, width): of the pixels, from frames of even light; 0 leaves a pixel out.
    tolerances: standard deviations of `INSTRUMENT` about the nominal one, see `TOLERANCES`.
    light_degree, background_degree: of the illumination, the same in all frames, and of the
        background of each frame, 0 to 8.
    max_chi_square: frames that fit worse are refused.

    Raises InputError: frames of another size, fewer than two, saturated or without two rings;
    tolerances that are not above 0; frames that do not fit.
    """
    for name in INSTRUMENT:
        if not tolerances.get(name, 0) > 0:
            raise InputError(
                f"tolerances.{name}: {tolerances.get(name)!r} is not allowed; expected above 0"
            )
    used = None if response is None else response > 0
    frames = checked(frames, None, used, "frames", model.shape)
    if len(frames) < 2:
        raise InputError(
            f"frames: {len(frames)} is not allowed; expected 2 or more, from which the drift is "
            "determined"
        )
    noise = noise or PixelNoise()
    mean = frames.mean(0, dtype=torch.float64)
    # hot pixels that would mislead the start; the fit masks others
    hot = spots(mean, noise, len(frames))
    whole = torch.where(hot, torch.from_numpy(median_filter(mean.numpy(), 3)), mean)
    centre = gradient_centre(whole)
    inside(*centre, model.shape, "frames: centre")
    model = replace(
        model, light_degree=light_degree, background_degree=background_degree, centre=centre
    )
    model = _with_focal_length(model, whole, tolerances["focal_length"])
    given = torch.ones(model.shape, dtype=torch.float64) if response is None else response.double()
    given = torch.where(hot, 0.0, given)
    start = fit_rings(frames, model, noise, centre=centre, response=given, max_chi_square=math.inf)
    first = start.values.clone()
    first[:, PARAMETERS.index("x")] = first[:, PARAMETERS.index("y")] = 0.0
    for name in ("falloff", *LIGHT):
        place = PARAMETERS.index(name)
        first[:, place] = first[:, place].mean()
    nominal = _State(model, first, dict.fromkeys(INSTRUMENT, 0.0))
    state = _fitted(frames, nominal, noise, given, tolerances)
    bad = _bad_pixels(mean, state, noise, len(frames), given)
    if bad.any():
        given = torch.where(bad, 0.0, given)
        state = _fitted(frames, state, noise, given, tolerances)
    if not state.chi_square <= max_chi_square:
        raise InputError(
            f"frames: chi-square {state.chi_square:.3g} is not allowed; expected at most "
            f"{max_chi_square:g}: line, etalon or noise are not the model's"
        )
    return _calibration(frames, state, noise, given, tolerances)


@dataclass(frozen=True, eq=False)
class _State:
    """The instrument so far: its model, the frames' parameters, departures from the nominal one.

    ``model`` has focal length, tilt, distortion and blur in it; damping and roughness are in the
    frames' parameters.
    """

    model: RingModel
    parameters: torch.Tensor
    departure: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class _Fit(_State):
    """The instrument after a fit.

    ``covariance`` is that of the parameters ``names``, which all frames share; ``speed_by_shared``
    is the dependence of each frame's speed on them, ``speed_variance`` its variance without them.
    """

    names: tuple[str, ...]
    covariance: torch.Tensor
    speed_by_shared: torch.Tensor
    speed_variance: torch.Tensor
    chi_square: float
    freedom: int


def _with_focal_length(model: RingModel, mean: torch.Tensor, tolerance: float) -> RingModel:
    """The model with the focal length of the steps of r^2 between rings, if that is near."""
    try:
        spacing = analyse_rings(mean.numpy()).spacing
    except InputError:
        return model
    factor = math.sqrt(spacing / model.order_spacing)
    if abs(factor - 1) > 5 * tolerance:
        raise InputError(
            f"frames: rings {factor:.3g} times as wide as the nominal instrument's are not "
            f"allowed; expected them within {5 * tolerance:.0%}: check focal length, pixel and gap"
        )
    return replace(model, focal_length=model.focal_length * factor)


def _fitted(
    frames: torch.Tensor,
    state: _State,
    noise: PixelNoise,
    response: torch.Tensor,
    tolerances: Mapping[str, float],
) -> _Fit:
    """Gauss-Newton steps until the shared parameters no longer change."""
    shared = (*_SHARED, *term_names("light", state.model.light_degree), *INSTRUMENT)
    local = (*_LOCAL, *term_names("background", state.model.background_degree))
    few = len(local)
    for _ in range(_STEPS):
        # the cells move with the instrument: their positions depend on tilt and distortion
        waves = annular_waves(state.model, state.model.centre, response, derivatives=True)
        means = waves.cells.means(frames)
        mean, jacobian = mean_and_jacobian(state.model, waves, state.parameters, (*local, *shared))
        residual = means - mean
        weight = waves.cells.count / cell_variance(mean, state.parameters, noise)
        # hot pixels that are not known yet; the misfit of a poor start is none
        normal = residual * weight.sqrt()
        scale = max(1.0, math.sqrt(float(normal.square().median()) / _MEDIAN))
        weight = torch.where(normal.abs() <= OUTLIER * scale, weight, 0.0)
        fisher = fisher_matrix(jacobian, weight)
        score = (jacobian @ (weight * residual)[:, :, None])[:, :, 0]
        # the frames' local parameters are eliminated (Schur complement)
        local_fisher, mixed = fisher[:, :few, :few], fisher[:, :few, few:]
        by_shared = torch.linalg.solve(local_fisher, mixed)
        local_step = torch.linalg.solve(local_fisher, score[:, :few, None])[:, :, 0]
        total = (fisher[:, few:, few:] - mixed.transpose(1, 2) @ by_shared).sum(0)
        reduced = (score[:, few:] - torch.einsum("bls,bl->bs", mixed, local_step)).sum(0)
        for k, name in enumerate(shared):
            if name in INSTRUMENT:
                information = tolerances[name] ** -2
                total[k, k] += information
                reduced[k] -= state.departure[name] * information
        # the prior makes the matrix regular: frames of few rings do not determine all seven
        covariance = torch.linalg.inv(total)
        step = covariance @ reduced
        close = bool((step.abs() <= _CLOSE * covariance.diagonal().sqrt()).all())
        change = {
            name: max(-_LONGEST.get(name, math.inf), min(value, _LONGEST.get(name, math.inf)))
            for name, value in zip(shared, step.tolist(), strict=True)
        }
        # back substitution, with the speed within the linear range of the waves
        local_step = local_step - by_shared @ step
        limit = state.model.velocity_range / 16
        local_step[:, 0] = local_step[:, 0].clamp(-limit, limit)
        parameters = state.parameters.clone()
        for name, column in zip(local, local_step.unbind(1), strict=True):
            parameters[:, PARAMETERS.index(name)] += column
        for name in shared:
            if name in ("falloff", "damping", "roughness", *LIGHT):
                parameters[:, PARAMETERS.index(name)] += change[name]
        used = int((weight > 0).sum())
        freedom = max(used - len(shared) - few * len(frames), 1)
        state = fit = _Fit(
            _moved(state.model, change),
            parameters,
            {name: state.departure[name] + change[name] for name in INSTRUMENT},
            shared,
            covariance,
            by_shared[:, 0],
            torch.linalg.inv(local_fisher)[:, 0, 0],
            float((weight * residual**2).sum()) / freedom,
            freedom,
        )
        if close:
            return fit
        # the steps diverge where frames do not follow the model
        if not all(
            0 <= at < n for at, n in zip(fit.model.centre, frames.shape[:0:-1], strict=True)
        ):
            break
    raise InputError(
        "frames: the calibration does not converge; expected rings of one narrow line on the "
        "nominal instrument"
    )


def _moved(model: RingModel, change: Mapping[str, float]) -> RingModel:
    """The model after a step of the instrument's parameters."""
    return replace(
        model,
        centre=(model.centre[0] + change["x"], model.centre[1] + change["y"]),
        focal_length=model.focal_length * (1 + change["focal_length"]),
        tilt=(model.tilt[0] + change["tilt_x"], model.tilt[1] + change["tilt_y"]),
        distortion=model.distortion + change["distortion"],
        # a little below 0 by noise; a point cannot be sharper than a point
        blur=max(model.blur + change["blur"], -10.0),
    )


def _residual(
    mean: torch.Tensor, state: _State, noise: PixelNoise, count: int, response: torch.Tensor
) -> torch.Tensor:
    """Mean of the frames less the model, in standard deviations, (height, width).

    The model is taken with the mean of the frames' own parameters.
    """
    parameters = state.parameters.mean(0, keepdim=True)
    expected = mean_image(state.model, parameters)
    variance = cell_variance(expected.reshape(1, -1), parameters, noise).reshape(expected.shape)
    used = torch.where(response > 0, response, 1.0)
    return torch.where(response > 0, (mean / used - expected) * (used * count / variance).sqrt(), 0)


def _bad_pixels(
    mean: torch.Tensor, state: _State, noise: PixelNoise, count: int, response: torch.Tensor
) -> torch.Tensor:
    """Further pixels far from the model and from their neighbours: dust, warm pixels."""
    residual = _residual(mean, state, noise, count, response).numpy()
    # a smooth residual is an error of the model
    return torch.from_numpy(np.abs(residual - median_filter(residual, 5)) > _BAD)


def _calibration(
    frames: torch.Tensor,
    state: _Fit,
    noise: PixelNoise,
    response: torch.Tensor,
    tolerances: Mapping[str, float],
) -> Calibration:
    model, names = state.model, state.names
    count = len(frames)
    poor = state.chi_square > 1 + MISFIT * math.sqrt(2 / state.freedom)
    grown = state.chi_square if poor else 1.0
    covariance = (grown * state.covariance).numpy()
    std = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    speed = state.parameters[:, 0].numpy()
    own_variance = grown * state.speed_variance.numpy()
    # the frames' mean speed depends on the shared parameters: v = v_0 - g . shared
    slope = -state.speed_by_shared.mean(0).numpy()
    zero = float(slope @ covariance @ slope + own_variance.sum() / count**2)
    # scatter of the speeds beyond their errors
    drift = math.sqrt(max(0.0, speed.var(ddof=1) - own_variance.mean()))
    places = [names.index(name) for name in INSTRUMENT]
    systematic = np.empty((1 + len(INSTRUMENT),) * 2)
    # later frames are drifted as those were
    systematic[0, 0] = zero + drift**2
    systematic[0, 1:] = systematic[1:, 0] = (slope @ covariance)[places]
    systematic[1:, 1:] = covariance[np.ix_(places, places)]
    residual = _residual(frames.mean(0, dtype=torch.float64), state, noise, count, response)
    height, width = (size // _BLOCK * _BLOCK for size in residual.shape)
    blocks = residual[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    values = dict(zip(PARAMETERS, state.parameters[0].tolist(), strict=True))
    return Calibration(
        shape=model.shape,
        pixel=model.pixel,
        wavelength=model.wavelength,
        focal_length=model.focal_length,
        order_at_centre=model.order_at_centre + float(speed.mean()) / model.velocity_range,
        finesse=_finesse(model, state.parameters[:1]),
        centre=model.centre,
        tilt=model.tilt,
        distortion=model.distortion,
        blur=model.blur,
        damping=values["damping"],
        roughness=values["roughness"],
        falloff=values["falloff"],
        light={name: values[name] for name in names if name in LIGHT},
        std={name: float(value) for name, value in std.items()},
        systematic=systematic,
        frame_speed=speed - speed.mean(),
        frame_speed_std=np.sqrt(own_variance),
        drift=drift,
        chi_square=state.chi_square,
        response=response.numpy(),
        misfit=(blocks.sum((1, 3)) / _BLOCK).numpy(),
        block=_BLOCK,
        undetermined=tuple(n for n in INSTRUMENT if std[n] > _UNDETERMINED * tolerances[n]),
    )


def _finesse(model: RingModel, parameters: torch.Tensor) -> float:
    """Free spectral range over the full width of a ring at half its height above zero."""
    amplitudes = model.amplitudes(parameters)[0][0].numpy()
    n = np.arange(1, len(amplitudes) + 1)

    def above_half(order: float) -> float:
        at, top = (1 + 2 * (amplitudes * np.exp(2j * np.pi * n * m)).real.sum() for m in (order, 0))
        return at - top / 2

    return math.nan if above_half(0.5) >= 0 else 0.5 / brentq(above_half, 0, 0.5, xtol=1e-9)
