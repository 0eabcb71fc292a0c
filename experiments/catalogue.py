"""The experiments by name."""

import importlib
import itertools
from collections.abc import Sequence
from typing import Literal

from experiments.plan import Plan, in_order
from mapg_jax.training.config import Config

Name = Literal[
    "table2", "fig1", "fig5", "fig2", "fig3", "fig4", "torcs", "overhead", "heads", "claims"
]
TITLES: dict[Name, str] = {
    "table2": "Table 2: five tasks",
    "fig1": "Figure 1: score over M, Hopper and Walker2d",
    "fig5": "Figure 5: score over M, the other tasks",
    "fig2": "Figure 2: spread and return during training, Pendulum",
    "fig3": "Figure 3: spread and angle within an episode, Pendulum",
    "fig4": "Figure 4: with and without noise",
    "torcs": "Driving, for TORCS",
    "overhead": "What the heads cost",
    "heads": "The heads",
    "claims": "The claims",
}


def experiment(name: Name):
    """A module with `runs(plan)`, `section(plan)`, and perhaps `measure(plan, folder)`."""
    return importlib.import_module(f"experiments.{name}")


def runs(plan: Plan, names: Sequence[Name]) -> list[Config]:
    """All runs of those experiments, in the protocol's order."""
    wanted = itertools.chain.from_iterable(experiment(name).runs(plan) for name in names)
    return in_order(plan, wanted)
