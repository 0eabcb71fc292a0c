"""Learning curves of finished runs, in one CSV file."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments import rows
from experiments.plan import Plan
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.training.config import Config

FILE = "curves.csv"
LATE = 10
"""Evaluations behind the second score."""
COLUMNS = ("env_steps", "return_mean", "training_return", "spread", "q_gap_relative", "critic_loss")


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the curve of a run."""
    key = rows.identity(folder.config)
    if not rows.holds(plan.measured / FILE, key):
        metrics = read_metrics(folder.metrics)
        new = [{**key, **{c: f"{row[c]:.6g}" for c in COLUMNS}} for row in metrics]
        rows.append(plan.measured / FILE, new)


def of(plan: Plan, runs: Sequence[Config]) -> list[dict[str, np.ndarray]]:
    """The curves of those runs that have finished: columns as arrays, and `seed`."""
    numbers = ("seed", *COLUMNS)
    by_run: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows.of(plan.measured / FILE, runs, numbers, each="env_steps"):
        by_run.setdefault(tuple(v for k, v in row.items() if k not in COLUMNS), []).append(row)
    return [
        {k: np.array([row[k] for row in of_run]) for k in numbers} for of_run in by_run.values()
    ]


def late(plan: Plan, runs: Sequence[Config]) -> np.ndarray:
    """The second score: the mean return of the last ten evaluations, by seed."""
    found = {int(curve["seed"][0]): curve["return_mean"][-LATE:].mean() for curve in of(plan, runs)}
    return np.array([found[seed] for seed in sorted(found)])
