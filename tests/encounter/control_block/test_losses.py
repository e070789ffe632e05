"""Lost estimates as a Markov chain.

Detects biased probabilities, stated errors that are too small or too large, an error of 0 where
nothing was lost, and tests whose false alarms are not as stated or that see nothing.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

from lidar_mi.encounter.control_block.losses import gust_dependence, loss_chain
from tests.support.markov_chain import chain

BEGIN, END = 0.02, 0.4


def records(random, number=8, length=600):
    transition = np.array([[1 - BEGIN, BEGIN], [END, 1 - END]])
    return list((chain(random, transition, length, number) == 1).T)


@pytest.fixture(scope="module")
def chains():
    random = np.random.default_rng(1)
    return [loss_chain(records(random)) for _ in range(200)]


def test_errors_of_the_chain_are_as_stated(chains):
    """Of 200 chains: the variance of normalised errors has a standard error of 0.1."""
    true = {"begin": BEGIN, "end": END}
    errors = [
        [(getattr(one, name) - value) / getattr(one, f"{name}_stderr") for one in chains]
        for name, value in true.items()
    ]
    for name, value in (("probability", BEGIN / (BEGIN + END)), ("mean_run", 1 / END)):
        found, stderr = np.array([getattr(one, name) for one in chains]).T
        errors.append((found - value) / stderr)
    assert (abs(np.mean(errors, axis=1)) < 0.3).all()
    assert (np.var(errors, axis=1) > 0.7).all() and (np.var(errors, axis=1) < 1.4).all()


def test_nothing_lost_is_not_never_lost():
    """1 of 100 lost in truth would go unseen in 1 of 20 flights of 300 slabs."""
    chain = loss_chain([np.zeros(300, bool)])
    assert chain.probability[0] == 0 and 0.001 < chain.probability[1] < 0.01
    np.testing.assert_allclose(chain.transition, [[1, 0], [1, 0]])
    assert chain.mean_run[1] > 0.1 and chain.memory_p == 1


def test_memory_of_runs_is_seen_and_false_alarms_are_few(chains):
    """Nominally 5 % of 200; runs of exactly three are no chain."""
    alarms = np.mean([one.memory_p < 0.05 for one in chains])
    assert 0.005 < alarms < 0.11
    random, lost = np.random.default_rng(2), np.zeros(4800, bool)
    for begin in random.choice(1200, 40, replace=False):
        lost[4 * begin : 4 * begin + 3] = True
    assert loss_chain([lost]).memory_p < 1e-6


def test_losses_that_depend_on_the_gust_are_seen():
    """Of 200 records of coloured gusts nominally 5 % are false; losses of weak gusts are seen."""
    random, alarms = np.random.default_rng(3), []
    for _ in range(200):
        gusts = lfilter([1], [1, -0.9], random.standard_normal((8, 600)), axis=1)
        alarms.append(gust_dependence(records(random), list(gusts))[1] < 0.05)
    assert 0.005 < np.mean(alarms) < 0.11
    weak = abs(gusts) < 0.2
    ratio, p = gust_dependence(list(weak), list(gusts))
    assert ratio < 0.02 and p < 1e-3
    nothing, p = gust_dependence([np.zeros(600, bool)], [gusts[0]])
    assert np.isnan(nothing) and p == 1
