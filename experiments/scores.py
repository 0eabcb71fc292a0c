"""The scores of finished runs, in one CSV file."""

import pathlib
from collections.abc import Sequence

import numpy as np

from experiments import rows
from experiments.plan import FIRST_SEED, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.results import Result, read_scored, run_key
from mapg_jax.reports.results_csv import append_csv, read_csv
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config

RECORDED = ("processor", "instructions", "threads", "engine")
"""Of the process that trained: what a row must name. A copy without git has no commit to name."""


def path(plan: Plan) -> pathlib.Path:
    return plan.recorded / "scores.csv"


def read(plan: Plan) -> list[Result]:
    """The rows of the plan's version of the protocol, which has a file of its own.

    Raises:
      ValueError: if a row is not as that version of the protocol asks of a run, or a run has two.
    """
    found = read_csv(path(plan))
    seen = set()
    for result in found:
        run = f"{result.env}, {result.algorithm}, M = {result.heads}, seed {result.seed}"
        if reason := _flaw(result, plan.version):
            raise ValueError(f"{path(plan)}: {run} {reason}; leave it out")
        if result.run in seen:
            raise ValueError(f"{path(plan)} holds two scores of {run}; leave one out")
        seen.add(result.run)
    return found


def _flaw(result: Result, version: int) -> str:
    """What a row has otherwise than that version of the protocol asks; or ''."""
    if (result.seed < FIRST_SEED) != (version == 1):
        bounds = f"{FIRST_SEED} and above" if version == 2 else f"below {FIRST_SEED}"
        return f"is not of version {version} of the protocol, whose seeds are {bounds}"
    shares = {name: x for name, x in result.metrics.items() if name.endswith("_share")}
    if outside := [name for name, x in shares.items() if not 0 <= x <= 1]:
        return f"has a {outside[0]} of {shares[outside[0]]:g}, and a share is from 0 to 1"
    if result.return_std < 0:
        return f"has a return_std of {result.return_std:g}, and a deviation is at least 0"
    if version == 1:
        return ""  # which recorded nothing of the machine
    if without := [name for name in RECORDED if not getattr(result, name)]:
        return f"does not name its {without[0]}, as version 2 of the protocol asks of a run"
    if result.engine != result.physics:
        return f"was trained on {result.engine} and scored on {result.physics}"
    return ""


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
    return sorted(found, key=lambda result: result.seed)


def means(plan: Plan, runs: Sequence[Config]) -> np.ndarray:
    """Their scores, by seed."""
    return np.array([result.return_mean for result in of(plan, runs)])


def summary(values: Sequence[float] | np.ndarray) -> str:
    """Mean, and its bootstrap interval where there are seeds enough; of two seeds, both."""
    if not len(values):
        return "missing"
    if len(values) == 2:
        return f"{np.mean(values):.0f} ({min(values):.0f} and {max(values):.0f}), n = 2"
    return f"{statistics.mean(values):.0f}, n = {len(values)}"


def of_cell(plan: Plan, runs: Sequence[Config]) -> str:
    """The summary of a cell; runs that diverged have no score, and are counted."""
    diverged = len(rows.runs_in(plan.measured / rows.DIVERGED, runs))
    if diverged == len(runs):
        return f"all {diverged} diverged"
    text = summary(means(plan, runs))
    return f"{text}; {diverged} diverged" if diverged else text
