"""Each algorithm by its published settings, beside the scores that are published for them."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import NamedTuple

from experiments import rows, scores
from experiments.plan import FIRST_SEED, Plan
from mapg_jax.algorithms import registry
from mapg_jax.reports.document import Table
from mapg_jax.training.config import Config, preset


class Cell(NamedTuple):
    """An algorithm on a task, and what its plain form should reach."""

    algorithm: str
    env: str
    steps: int
    seeds: int
    least: float
    """Of the mean score with M = 1; fixed before the first run."""
    published: str
    """After 1,000,000 steps, on the task's version 4 or 3, and who says so."""


CELLS = (
    Cell("naf", "pendulum", 30_000, 5, -200, ""),
    Cell("ppo", "hopper", 1_000_000, 2, 1_800, "2,383 ± 272, CleanRL"),
    Cell("trpo", "hopper", 1_000_000, 2, 1_500, "2,046 ± 1,038, Tianshou"),
    Cell("ppo", "walker2d", 1_000_000, 2, 1_500, "2,288 ± 572, CleanRL"),
    Cell("trpo", "walker2d", 1_000_000, 2, 1_500, "3,827 ± 783, Tianshou"),
    Cell("mapg", "halfcheetah", 300_000, 2, 4_000, "10,374 ± 157, CleanRL"),
    Cell("td3", "halfcheetah", 300_000, 2, 4_000, "9,583 ± 126, CleanRL"),
    Cell("sac", "halfcheetah", 300_000, 2, 4_000, "9,635 ± 1,424, CleanRL"),
    Cell("mapg", "hopper", 300_000, 2, 600, "1,577 ± 819, CleanRL"),
    Cell("td3", "hopper", 300_000, 2, 1_000, "3,135 ± 360, CleanRL"),
    Cell("sac", "hopper", 300_000, 2, 1_000, "2,310 ± 343, CleanRL"),
)
HEADS = (1, 10)
EVALUATIONS = 20


def runs(plan: Plan) -> list[Config]:
    """The plain algorithms first, seed by seed."""
    return [
        config
        for m in HEADS
        for k in range(max(cell.seeds for cell in CELLS))
        for cell in CELLS
        for config in of(plan, cell, m)[k : k + 1]
    ]


def of(plan: Plan, cell: Cell, m: int) -> list[Config]:
    """The runs of a cell with M = m, in whole rollouts; a smaller plan has fewer steps."""
    usual = preset("reference", cell.algorithm)
    turn = usual.environments * getattr(usual, "rollout_steps", 1)
    steps = math.ceil(min(cell.steps, plan.base.steps) / turn) * turn
    count = cell.seeds if plan.seeds is None else min(plan.seeds, cell.seeds)
    return [
        preset(
            "reference",
            cell.algorithm,
            env=cell.env,
            heads=m,
            seed=FIRST_SEED + k,
            steps=steps,
            evaluate_every=max(1, steps // EVALUATIONS),
            checkpoints_kept=plan.base.checkpoints_kept,
        )
        for k in range(count)
    ]


def section(plan: Plan) -> str:
    """The table, and how to read it."""
    if not scores.of(plan, runs(plan)):
        return rows.missing(runs(plan))
    return (
        "Preset `reference`: the settings that are published for each algorithm, a head drawn "
        "uniformly in evaluation. Scores are means over seeds of 100 episodes of the last policy, "
        "with 95 % intervals where there are seeds for them. What M = 1 should reach at least was "
        "fixed before the first run. The published scores are of 1,000,000 steps and of earlier "
        "versions of the tasks; Tianshou's are the best over time. On Hopper a policy that stands "
        "earns about 1,000: a score near that has met its threshold and learnt little.\n\n"
        + table(plan).markdown()
    )


def table(plan: Plan) -> Table:
    """A line a cell."""
    lines = []
    for cell in CELLS:
        plain, many = (of(plan, cell, m) for m in HEADS)
        lines.append(
            (
                registry.find(cell.algorithm).label(1),
                cell.env,
                f"{plain[0].steps:,}",
                scores.of_cell(plan, plain),
                f"{cell.least:,g}",
                _reached(plan, plain, cell.least),
                scores.of_cell(plan, many),
                cell.published,
            )
        )
    header = ("", "task", "steps", "M = 1", "at least", "reached", "M = 10", "published")
    return Table(header, lines)


def _reached(plan: Plan, of_cell: Sequence[Config], least: float) -> str:
    """By the mean of the seeds; of those that are there, where some are missing."""
    found = scores.means(plan, of_cell)
    if not len(found):
        return ""
    text = "yes" if fmean(found) >= least else "**no**"
    return text if len(found) == len(of_cell) else f"{text}, {len(found)} of {len(of_cell)} seeds"
