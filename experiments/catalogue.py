"""The experiments by name."""

import functools
import importlib
import itertools
from collections.abc import Sequence
from typing import Literal

from experiments.plan import Plan, in_order
from mapg_jax.training.config import Config

Name = Literal[
    "claims", "effects", "table2", "fig1", "fig5", "fig2", "fig3", "fig4", "torcs", "heads",
    "returns", "several", "collapse",
    "carryover", "reference", "overhead", "repeats",
]  # fmt: skip
TITLES: dict[Name, str] = {
    "claims": "The claims",
    "effects": "Effects over the tasks",
    "table2": "Table 2: five tasks",
    "fig1": "Figure 1: score over M, Hopper and Walker2d",
    "fig5": "Figure 5: score over M, the other tasks",
    "fig2": "Figure 2: spread and return during training, Pendulum",
    "fig3": "Figure 3: spread and angle within an episode, Pendulum",
    "fig4": "Figure 4: with and without noise",
    "torcs": "Driving, for TORCS",
    "heads": "The heads",
    "returns": "What each head returns",
    "several": "Where several actions pay",
    "collapse": "Why the heads come together",
    "carryover": "Other algorithms with several actions",
    "reference": "Each algorithm by its published settings",
    "overhead": "What the heads cost",
    "repeats": "Two runs of version 1, made again",
}
"""In the order of the page."""
LATER: tuple[Name, ...] = ("several", "collapse", "carryover", "reference")
"""Whose runs come after all others, each in its own order."""


def experiment(name: Name):
    """A module with `runs(plan)` and `section(plan)`.

    It may have `measure(plan, folder)`, of a run that finished, and `carry_out(plan)`, for what it
    does beside runs, once they are trained.
    """
    return importlib.import_module(f"experiments.{name}")


def runs(plan: Plan, names: Sequence[Name]) -> list[Config]:
    """All runs of those experiments: items 1 to 5 of the protocol, then those of LATER."""
    wanted = set(itertools.chain.from_iterable(_runs(name, plan) for name in names))
    last = itertools.chain.from_iterable(_runs(name, plan) for name in LATER)
    later = [config for config in last if config in wanted]
    return [*in_order(plan, wanted.difference(later)), *later]


@functools.cache  # a page asks for the runs of LATER with every section
def _runs(name: Name, plan: Plan) -> tuple[Config, ...]:
    return tuple(experiment(name).runs(plan))
