"""What can be said of a claim."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments import rows, scores
from experiments.plan import Plan
from mapg_jax.reports.inference import LEAST_SEEDS
from mapg_jax.training.config import Config

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"


class Verdict(NamedTuple):
    """One line of the ledger."""

    claim: str
    text: str
    verdict: str
    effect: str = ""
    """With its interval."""
    power: str = ""
    """Of an undecided one: how often its rule would say supported if the paper were right."""
    evidence: str = ""


def waiting(plan: Plan, runs: Sequence[Config], measured: str = "") -> str:
    """What is said while runs of a claim are missing; '' once all are there, or diverged.

    Args:
      plan: whose results are read.
      runs: that the claim is judged on.
      measured: the file that holds what it is judged by, where that is not the score.

    Raises:
      ValueError: if a run is said to have diverged, and has a score too.
    """
    wanted = rows.keys(runs)
    scored = {tuple(map(str, result.run)) for result in scores.of(plan, runs)}
    diverged = rows.runs_in(plan.measured / rows.DIVERGED, runs)
    if both := scored & diverged:
        raise ValueError(
            f"{plan.measured / rows.DIVERGED} holds {', '.join(min(both))}, which has a score too; "
            "leave one out"
        )
    if missing := wanted - scored - diverged:
        return f"not yet: {len(wanted) - len(missing)} of {len(wanted)} runs"
    if not measured:
        return ""
    known = rows.runs_in(plan.measured / measured, runs)
    return "" if known >= scored else f"not yet: measured on {len(known)} of {len(scored)} runs"


def undecidable(seeds: int) -> str:
    """What is said where no outcome of so many seeds could have decided."""
    return f"cannot be decided with {seeds} seeds"


def by_seeds(seeds: int, supported: bool, contradicted: bool) -> str:
    """The verdict of numbers that each seed has."""
    if seeds < LEAST_SEEDS:
        return undecidable(seeds)
    return SUPPORTED if supported else CONTRADICTED if contradicted else UNDECIDED


def count(*numbers: Sequence[float] | np.ndarray) -> str:
    """How many seeds, and how many of them lack one of their numbers."""
    without = sum(not all(map(math.isfinite, of_seed)) for of_seed in zip(*numbers, strict=True))
    text = f"n = {len(numbers[0])}"
    return f"{text}, {without} of them without such a number" if without else text
