"""Speeds from the channels of a receiver, of transmissions written down without the program.

Detects: a derivative off by 1e-6, a bound off by 1e-3 of a closed form, a standard deviation 12 %
off the bound, standard errors that are not the scatter (coverage off by 4 %), a bias of a tenth of
the standard error, a period lost, signals that no speed explains but that give a number.
"""

import math

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.channels.assumption import assumption_error
from lidar_mi.retrieval.channels.bound import cramer_rao
from lidar_mi.retrieval.channels.fit import fit_channels
from lidar_mi.retrieval.channels.model import (
    ChannelModel,
    mean_and_jacobian,
    parameter_vector,
    variance,
)
from lidar_mi.retrieval.rings.model import PixelNoise

WAVELENGTH, LIGHT = 354.7e-9, 299792458.0
TEMPERATURE, SIGMA, LASER = 233.0, 1.46e9, 42e6
TEMPERATURES = TEMPERATURE * np.array([0.75, 0.875, 1.0, 1.125, 1.25])
NUISANCE = ("v_los", "level", "aerosol")


def sigma(temperature):
    return SIGMA * math.sqrt(temperature / TEMPERATURE)


def averaged(harmonics, delay, width):
    """Over a Gaussian line."""
    n = np.arange(harmonics.shape[1])
    return harmonics * np.exp(-2 * (math.pi * n * delay * width) ** 2)


def model(harmonics, delay, temperatures=TEMPERATURES, **changes):
    return ChannelModel(
        molecules=np.array([averaged(harmonics, delay, sigma(t)) for t in temperatures]),
        aerosol=averaged(harmonics, delay, LASER),
        period=WAVELENGTH / (2 * delay),
        temperatures=temperatures,
        **changes,
    )


def fringe(elements=24, contrast=0.9, path=0.03, **changes):
    """One fringe over the elements of both outputs."""
    turns = np.exp(2j * math.pi * (np.arange(elements) + 0.5) / elements)
    cosine = contrast / 4 / elements * np.concatenate([turns, -turns])
    constant = np.full_like(cosine, 1 / 2 / elements)
    return model(np.stack([constant, cosine], 1), path / LIGHT, **changes)


def edges(spacing=5.1e9, spectral_range=12e9, reflectivity=0.64, **changes):
    """Two Fabry-Perot filters that share the light."""
    n = np.arange(25)
    airy = (1 - reflectivity) / (1 + reflectivity) / 2 * reflectivity**n
    turns = np.exp(1j * math.pi * n * spacing / spectral_range)
    changes = {"limits": (-450.0, 450.0), **changes}
    return model(np.stack([airy * turns, airy / turns]), 1 / spectral_range, **changes)


def drawn(receiver, noise, number, seed, level=2e4, **values):
    """Exposures with photon noise, speckle and read noise, by numpy."""
    rng = np.random.default_rng(seed)
    mean = mean_and_jacobian(receiver, parameter_vector(receiver, level=level, **values))[0]
    background = receiver.background.numpy()
    signal = np.broadcast_to(mean[0].numpy() - background, (number, mean.shape[1]))
    if math.isfinite(noise.speckle_modes):
        signal = signal * rng.gamma(noise.speckle_modes, 1 / noise.speckle_modes, signal.shape)
    counts = rng.poisson(signal + background)
    return torch.as_tensor(counts + noise.read_noise * rng.standard_normal(counts.shape))


def drawn_from_another_line():
    """Two fringes over the detector, where the model has one."""
    phase = 2 * np.pi * np.arange(24) / 24
    one = 1e4 * (1 + 0.4 * np.cos(phase) + 0.2 * np.cos(2 * phase))
    return np.concatenate([one, 2e4 - one])


@pytest.mark.parametrize("receiver", [fringe(), edges(background=3.0)])
def test_derivatives(receiver):
    vector = parameter_vector(receiver, 37.0, 5000.0, 240.0, 0.2)
    _, jacobian = mean_and_jacobian(receiver, vector)
    for i, step in enumerate((1e-3, 1.0, 1e-3, 1e-5)):
        change = torch.zeros(1, 4, dtype=torch.float64)
        change[0, i] = step
        up, down = (mean_and_jacobian(receiver, vector + s * change)[0] for s in (1, -1))
        slope = (up - down) / (2 * step)
        rounding = 4 * torch.finfo(up.dtype).eps * float(up.abs().max()) / step
        largest = 1e-9 * float(slope.abs().max())
        torch.testing.assert_close(jacobian[:, i], slope, rtol=1e-6, atol=largest + rounding)


def test_temperature_between_the_nodes():
    warm = parameter_vector(fringe(), 10.0, 1.0, 251.0)
    exact = fringe(temperatures=(251.0,))
    expected = mean_and_jacobian(exact, parameter_vector(exact, 10.0))[0]
    found = mean_and_jacobian(fringe(), warm)[0]
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("v_los", [0.0, 123.0])
def test_bound_of_a_fringe_is_the_closed_form(v_los):
    """Mean of V^2 sin^2 / (1 + V cos) over a fringe: 1 - (1 - V^2)^1/2."""
    delay = 0.03 / LIGHT
    visibility = 0.9 * math.exp(-2 * (math.pi * delay * SIGMA) ** 2)
    information = (2 * math.pi * delay) ** 2 * (1 - math.sqrt(1 - visibility**2))
    expected = WAVELENGTH / 2 / math.sqrt(1e6 * information)
    for free in (("v_los", "level"), NUISANCE, ("v_los", "level", "temperature")):
        found = cramer_rao(fringe(64), 1e6, v_los=v_los, free=free)["v_los"]
        assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("v_los", [-860.0, -300.0, 0.0, 51.0, 444.0])
def test_no_noise_no_error(v_los):
    for receiver in (fringe(), edges()):
        if receiver.span[0] < v_los < receiver.span[1]:
            truth = parameter_vector(receiver, v_los, 3e4, aerosol=0.1)
            fit = fit_channels(mean_and_jacobian(receiver, truth)[0], receiver, aerosol=0.1)
            assert float(fit.v_los) == pytest.approx(v_los, abs=1e-3)


CASES = {
    "fringe": (fringe(), PixelNoise(), ("v_los", "level"), {}),
    "fringe, contrast unknown": (fringe(), PixelNoise(), NUISANCE, {"aerosol": 0.1}),
    "fringe, read noise and speckle": (
        fringe(background=20.0),
        PixelNoise(5.0, 400.0),
        NUISANCE,
        {"aerosol": 0.3},
    ),
    "fringe, temperature unknown": (fringe(), PixelNoise(), ("v_los", "level", "temperature"), {}),
    "edges": (edges(), PixelNoise(), ("v_los", "level"), {}),
    "edges, read noise and speckle": (edges(), PixelNoise(20.0, 5e3), ("v_los", "level"), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_reaches_the_bound_with_standard_errors_that_hold(case):
    """2000 exposures: std known to 1.6 %, mean to 2.2 % of it, coverage to 1 %; 4 sigma."""
    receiver, noise, free, values = CASES[case]
    number, values = 2000, {"v_los": 60.0, **values}
    counts = drawn(receiver, noise, number, 3, **values)
    known = {} if "aerosol" in free else {"aerosol": values.get("aerosol", 0.0)}
    fit = fit_channels(counts, receiver, noise, free=free, max_chi_square=3, **known)
    bound = cramer_rao(receiver, 2e4, noise, free=free, **values)["v_los"]
    # 1 % for what read noise and the curvature of the response add
    assert abs(float(fit.v_los.std()) / bound - 1) < 4 / math.sqrt(2 * number) + 0.01
    assert abs(float(fit.v_los.mean()) - 60) < 4 * bound / math.sqrt(number) + 0.02 * bound
    z = (fit.v_los - 60).abs() / fit.v_los_std
    for width, expected in ((1.0, 0.683), (1.96, 0.95)):
        off = float((z < width).double().mean()) - expected
        assert abs(off) < 4 * math.sqrt(expected * (1 - expected) / number)
    if len(receiver.aerosol) > 2:
        freedom = len(receiver.aerosol) - len(free)
        assert float(fit.chi_square.mean()) == pytest.approx(
            1, abs=4 * math.sqrt(2 / freedom / number) + 0.01
        )


def test_prior_of_what_two_filters_do_not_determine():
    """Known to 4 K, the temperature adds its own error of the speed in quadrature."""
    receiver = edges()
    alone = cramer_rao(receiver, 1e6, v_los=90.0)["v_los"]
    wrong = assumption_error(receiver, 1e6, assumed="temperature", by=0.01, v_los=90.0) / 0.01
    free, prior = ("v_los", "level", "temperature"), {"temperature": 4.0}
    found = cramer_rao(receiver, 1e6, v_los=90.0, free=free, prior=prior)
    assert abs(wrong) > 0.05
    assert found["v_los"] == pytest.approx(math.hypot(alone, 4 * wrong), rel=1e-3)
    assert found["temperature"] == pytest.approx(4, rel=1e-9)
    counts = drawn(receiver, PixelNoise(), 5, 1, 1e6, v_los=90.0)
    fit = fit_channels(counts, receiver, free=free, prior=prior)
    assert float(fit.v_los_std.mean()) == pytest.approx(found["v_los"], rel=0.05)
    torch.testing.assert_close(fit.v_los, fit_channels(counts, receiver).v_los, rtol=0, atol=1e-2)


def test_fringe_does_not_depend_on_what_changes_its_contrast():
    for assumed, by in (("temperature", 10.0), ("aerosol", 0.1)):
        assert abs(assumption_error(fringe(64), 1e6, assumed=assumed, by=by, v_los=70.0)) < 1e-4


def test_pixels_of_a_channel():
    """A channel of 9 pixels has the noise of 9 read-outs, and the speckle of 9 times the modes."""
    receiver = fringe(pixels=9.0, background=4.0)
    mean = torch.full((1, 48), 904.0, dtype=torch.float64)
    found = variance(receiver, PixelNoise(5.0, 10.0), mean)
    assert float(found[0, 0]) == pytest.approx(904 + 900**2 / 90 + 9 * 25)


# --- bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "counts, options, words",
    [
        (np.ones(47), {}, r"counts: shape \(47,\)|counts: shape \(1, 47\)"),
        (np.full(48, np.nan), {}, r"counts\[0\]: NaN or infinity"),
        (np.zeros(48), {}, r"counts\[0\]: no signal"),
        (drawn_from_another_line(), {}, "chi-square"),
        (np.full(48, 1e3), {"free": ("level",)}, "expected v_los among them"),
        (np.full(48, 1e3), {"free": ("v_los", "width")}, "'width' is not one of"),
        (np.full(48, 1e3), {"prior": {"aerosol": 0.1}}, "prior: 0.1 of aerosol is not allowed"),
        (np.full(48, 1e3), {"temperature": 400.0}, "temperature: 400.0 K"),
        (np.full(48, 1e3), {"aerosol": 1.5}, "aerosol: 1.5"),
    ],
)
def test_refused(counts, options, words):
    with pytest.raises(InputError, match=words) as stop:
        fit_channels(torch.as_tensor(counts), fringe(), **options)
    assert "\n" not in str(stop.value)


def test_ratio_that_no_speed_has():
    with pytest.raises(
        InputError, match=r"counts\[0\]: the fit does not converge; .* -450 and 450"
    ):
        fit_channels(torch.tensor([1000.0, 90.0]), edges())


def test_two_channels_do_not_determine_three_unknowns():
    with pytest.raises(InputError, match="2 channels do not determine v_los, level, aerosol"):
        cramer_rao(edges(), 1e5, free=NUISANCE)
    with pytest.raises(InputError, match=r"do not determine .* all together"):
        cramer_rao(fringe(), 1e5, free=("v_los", "level", "temperature", "aerosol"))


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"period": -1.0}, "period: -1.0"),
        ({"limits": (5.0, 5.0)}, "limits"),
        ({"temperatures": (240.0, 230.0)}, "temperatures"),
        ({"aerosol": np.ones((1, 2))}, "harmonics: shapes"),
        ({"aerosol": np.full((3, 2), np.nan)}, "aerosol: expected finite"),
        ({"background": -1.0}, "background"),
        ({"pixels": 0.0}, "pixels"),
    ],
)
def test_bad_models(changes, words):
    usual = {"molecules": np.ones((3, 2)), "aerosol": np.ones((3, 2)), "period": 9.0}
    with pytest.raises(InputError, match=words):
        ChannelModel(**{**usual, **changes})
