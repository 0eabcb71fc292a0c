"""Figure 1: the score over M on Hopper and Walker2d."""

from experiments import boxes
from experiments.plan import Plan
from mapg_jax.training.config import Config

ENVS = ("hopper", "walker2d")
measure = boxes.measure


def runs(plan: Plan) -> list[Config]:
    return boxes.runs(plan, ENVS)


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    return boxes.section(plan, ENVS, "fig1")
