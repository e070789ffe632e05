"""Gain before the read-out, against a register simulated stage by stage and textbook laws.

Detects: an excess noise factor off by 3 %, a law of the output that is not a register's, a well on
the wrong side of the gain, a chip whose responses change from image to image.
"""

import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy import stats

from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.instrument.multiplication import intensified, register_excess, register_output

QUIET = {"read_noise": 0.0, "dark_current": 0.0, "full_well": 1e12, "bits": None}


def generator(seed=1):
    return torch.Generator().manual_seed(seed)


def stage_by_stage(electrons, gain, stages, rng):
    """Every electron frees another one with the same probability in every stage."""
    electrons = electrons.copy()
    for _ in range(stages):
        electrons += rng.binomial(electrons, gain ** (1 / stages) - 1)
    return electrons


def assert_moments(values, mean, variance, sigmas=4):
    values = np.asarray(values, float).ravel()
    deviation = values - mean
    assert abs(deviation.mean()) < sigmas * math.sqrt(variance / values.size)
    spread = math.sqrt((np.mean(deviation**4) - variance**2) / values.size)
    assert abs(np.mean(deviation**2) - variance) < sigmas * spread
    assert spread < 0.03 * variance


@pytest.mark.parametrize(
    ("electrons", "gain", "stages"),
    [
        (1, 20.0, 100),
        (4, 20.0, 100),
        (4, 1.5, 60),
        pytest.param(3, 300.0, 536, marks=pytest.mark.slow),
        pytest.param(30, 1000.0, 604, marks=pytest.mark.slow),
    ],
)
def test_register_stage_by_stage(electrons, gain, stages):
    """Mean, variance and law of the output of a few electrons: 40 000 simulated ones."""
    rng = np.random.default_rng(3)
    true = stage_by_stage(np.full(40_000, electrons), gain, stages, rng)
    variance = electrons * gain**2 * (register_excess(gain, stages) - 1)
    assert_moments(true, electrons * gain, variance)
    model = register_output(torch.full((40_000,), electrons), gain, stages, generator()).numpy()
    assert_moments(model, electrons * gain, variance)
    assert model.min() >= electrons and np.array_equal(model, model.round())
    # broken ties: a step of the law is no difference of both
    jitter = rng.random((2, 40_000))
    assert stats.ks_2samp(true + jitter[0], model + jitter[1]).pvalue > 1e-3


def test_one_electron_of_many_stages_is_geometric(chi_square_p):
    found = register_output(torch.ones(200_000), 5.0, 10_000_000, generator(2)).numpy()
    assert chi_square_p(found, stats.geom(1 / 5)) > 1e-3


def test_excess_of_a_register():
    """Robbins and Hadwen 2003, eq. 1, and its limits."""
    for gain, stages in ((1.0, 536), (2.0, 100), (300.0, 536), (1000.0, 604)):
        published = 2 * (gain - 1) * gain ** (-(stages + 1) / stages) + 1 / gain
        assert register_excess(gain, stages) == pytest.approx(published, rel=1e-12)
    assert register_excess(1.0, 536) == 1
    assert register_excess(1e5, 10_000) == pytest.approx(2, abs=3e-3)


def test_nothing_in_nothing_out():
    for output in (
        register_output(torch.zeros(1000), 300.0, 536, generator()),
        intensified(torch.zeros(1000), 300.0, 2.6, generator()),
    ):
        assert (output == 0).all()
    n = torch.arange(100.0)
    assert torch.equal(register_output(n, 1.0, 536, generator()), n.double())
    assert torch.equal(intensified(n, 7.0, 1.0, generator()), 7 * n.double())


def test_intensified_pulses_are_gamma_distributed():
    found = intensified(torch.full((40_000,), 3), 200.0, 2.6, generator(4)).numpy()
    assert_moments(found, 600, 3 * 200**2 * 1.6)
    assert stats.kstest(found, stats.gamma(3 / 1.6, scale=200 * 1.6).cdf).pvalue > 1e-3
    # an unsaturated channel plate: exponential
    one = intensified(torch.ones(40_000), 200.0, 2.0, generator(5)).numpy()
    assert stats.kstest(one, stats.expon(scale=200).cdf).pvalue > 1e-3


# the camera


def flat(mean, shape=(300, 400)):
    return torch.full(shape, float(mean), dtype=torch.float64)


EMCCD = {"multiplication": "emccd", "multiplication_gain": 300.0}
ICCD = {"multiplication": "iccd", "multiplication_gain": 50.0, "intensifier_excess": 2.6}


@pytest.mark.parametrize(
    ("changes", "modes", "mean", "variance"),
    [
        (EMCCD, math.inf, 32, 32 * register_excess(300, 536)),
        ({**EMCCD, "read_noise": 600.0}, math.inf, 32, 32 * register_excess(300, 536) + 4),
        (EMCCD, 10.0, 32, 32 * register_excess(300, 536) + 32**2 / 10),
        ({**EMCCD, "bits": 16, "gain": 600.0}, 1e9, 32, 32 * register_excess(300, 536) + 4 / 12),
        ({**EMCCD, "stages": 16, "multiplication_gain": 4.0}, 1e9, 32, 32 * register_excess(4, 16)),
        (ICCD, math.inf, 32, 32 * 2.6),
        ({**ICCD, "read_noise": 100.0}, 10.0, 32, 32 * 2.6 + 32**2 / 10 + 4),
        # read once, whatever is added on the chip; every pixel of it has its dark current
        ({"binning": 3, "read_noise": 5.0, "dark_current": 200.0}, math.inf, 50, 50 + 25),
    ],
)
def test_moments(changes, modes, mean, variance):
    counts = expose(flat(32), CCD(**{**QUIET, **changes}), seed=3, modes=modes)
    assert_moments(counts, mean, variance)


def test_wells():
    """The chip's before a register, the register's behind it, the chip's behind an intensifier."""
    chip = CCD(**{**QUIET, **EMCCD, "full_well": 100.0})
    assert chip.saturation == 100
    assert_moments(expose(flat(1000), chip, 1), 100, 100 * (chip.excess - 1))
    register = CCD(**{**QUIET, **EMCCD, "register_well": 3000.0})
    assert register.saturation == pytest.approx(10)
    assert float(expose(flat(1000), register, 1).unique()) == pytest.approx(10)
    behind = CCD(**{**QUIET, **ICCD, "full_well": 5000.0})
    assert behind.saturation == pytest.approx(100)
    assert float(expose(flat(1000), behind, 1).unique()) == pytest.approx(100)
    binned = CCD(**{**QUIET, "full_well": 50.0, "binning": 4})
    assert float(expose(flat(5000), binned, 1).unique()) == binned.saturation == 800
    summing = CCD(**{**QUIET, "full_well": 50.0, "binning": 4, "register_well": 600.0})
    assert float(expose(flat(5000), summing, 1).unique()) == summing.saturation == 600
    digits = CCD(**{**QUIET, **EMCCD, "bits": 8, "bias": 5, "gain": 12.0})
    assert digits.saturation == pytest.approx(250 * 12 / 300)
    assert float(expose(flat(1000), digits, 1).unique()) == pytest.approx(10)


def test_responses_belong_to_the_chip():
    ccd = CCD(**QUIET, response_rms=0.05)
    first, second = (expose(flat(1e8), ccd, seed)[0].double() / 1e8 for seed in (1, 2))
    # of 120 000 pixels; Poisson's own spread is 1e-4
    assert_moments(first, 1, 0.05**2 + 1e-8)
    assert float((first - second).std()) < 2e-4
    other = expose(flat(1e8), CCD(**QUIET, response_rms=0.05, response_seed=1), 1)[0] / 1e8
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 4 / math.sqrt(120_000)
    binned = expose(flat(1e8), CCD(**QUIET, response_rms=0.05, binning=2), 1)[0] / 1e8
    assert_moments(binned, 1, 0.025**2 + 1e-8)
    # light of the background, too, but no dark current
    dark = {**QUIET, "dark_current": 1e10}
    assert float((expose(flat(0), CCD(**dark, response_rms=0.05), 1) / 1e8).std()) < 2e-4
    lit = expose(flat(0), ccd, 1, background=1e8)[0].double() / 1e8
    assert float((lit - first).std()) < 2e-4


def test_a_positive_nonlinearity_loses_electrons():
    def at(mean, **changes):
        return float(expose(flat(mean), CCD(**{**QUIET, "full_well": 2e8, **changes}), 1).mean())

    assert at(1e8, nonlinearity=0.02) == pytest.approx(1e8 * (1 - 0.02 / 2), rel=1e-5)
    assert at(2e8, nonlinearity=-0.01) == pytest.approx(2e8 * 1.01, rel=1e-4)
    bent = at(1e6, nonlinearity=0.02, register_well=6e8, **EMCCD)
    assert bent == pytest.approx(1e6 * (1 - 0.02 / 2), rel=1e-4)
    assert at(1e8, nonlinearity=0.02, binning=2) == pytest.approx(1e8 * (1 - 0.02 / 8), rel=1e-5)


def test_a_camera_without_gain_draws_as_before():
    """The new settings leave the random numbers of the others alone."""
    expected = flat(32, (40, 60))
    one = expose(expected, CCD(), 9, modes=10.0)
    for harmless in ({"stages": 100}, {"register_well": 1e9}, {"response_seed": 4}):
        assert torch.equal(one, expose(expected, CCD(**harmless), 9, modes=10.0))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"multiplication_gain": 300}, "multiplication_gain: 300 is not allowed with"),
        ({"multiplication": "apd"}, "multiplication"),
        ({**EMCCD, "multiplication_gain": 0.5}, "multiplication_gain"),
        ({"binning": 0}, "binning"),
        ({"stages": 1}, "stages"),
        ({"intensifier_excess": 0.9}, "intensifier_excess"),
        ({"response_rms": -0.1}, "response_rms"),
        ({"nonlinearity": 0.7}, "nonlinearity"),
        ({"register_well": 0}, "register_well"),
    ],
)
def test_bad_settings(changes, words):
    with pytest.raises(ValidationError, match=words):
        CCD(**changes)
