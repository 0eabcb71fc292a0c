"""What an environment adds to a score beside the return."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np


class ScoredMetric(NamedTuple):
    """One number of an environment's own: a metric at the episodes' last steps, summed up.

    ScoredMetric("distance_mean", "distance", "distance, m")
    ScoredMetric("lap_share", "laps", "episodes with a lap", lambda laps: np.mean(laps >= 1))
    """

    name: str
    """Of the number: a column of results."""
    metric: str
    """The entry of `State.metrics`."""
    title: str
    """In tables, with the unit."""
    summary: Callable[[np.ndarray], float | np.floating] = np.mean
    """From the values of all episodes, [episodes], to the number."""

    def over(self, values: Sequence[float] | np.ndarray) -> float:
        """The number, from the metric's value at the last step of each episode."""
        return float(self.summary(np.asarray(values)))


def reached(metric: str, plural: str, count: int) -> tuple[ScoredMetric, ...]:
    r"""Which of several good ends the episodes find: how many, how evenly, and how often each.

    $\lvert \{g_e\} \setminus \{0\} \rvert$; the entropy of behaviour $-\sum_i p_i \log_K p_i$, the
    $p_i$ being the shares of the ends among the episodes that find one (0 where none does, left
    out where K is 1); and, for each $i$, $\frac{1}{E} \sum_e [g_e = i]$.

    Args:
      metric: $g_e$, at an episode's last step the number of the end that it is at, from 1 on, or 0.
      plural: of its name.
      count: K, how many ends there are.
    """
    found = [ScoredMetric(f"{plural}_reached", metric, f"{plural} reached", _distinct)]
    if count > 1:
        entropy = functools.partial(_entropy, count)
        found.append(ScoredMetric(f"{metric}_entropy", metric, f"entropy over {plural}", entropy))
    shares = (
        ScoredMetric(
            f"{metric}_{i}_share", metric, f"share at {metric} {i}", functools.partial(_share, i)
        )
        for i in range(1, count + 1)
    )
    return *found, *shares


def _distinct(ends: np.ndarray) -> int:
    return len(set(ends.tolist()) - {0})


def _entropy(count: int, ends: np.ndarray) -> float:
    times = np.array([np.sum(ends == end) for end in range(1, count + 1)])
    p = times[times > 0] / max(times.sum(), 1)
    return -float((p * np.log(p)).sum() / np.log(count)) + 0.0  # no -0


def _share(end: int, ends: np.ndarray) -> np.floating:
    return np.mean(ends == end)
