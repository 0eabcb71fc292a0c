"""How sure we are: intervals over seeds, and comparisons of one arm with another.

Scores are one number a run. An interval that cannot be had, because a cell has one seed, is nan.
Random draws are seeded and scores sorted first: the same scores give the same interval.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats

RESAMPLES = 10_000
LEVEL = 0.95
LEAST_SEEDS = 3  # below, nothing is decided
PERMUTATIONS = 200_000  # all of them up to ten seeds against ten, which have 184,756

Scores = Sequence[float] | Sequence[int] | np.ndarray
Side = Literal["above", "below", "undecided"]


class Estimate(NamedTuple):
    """A number and its interval, nan where there is none."""

    value: float
    low: float
    high: float

    def __format__(self, digits: str) -> str:
        """As f"{estimate:.3g}" gives it: 1.5 (1.2 to 1.9)."""
        if math.isnan(self.value):
            return "missing"
        value, low, high = (format(number, digits) for number in self)
        return f"{value} (no interval)" if math.isnan(self.low) else f"{value} ({low} to {high})"


class Comparison(NamedTuple):
    """One arm against another on one task."""

    improvement: Estimate
    p: float  # of the rank-sum test
    seeds: tuple[int, int]
    verdict: Side  # of the probability of improvement, against ½


def mean(scores: Scores, level: float = LEVEL) -> Estimate:
    """Mean over seeds, with its bootstrap interval."""
    return bootstrap([scores], np.mean, level)


def median(scores: Scores, level: float = LEVEL) -> Estimate:
    """Median over seeds, with its bootstrap interval."""
    return bootstrap([scores], np.median, level)


def interquartile_mean(scores: Scores, level: float = LEVEL) -> Estimate:
    """Mean without the lowest and the highest ⌊n / 4⌋ seeds, with its bootstrap interval.

    Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice". Below four seeds it is
    the mean.
    """
    return bootstrap([scores], lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), level)


def probability_of_improvement(new: Scores, old: Scores, level: float = LEVEL) -> Estimate:
    r"""Probability that a run of the new arm scores higher than one of the old arm.

    $P = \frac{1}{n m} \sum_i \sum_j [y_i > x_j] + \frac{1}{2} [y_i = x_j]$

    Args:
      new: $y$, scores of n seeds.
      old: $x$, scores of m seeds, on the same task.
      level: of the interval; the seeds of both arms are resampled.
    """
    return mean_probability_of_improvement([(new, old)], level)


def mean_probability_of_improvement(
    tasks: Sequence[tuple[Scores, Scores]], level: float = LEVEL
) -> Estimate:
    """The mean over tasks of the probability of improvement; seeds are resampled within each cell.

    Args:
      tasks: (new, old) scores of each.
      level: of the interval.
    """

    def statistic(*samples, axis):
        pairs = zip(samples[::2], samples[1::2], strict=True)
        return np.mean([improvement(new, old) for new, old in pairs], axis=0)

    return bootstrap([scores for task in tasks for scores in task], statistic, level)


def spearman(
    groups: Mapping[int, Scores], level: float = LEVEL, resamples: int = RESAMPLES
) -> Estimate:
    """Spearman's rank correlation of score with M, over all seeds.

    Args:
      groups: scores of each M; seeds are resampled within each.
      level: of the interval.
      resamples: that the interval is of.

    Returns:
      0 where all scores are equal: they have no order.
    """
    sizes = [len(scores) for scores in groups.values()]
    ranks = stats.rankdata(np.repeat(list(groups), sizes))

    def statistic(*samples, axis):
        scores = stats.rankdata(np.concatenate(samples, axis=-1), axis=-1)
        x, y = ranks - ranks.mean(), scores - scores.mean(axis=-1, keepdims=True)
        scale = np.sqrt((x**2).sum() * (y**2).sum(axis=-1))
        return np.divide(y @ x, scale, out=np.zeros_like(scale), where=scale > 0)

    return bootstrap(list(groups.values()), statistic, level, resamples)


def student(values: Scores, level: float = LEVEL) -> Estimate:
    """Mean of a number that each seed has, with Student's interval.

    nan where there are no seeds, or the number of one of them is not finite.
    """
    sample = np.sort(np.asarray(values, float))
    if not len(sample) or not np.isfinite(sample).all():
        return Estimate(math.nan, math.nan, math.nan)
    centre, n = float(sample.mean()), len(sample)
    if n < 2:
        return Estimate(centre, math.nan, math.nan)
    half = float(stats.t.ppf((1 + level) / 2, n - 1) * stats.sem(sample))
    return Estimate(centre, centre - half, centre + half)


def share(some: int, all_: int, level: float = LEVEL) -> Estimate:
    """A share of runs, with Wilson's interval."""
    found = stats.binomtest(some, all_).proportion_ci(level, method="wilson")
    return Estimate(some / all_, float(found.low), float(found.high))


def holm(ps: Scores) -> list[float]:
    r"""p's of k tests, adjusted so that one of them is below a level with that chance at most.

    $\tilde p_{(i)} = \max_{j \le i} \min(1, (k - j + 1) p_{(j)})$ (Holm 1979).
    """
    order, k, highest = np.argsort(ps, kind="stable"), len(ps), 0.0
    adjusted = [0.0] * k
    for j, i in enumerate(order):
        highest = max(highest, min(1.0, (k - j) * ps[i]))
        adjusted[i] = highest
    return adjusted


def rank_sum_p(new: Scores, old: Scores) -> float:
    """Exact two-sided p of the rank-sum test (Mann-Whitney).

    Where scores tie it counts permutations: all of them or, if they are more than 200,000, so many
    drawn ones.
    """
    y, x = _samples([new, old])
    method: Any = "exact"
    if len(np.unique([*y, *x])) < len(y) + len(x):
        if min(len(y), len(x)) == 1:  # which scipy does not permute
            ranks = stats.rankdata([*min(y, x, key=len), *max(y, x, key=len)])
            tails = (ranks >= ranks[0]).mean(), (ranks <= ranks[0]).mean()
            return float(min(1, 2 * min(tails)))
        rng = np.random.default_rng(0)
        method = stats.PermutationMethod(n_resamples=PERMUTATIONS, batch=10_000, rng=rng)
    return float(stats.mannwhitneyu(y, x, method=method).pvalue)


def compare(new: Scores, old: Scores, level: float = LEVEL) -> Comparison:
    """Whether the new arm beats the old one on a task: above, below ½, or undecided."""
    improvement, p = probability_of_improvement(new, old, level), rank_sum_p(new, old)
    seeds = (len(new), len(old))
    return Comparison(improvement, p, seeds, verdict(improvement, 0.5, min(seeds), p, level))


def verdict(
    estimate: Estimate, null: float, seeds: int, p: float = 0.0, level: float = LEVEL
) -> Side:
    """Above or below the null, if the interval excludes it, p is small and the seeds suffice.

    Args:
      estimate: with an interval of that level.
      null: the value that would mean nothing.
      seeds: of the cell that has the fewest.
      p: of a test that must agree, where there is one; it counts below 1 - level.
      level: of the interval.
    """
    if seeds < LEAST_SEEDS or p >= round(1 - level, 12):
        return "undecided"
    if estimate.low > null:
        return "above"
    return "below" if estimate.high < null else "undecided"


def bootstrap(
    samples: Sequence[Scores],
    statistic: Callable,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
) -> Estimate:
    """A statistic and its stratified percentile bootstrap interval.

    Args:
      samples: the seeds of each stratum; every resample draws as many from each as it has. Below
        three there is no interval: resamples of two give the lower and the higher one.
      statistic: function of as many arrays [..., n] and `axis`, -1.
      level: of the interval.
      resamples: how many there are.

    Raises:
      ValueError: if a stratum is empty or a score is not finite.
    """
    data = _samples(samples)
    value = float(statistic(*data, axis=-1))
    if min(map(len, data)) < LEAST_SEEDS:
        return Estimate(value, math.nan, math.nan)
    interval = stats.bootstrap(
        data,
        statistic,
        n_resamples=resamples,
        vectorized=True,
        axis=-1,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def improvement(new: np.ndarray, old: np.ndarray) -> np.ndarray | np.floating:
    """The share of pairs in which the new score is higher, ties counting half.

    [..., n] and [..., m] → [...].
    """
    new, old = new[..., :, None], old[..., None, :]
    return ((new > old) + 0.5 * (new == old)).mean(axis=(-2, -1))


def _samples(samples: Sequence[Scores]) -> list[np.ndarray]:
    arrays = [np.sort(np.asarray(scores, float)) for scores in samples]
    if not arrays or not all(len(array) for array in arrays):
        raise ValueError("there are no scores")
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("a score is not finite")
    return arrays
