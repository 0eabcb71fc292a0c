"""Box plots of the score over M, for Figures 1 and 5 (C2)."""

import json
import math
from collections.abc import Sequence

import numpy as np

from experiments import pictures, rows, scores
from experiments.plan import Plan
from mapg_jax.reports.plots import draw_boxes
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config

FILE = "episodes.csv"


def runs(plan: Plan, envs: Sequence[str]) -> list[Config]:
    """Every M on those tasks."""
    envs = [env for env in envs if env in plan.tasks]
    return [
        config for env in envs for m in (1, *plan.heads) for config in plan.over_seeds(env, heads=m)
    ]


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds the return of every episode of the score."""
    key = rows.identity(folder.config)
    if not rows.holds(plan.measured / FILE, key):
        returns = json.loads(folder.evaluation.read_text())["returns"]
        text = " ".join(f"{x:.6g}" for x in returns)
        rows.append(plan.measured / FILE, [{**key, "returns": text}])


def section(plan: Plan, envs: Sequence[str], picture: str) -> str:
    """The picture, and what it shows."""
    found = rows.of(plan.measured / FILE, runs(plan, envs))
    if not found:
        return rows.missing(runs(plan, envs))
    refuse_other_means(plan, envs, found)
    figure = draw_boxes(by_task(plan, found, envs), "return of an episode")
    return (
        f"![Score over M]({pictures.save(plan, figure, picture)})\n\n"
        "A box a value of M: quartiles and median of the returns of all episodes of all seeds, "
        "whiskers to 1.5 times the box, specks beyond, as the paper draws the episodes of one run; "
        "a dot is the mean of one seed, and their scatter is what tells M apart from chance. M = 1 "
        "is DDPG."
    )


def refuse_other_means(plan: Plan, envs: Sequence[str], found: Sequence[rows.Row]) -> None:
    """Raises ValueError where a score is not the mean of the returns of its episodes."""
    scored = {tuple(map(str, x.run)): x.return_mean for x in scores.of(plan, runs(plan, envs))}
    for row in found:
        mean = np.mean([float(x) for x in row["returns"].split()])
        score = scored.get(tuple(row[name] for name in rows.COLUMNS), mean)
        if not math.isclose(mean, score, rel_tol=1e-4, abs_tol=1e-3):  # returns have six digits
            raise ValueError(
                f"{plan.measured / FILE}: the episodes of {row['env']}, {row['algorithm']}, M = "
                f"{row['heads']}, seed {row['seed']} return {mean:.6g} on average, and its score "
                f"is {score:.6g}: one of them is damaged"
            )


def by_task(plan: Plan, found: Sequence[rows.Row], envs: Sequence[str]):
    """Task → M → the returns of every seed's episodes."""

    def returns(env, m):
        of_m = [row for row in found if (row["env"], row["heads"]) == (env, str(m))]
        return [np.array(row["returns"].split(), float) for row in of_m]

    measured = {row["env"] for row in found}
    return {
        env: {str(m): returns(env, m) for m in (1, *plan.heads)}
        for env in envs
        if env in plan.tasks and env in measured
    }
