"""Why the paper's heads come to propose one action: spread over training, by what could keep it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments import curves, pictures, rows
from experiments.plan import MAPG, Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_curves
from mapg_jax.training.config import Config

THE_PAPERS = "the paper's"
ARMS: Mapping[str, Mapping[str, Any]] = {
    THE_PAPERS: MAPG,
    "resampled": {**MAPG, "gradient": "resampled"},
    "all": {**MAPG, "gradient": "all"},
    "wide start": {**MAPG, "head_spread": 1.0},
    "wide start, all": {**MAPG, "head_spread": 1.0, "gradient": "all"},
    "M = 2": {"heads": 2},
    "M = 50": {"heads": 50},
    "M = 50, batches of 512": {"heads": 50, "batch_size": 512},
    "a tenth of the step": {**MAPG, "actor_learning_rate": 1e-5},
    "no noise": {**MAPG, "noise": "none"},
}
SEEDS = {"pendulum": 10, "halfcheetah": 5}
STEPS = {"pendulum": 25, "halfcheetah": 10}
"""A run has so many times fewer steps than those of the tables."""


def runs(plan: Plan) -> list[Config]:
    """Seed by seed of every arm on both tasks."""
    found = [c for env in SEEDS for changes in ARMS.values() for c in arm(plan, env, changes)]
    return sorted(found, key=lambda config: config.seed)


def arm(plan: Plan, env: str, changes: Mapping[str, Any]) -> list[Config]:
    """One arm on one task over all seeds."""
    steps = plan.base.steps // STEPS[env]
    every = max(1, steps // 40)
    return plan.over_seeds(env, SEEDS[env], steps=steps, evaluate_every=every, **changes)


def section(plan: Plan) -> str:
    """The argument, the picture and the numbers."""
    tasks = {env: {k: curves.of(plan, arm(plan, env, v)) for k, v in ARMS.items()} for env in SEEDS}
    tasks = {env: {k: v for k, v in arms.items() if v} for env, arms in tasks.items()}
    tasks = {env: arms for env, arms in tasks.items() if arms}
    if not tasks:
        return rows.missing(runs(plan))
    pictures.save(plan, draw(tasks), "collapse")
    caption = (
        "A panel an arm, all with the same axes: the mean over seeds and, between thin lines, its "
        "95 % interval. The spread is in units of the actions, which are in [-1, 1]."
    )
    picture = "![Spread over training](collapse.png)"
    return "\n\n".join((ARGUMENT, picture, caption, table(tasks).markdown()))


def draw(tasks):
    """A panel an arm, a line a task: ten arms in one panel lie on each other."""
    found = {k: {env: arms[k] for env, arms in tasks.items() if k in arms} for k in ARMS}
    found = {k: of_arm for k, of_arm in found.items() if of_arm}
    figure = draw_curves(found, "spread", "spread")
    figure.set_size_inches(10, 11)
    limits = np.array([axes.dataLim.intervaly for axes in figure.axes])
    for axes in figure.axes:
        axes.set(yscale="log", ylim=(limits[:, 0].min() / 1.2, 1.2 * limits[:, 1].max()))
    return figure


ARGUMENT = """The head is drawn apart from the state, so the objective is the mean over m of the
mean of $Q(s, \\rho_m(s))$: a sum of M equal terms, each largest where its head takes the best
action. Nothing in it rewards a difference. What is left at the end may come from four things that
these arms vary: which heads a sample moves (`all` gives every head the same samples), where the
heads start, the noise of minibatches (if it kept them apart, a tenth of the actor's step size would
leave less), and heads without a sample: of M = 50 in a batch of 64, $(1 - 1/50)^{64}$ = 27 % have
none, and Adam moves them on by its momentum; in a batch of 512 almost none."""


def table(tasks) -> Table:
    """Spread and relative Q-gap at the last evaluation, means with intervals over seeds."""
    lines = []
    for env, arms in tasks.items():
        spread, gap = (
            {k: [curve[column][-1] for curve in found] for k, found in arms.items()}
            for column in ("spread", "q_gap_relative")
        )
        usual = np.mean(spread[THE_PAPERS]) if THE_PAPERS in spread else np.nan
        for label in arms:
            ratio = f"{np.mean(spread[label]) / usual:.2g}"
            means = [f"{statistics.mean(of[label]):.2g}" for of in (spread, gap)]
            lines.append([env, label, means[0], ratio, means[1], f"n = {len(arms[label])}"])
    header = ("task", "arm", "spread", "over the paper's", "Q-gap / deviation of Q", "")
    return Table(header, lines)
