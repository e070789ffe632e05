"""Lost estimates as a two-state Markov chain: received or lost (Gilbert 1960).

A received estimate is followed by a lost one with the probability a, a lost one by a received one
with the probability b: the fraction a / (a + b) is lost, in runs whose lengths are geometric with
the mean 1 / b. Two tests ask whether the chain may be used: whether a run has a memory of its
length (likelihood ratio of the second order, Anderson and Goodman 1957), and whether losses depend
on the gust (circular shifts of one record against the other, which keep the memory of both).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, chi2

RECEIVED, LOST = 0, 1


@dataclass(frozen=True)
class LossChain:
    """Probabilities of lost estimates, with standard errors.

    begin, end: a and b, by maximum likelihood. b is 1 where nothing was lost.
    begin_stderr, end_stderr: of the posterior with Jeffreys' prior, which is not 0 where nothing
        was lost.
    memory_p: P value of the chain against one of second order; 1: no run was long enough to tell.
    """

    begin: float
    end: float
    begin_stderr: float
    end_stderr: float
    memory_p: float

    @property
    def transition(self) -> np.ndarray:
        """From received and lost (rows) to received and lost (columns); (2, 2)."""
        return np.array([[1 - self.begin, self.begin], [self.end, 1 - self.end]])

    @property
    def probability(self) -> tuple[float, float]:
        """Of an estimate to be lost, with its standard error to first order."""
        total = self.begin + self.end
        slopes = np.array([self.end, -self.begin]) / total**2
        stderr = np.hypot(*(slopes * [self.begin_stderr, self.end_stderr]))
        return self.begin / total, float(stderr)

    @property
    def mean_run(self) -> tuple[float, float]:
        """Estimates lost in succession, with its standard error to first order."""
        return 1 / self.end, self.end_stderr / self.end**2


def loss_chain(records: Sequence[np.ndarray]) -> LossChain:
    """The chain of several records.

    ``records``, each (n,): true where an estimate is lost, slab by slab.
    """
    pairs = np.zeros((2, 2), int)
    triples = np.zeros((2, 2, 2), int)
    for record in records:
        lost = np.asarray(record, bool).astype(int)
        np.add.at(pairs, (lost[:-1], lost[1:]), 1)
        np.add.at(triples, (lost[:-2], lost[1:-1], lost[2:]), 1)
    begin, begin_stderr = _probability(pairs[RECEIVED, LOST], pairs[RECEIVED].sum())
    end, end_stderr = _probability(pairs[LOST, RECEIVED], pairs[LOST].sum())
    # of a chain that is never lost, or never received, the other probability is unknown
    end = end if pairs[LOST].sum() else 1.0
    return LossChain(begin, end, begin_stderr, end_stderr, _memory_p(triples))


def gust_dependence(lost: Sequence[np.ndarray], gusts: Sequence[np.ndarray]) -> tuple[float, float]:
    """Mean square of the gust in lost slabs over that in all, and its two-sided p value.

    The ratio is 1 where losses do not depend on the gust; (NaN, 1) where all or none are lost.
    Gusts are the true ones of the same slabs.
    """
    where = np.concatenate(lost).astype(float)
    if where.all() or not where.any():
        return np.nan, 1.0
    squares = np.concatenate(gusts)
    squares = (squares - squares.mean()) ** 2
    spectrum = np.fft.rfft(squares) * np.fft.rfft(where).conj()
    # over all shifts; the first is none
    ratios = np.fft.irfft(spectrum, len(where)) / where.sum() / squares.mean()
    above, below = (ratios >= ratios[0] - 1e-12).mean(), (ratios <= ratios[0] + 1e-12).mean()
    return float(ratios[0]), float(min(1.0, 2 * min(above, below)))


def _probability(events: int, trials: int) -> tuple[float, float]:
    """By maximum likelihood, and the standard error of the posterior with Jeffreys' prior."""
    return events / max(trials, 1), float(beta.std(events + 0.5, trials - events + 0.5))


def _memory_p(triples: np.ndarray) -> float:
    """Of the likelihood ratio of a chain of first order against one of second."""
    statistic, freedom = 0.0, 0
    for now in (RECEIVED, LOST):
        counts = triples[:, now]
        expected = np.outer(counts.sum(1), counts.sum(0)) / max(counts.sum(), 1)
        if expected.min() > 0:
            there = counts > 0
            statistic += 2 * np.sum(counts[there] * np.log(counts[there] / expected[there]))
            freedom += 1
    return float(chi2.sf(statistic, freedom)) if freedom else 1.0
