"""The scores of finished runs, in one CSV file."""

import pathlib
from collections.abc import Sequence

import numpy as np

from experiments.plan import EARLIER_SEEDS, FIRST_SEED, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.results import Result, read_scored, run_key
from mapg_jax.reports.results_csv import append_csv, read_csv
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config


def path(plan: Plan) -> pathlib.Path:
    return plan.results / "scores.csv"


def read(plan: Plan) -> list[Result]:
    """The rows of the plan's version of the protocol: those of the other are set apart.

    Raises:
      ValueError: if a row is of neither version, or does not name the machine of a run.
    """
    kept = []
    for result in read_csv(path(plan)):
        run = f"{result.env}, {result.algorithm}, M = {result.heads}, seed {result.seed}"
        version = 1 if result.seed < EARLIER_SEEDS else 2
        if EARLIER_SEEDS <= result.seed < FIRST_SEED:
            raise ValueError(
                f"{path(plan)}: {run} is of neither version of the protocol, whose seeds are below "
                f"{EARLIER_SEEDS}, or {FIRST_SEED} and above; leave it out"
            )
        if version == 2 and not (result.processor and result.engine):
            raise ValueError(
                f"{path(plan)}: {run} does not name its processor and engine, as version 2 of the "
                "protocol asks of a run; leave it out"
            )
        if version == plan.version:
            kept.append(result)
    return kept


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the score of a run, unless it is there.

    Raises:
      ValueError: if the run was scored otherwise than by the protocol, or does not compare with
        those that are there.
    """
    result, score = read_scored(folder)
    recorded = read(plan)
    if result.run in {other.run for other in recorded}:
        return  # whatever the run was scored by since
    config = folder.config
    otherwise = {
        "select": result.select != "uniform",
        "physics": result.physics == "gymnasium" or config.engine not in ("auto", result.physics),
        "seed": score.get("seed") != 0,
        "episodes": result.episodes != config.final_episodes,
    }
    other = [f"{name} {score.get(name)}" for name, differs in otherwise.items() if differs]
    if other:
        raise ValueError(
            f"{folder.path} was scored with {', '.join(other)}; "
            f"score it by: mapg evaluate {folder.path} --episodes {config.final_episodes}"
        )
    if reason := difference(recorded, result.versions, result.env, result.physics):
        raise ValueError(f"{folder.path} {reason}")
    append_csv(path(plan), [result])


def difference(recorded: Sequence[Result], versions: str, env: str, physics: str) -> str:
    """Why a run of those versions and physics does not compare with those there are; or ''."""
    for result in recorded:
        if result.versions != versions:
            return f"is of {versions}, which does not compare with {result.versions}"
        if (result.env, result.physics) != (env, physics) and result.env == env:
            return f"ran on {physics}, which does not compare with {result.physics}"
    return ""


def of(plan: Plan, runs: Sequence[Config]) -> list[Result]:
    """The results of those runs that have finished, by seed."""
    wanted = {run_key(config) for config in runs}
    found = [result for result in read(plan) if result.run in wanted]
    if len({result.run for result in found}) < len(found):
        raise ValueError(f"{path(plan)} holds two scores of one run; leave one out")
    return sorted(found, key=lambda result: result.seed)


def means(plan: Plan, runs: Sequence[Config]) -> np.ndarray:
    """Their scores, by seed."""
    return np.array([result.return_mean for result in of(plan, runs)])


def summary(values: Sequence[float] | np.ndarray) -> str:
    """Mean, and its bootstrap interval where there are seeds enough."""
    if not len(values):
        return "missing"
    return f"{statistics.mean(values):.0f}, n = {len(values)}"
