"""One arm against another over several tasks: exact permutation tests, their power, the effect."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from mapg_jax.reports.inference import LEVEL, Estimate, Scores, bootstrap, improvement

Tasks = Sequence[tuple[Scores, Scores]]
"""Scores of the new and of the old arm, a pair a task."""
SIMULATIONS = 1_000
WHOLE = 1e-9  # sums of ranks are multiples of ½, over small denominators: equal ones differ by less


class Test(NamedTuple):
    """A statistic among all permutations of the runs within each task."""

    statistic: float
    above: float  # p of a statistic as large, or larger
    below: float  # as small, or smaller
    either: float  # as far from 0, or farther


def van_elteren(tasks: Tasks) -> Test:
    r"""The stratified rank-sum test, exact.

    $T = \sum_t \frac{W_t - E W_t}{n_t + m_t + 1}$ (van Elteren 1960), $W_t$ the sum of the ranks of
    the n new scores of a task among its n + m; on one task it is the rank-sum test.

    Raises:
      ValueError: if there are no tasks, or one lacks an arm or has a score that is not finite.
    """
    if not tasks or not all(len(new) and len(old) for new, old in tasks):
        raise ValueError("every task needs scores of both arms")
    values, chances, statistic = np.zeros(1), np.ones(1), 0.0
    for new, old in tasks:
        pooled = np.concatenate([np.asarray(new, float), np.asarray(old, float)])
        if not np.isfinite(pooled).all():
            raise ValueError("a score is not finite")
        ranks = stats.rankdata(pooled)
        null = _null(tuple(np.sort(np.rint(2 * ranks).astype(int)).tolist()), len(new))
        values, chances = _sum(values, chances, *null)
        statistic += (ranks[: len(new)].sum() - len(new) * ranks.mean()) / (len(pooled) + 1)
    return Test(statistic, *_tails(values, chances, statistic))


def least_p(sizes: Sequence[tuple[int, int]]) -> float:
    """One-sided p of the most extreme outcome that such numbers of runs can have.

    Args:
      sizes: n and m of each task.
    """
    return math.prod(1 / math.comb(n + m, n) for n, m in sizes)


def effect(tasks: Tasks, level: float = LEVEL) -> Estimate:
    r"""The probability of improvement over the tasks, weighed as the test weighs them.

    $\sum_t w_t P_t / \sum_t w_t$, $w_t = \frac{n_t m_t}{n_t + m_t + 1}$; $T$ is 0 where it is ½.
    """
    weights = np.array([len(y) * len(x) / (len(y) + len(x) + 1) for y, x in tasks])
    weights /= weights.sum()

    def statistic(*samples, axis):
        pairs = zip(samples[::2], samples[1::2], strict=True)
        shares = [improvement(new, old) for new, old in pairs]
        return sum(w * p for w, p in zip(weights, shares, strict=True))

    return bootstrap([scores for task in tasks for scores in task], statistic, level)


class Power(NamedTuple):
    """How often a test finds the new arm above, if these scores are what runs give."""

    together: float  # over the tasks, two-sided
    each: float  # one-sided on every task


def power(tasks: Tasks, alpha: float = 0.05) -> Power:
    """By simulation: as many runs as there are, drawn from them with replacement.

    A score that is drawn twice stands for two that differ by a little: the test is the one without
    ties, which the scores of runs hardly ever have.

    Args:
      tasks: the new scores moved to the mean that is asked about.
      alpha: the level of the tests.
    """
    rng = np.random.default_rng(0)
    statistic, every = np.zeros(SIMULATIONS), np.ones(SIMULATIONS, bool)
    values, chances = np.zeros(1), np.ones(1)
    for new, old in tasks:
        n, m = len(new), len(old)
        drawn = [rng.choice(np.asarray(x, float), (SIMULATIONS, len(x))) for x in (new, old)]
        found = n * m / (n + m + 1) * (np.asarray(improvement(*drawn)) - 0.5)
        null = _null(tuple(range(2, 2 * (n + m) + 2, 2)), n)
        every &= np.array([_tails(*null, t)[0] < alpha for t in found])
        statistic += found
        values, chances = _sum(values, chances, *null)
    tails = [_tails(values, chances, t)[2] for t in statistic]
    together = (statistic > 0) & (np.array(tails) < alpha)
    return Power(float(together.mean()), float(every.mean()))


@functools.cache
def _null(doubled: tuple[int, ...], n: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of one task's term over all choices of n runs, and their chances.

    Args:
      doubled: twice the ranks, whole numbers where scores tie too.
      n: runs of the new arm.
    """
    counts = np.zeros((n + 1, sum(doubled) + 1))  # of choices, by how many runs and their sum
    counts[0, 0] = 1
    for rank in doubled:
        counts[1:, rank:] += counts[:-1, : counts.shape[1] - rank].copy()
    sums = np.flatnonzero(counts[n])
    mean = n * sum(doubled) / len(doubled)
    values = (sums - mean) / 2 / (len(doubled) + 1)
    return values, counts[n, sums] / counts[n].sum()


def _sum(values, chances, more, their_chances) -> tuple[np.ndarray, np.ndarray]:
    """The distribution of a sum of two independent numbers."""
    sums = np.round((values[:, None] + more[None, :]).ravel() / WHOLE) * WHOLE
    distinct, place = np.unique(sums, return_inverse=True)
    weights = (chances[:, None] * their_chances[None, :]).ravel()
    return distinct, np.bincount(place.ravel(), weights)


def _tails(values, chances, at: float) -> tuple[float, float, float]:
    """The chances of a number as large, as small, and as far from 0."""
    near = 1e-7
    masks = values >= at - near, values <= at + near, np.abs(values) >= abs(at) - near
    large, small, far = (min(1.0, float(chances[mask].sum())) for mask in masks)
    return large, small, far
