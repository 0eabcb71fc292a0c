"""Figure 4: DDPG and MAPG during training, with and without exploration noise (C5)."""

from experiments import curves, pictures, rows, scores
from experiments.plan import DDPG, MAPG, NO_NOISE, Plan
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_curves
from mapg_jax.training.config import Config

ARMS = {
    "DDPG with noise": DDPG,
    "DDPG without": {**DDPG, **NO_NOISE},
    "M = 10 with noise": MAPG,
    "M = 10 without": {**MAPG, **NO_NOISE},
}


def runs(plan: Plan) -> list[Config]:
    return [config for env in plan.studied for label in ARMS for config in arm(plan, env, label)]


def arm(plan: Plan, env: str, label: str) -> list[Config]:
    """One arm on one task over all seeds."""
    return plan.over_seeds(env, **ARMS[label])


def section(plan: Plan) -> str:
    """The picture, and the final scores."""
    tasks = {env: {k: curves.of(plan, arm(plan, env, k)) for k in ARMS} for env in plan.studied}
    tasks = {env: {k: v for k, v in arms.items() if v} for env, arms in tasks.items()}
    tasks = {env: arms for env, arms in tasks.items() if arms}
    if not tasks:
        return rows.missing(runs(plan))
    figure = draw_curves(tasks)
    pictures.save(plan, figure, "fig4")
    lines = []
    for env in plan.studied:
        cells = [scores.of_cell(plan, arm(plan, env, label)) for label in ARMS]
        lines.append([env, *cells])
    return (
        "![With and without noise](fig4.png)\n\n"
        f"Evaluations of {plan.base.evaluation_episodes} episodes without noise: the mean over "
        "seeds and, between thin lines, its 95 % interval. "
        "Final scores, with the bootstrap's 95 % interval:\n\n"
    ) + Table(("task", *ARMS), lines).markdown()
