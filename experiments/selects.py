"""Scores of last policies by other choices of the action than that of the protocol."""

from collections.abc import Sequence

from experiments import rows
from experiments.plan import Plan
from mapg_jax.algorithms.heads import Select
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.scoring import score
from mapg_jax.training.config import Config

FILE = "selects.csv"
HEADS: tuple[Select, ...] = ("uniform", "argmax-q", "mean")
"""Choices among several proposals."""


def measure(plan: Plan, folder: RunFolder, selects: Sequence[Select]) -> None:
    """Adds the scores of a run by each of these choices."""
    key = rows.identity(folder.config)
    if rows.holds(plan.measured / FILE, key):
        return
    new = []
    for select in selects:
        record = score(folder, folder.config.final_episodes, select=select)
        numbers = {"return_mean": record["mean"], "return_std": record["std"]}
        new.append({**key, "select": select, **numbers, "episodes": record["episodes"]})
    rows.append(plan.measured / FILE, new)


def means(plan: Plan, runs: Sequence[Config], select: Select) -> list[float]:
    """Those of the runs that have been scored so."""
    found = rows.of(plan.measured / FILE, runs, ("return_mean",), each="select")
    return [row["return_mean"] for row in found if row["select"] == select]
