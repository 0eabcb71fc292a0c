"""What an environment adds to a score beside the return."""

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
