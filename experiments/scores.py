"""The scores of finished runs, in one CSV file."""

import pathlib
from collections.abc import Sequence

import numpy as np

from experiments import rows
from experiments.plan import Plan
from mapg_jax import statistics
from mapg_jax.config import Config
from mapg_jax.results import Result, append_csv, read_csv, read_run
from mapg_jax.run_folder import RunFolder


def path(plan: Plan) -> pathlib.Path:
    return plan.results / "scores.csv"


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the score of a run.

    Raises:
      ValueError: if the run was scored otherwise than by the protocol.
    """
    result = read_run(folder)
    scored = (result.select, result.episodes)
    wanted = ("uniform", folder.config.final_episodes)
    if scored != wanted:
        raise ValueError(
            f"{folder.path} was scored by {scored[0]} over {scored[1]} episodes; "
            f"score it by: mapg evaluate {folder.path} --episodes {wanted[1]}"
        )
    append_csv(path(plan), [result])


def of(plan: Plan, runs: Sequence[Config]) -> list[Result]:
    """The results of those runs that have finished, by seed."""
    wanted = [rows.identity(config) for config in runs]
    found = [result for result in read_csv(path(plan)) if rows.identity_of(result) in wanted]
    if len({tuple(rows.identity_of(result).values()) for result in found}) < len(found):
        raise ValueError(f"{path(plan)} holds two scores of one run; leave one out")
    return sorted(found, key=lambda result: result.seed)


def means(plan: Plan, runs: Sequence[Config]) -> np.ndarray:
    """Their scores, by seed."""
    return np.array([result.return_mean for result in of(plan, runs)])


def summary(values: Sequence[float] | np.ndarray) -> str:
    """Mean, and Student's interval where there are seeds enough."""
    if not len(values):
        return "missing"
    estimate = statistics.student(values)
    if not np.isfinite(estimate.low):
        return f"{estimate.value:.0f} (n = {len(values)})"
    return f"{estimate.value:.0f} ({estimate.low:.0f} to {estimate.high:.0f}; n = {len(values)})"
