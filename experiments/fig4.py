"""Figure 4: DDPG and MAPG during training, with and without exploration noise (C5)."""

import itertools
from typing import TYPE_CHECKING

import numpy as np

from experiments import curves, pictures, rows, scores
from experiments.plan import DDPG, MAPG, NO_NOISE, Plan
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_curves
from mapg_jax.training.config import Config

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure

ALGORITHMS = {"DDPG": DDPG, "M = 10": MAPG}
NOISES = {"with noise": {}, "without noise": NO_NOISE}
ARMS = tuple(itertools.product(ALGORITHMS, NOISES))
Panels = dict[str, dict[str, list[dict[str, np.ndarray]]]]
"""Task and noise → algorithm → its curves."""


def runs(plan: Plan) -> list[Config]:
    cells = (arm(plan, env, *place) for env in plan.studied for place in ARMS)
    return [config for cell in cells for config in cell]


def arm(plan: Plan, env: str, algorithm: str, noise: str) -> list[Config]:
    """One arm on one task over all seeds."""
    return plan.over_seeds(env, **ALGORITHMS[algorithm], **NOISES[noise])


def section(plan: Plan) -> str:
    """The picture, and the final scores."""
    found = panels(plan)
    if not found:
        return rows.missing(runs(plan))
    pictures.save(plan, draw(found), "fig4")
    lines = []
    for env in plan.studied:
        cells = [scores.of_cell(plan, arm(plan, env, *place)) for place in ARMS]
        lines.append([env, *cells])
    return (
        "![With and without noise](fig4.png)\n\n"
        "Trained with noise and without; both panels of a task have one axis. "
        f"Evaluations of {plan.base.evaluation_episodes} episodes without noise: the mean over "
        "seeds and, between thin lines, its 95 % interval. "
        "Final scores, with the bootstrap's 95 % interval:\n\n"
    ) + Table(("task", *(f"{name} {noise}" for name, noise in ARMS)), lines).markdown()


def panels(plan: Plan) -> Panels:
    """Of the curves that there are."""
    found = {}
    for env in plan.studied:
        for noise in NOISES:
            arms = {name: curves.of(plan, arm(plan, env, name, noise)) for name in ALGORITHMS}
            if arms := {name: of_arm for name, of_arm in arms.items() if of_arm}:
                found[f"{env}, {noise}"] = arms
    return found


def draw(found: Panels) -> "Figure":
    """Panels of one task get one vertical axis: their arms are compared with each other."""
    figure = draw_curves(found)
    tasks = [title.split(",")[0] for title in found]
    for task in set(tasks):
        of_task = [panel for panel, name in zip(figure.axes, tasks, strict=True) if name == task]
        limits = [panel.get_ylim() for panel in of_task]
        for panel in of_task:
            panel.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    return figure
