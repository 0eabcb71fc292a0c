"""Figure 5: the score over M on Humanoid, HalfCheetah and Swimmer."""

from experiments import boxes
from experiments.plan import Plan
from mapg_jax.training.config import Config

ENVS = ("humanoid", "halfcheetah", "swimmer")
measure = boxes.measure


def runs(plan: Plan) -> list[Config]:
    return boxes.runs(plan, ENVS)


def section(plan: Plan) -> str:
    """The picture, and what it shows."""
    return boxes.section(plan, ENVS, "fig5")
