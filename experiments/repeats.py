"""Two runs of version 1 made again on this machine: what holds across machines, and what not."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments import curves, rows, scores
from experiments.plan import DDPG, MAPG, Plan
from mapg_jax.reports.document import Table
from mapg_jax.reports.results import read_run
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.sweeps.sweep import run_all
from mapg_jax.training.config import Config

ARMS: Mapping[str, Mapping[str, Any]] = {"DDPG": DDPG, "M = 10": MAPG}
FILE = "repeats.csv"


def runs(plan: Plan) -> list[Config]:
    """None: it makes its own, whose seed is of version 1, so that no other number has them."""
    return []


def repeated(plan: Plan) -> list[Config]:
    """Seed 0 of either arm, on HalfCheetah."""
    return [plan.config(plan.studied[-1], 0, **changes) for changes in ARMS.values()]


def carry_out(plan: Plan) -> list[str]:
    """Makes them, unless that was done before; gives the failures.

    Raises:
      StoppedError: on SIGINT or SIGTERM, once they are saved.
    """
    left = [c for c in repeated(plan) if not rows.holds(plan.measured / FILE, rows.identity(c))]
    folders = [(config, plan.runs / f"again-{plan.folder(config).name}") for config in left]
    return run_all(folders, on_finished=lambda folder: measure(plan, folder))


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds what it gave here, beside what it gave then."""
    result, curve = read_run(folder), read_metrics(folder.metrics)
    earlier = plan._replace(version=1)
    before = [other.return_mean for other in scores.of(earlier, [folder.config])]
    (old,) = curves.of(earlier, [folder.config]) or [{"return_mean": np.array([])}]
    new = np.array([float(f"{row['return_mean']:.6g}") for row in curve])
    same = len(old["return_mean"]) == len(new) and old["return_mean"] == new
    alike = int(
        np.argmin([*np.atleast_1d(same), False])
    )  # evaluations until the first that differs
    row = {
        **rows.identity(folder.config),
        "then": before[0] if before else "",
        "here": result.return_mean,
        "alike": alike,
        "evaluations": len(new),
        "processor": result.processor,
        "commit": result.commit,
    }
    rows.append(plan.measured / FILE, [row])


def section(plan: Plan) -> str:
    """A line a run."""
    found = rows.of(plan.measured / FILE, repeated(plan))
    if not found:
        return "Missing: neither has been made again."
    header = ("run", "score then", "score here", "evaluations alike", "processor", "commit")
    names = {rows.identity(c)["heads"]: f"{c.env}, {k}, seed 0"
             for k, c in zip(ARMS, repeated(plan), strict=True)}  # fmt: skip
    lines = [
        [
            names[row["heads"]],
            f"{float(row['then']):.0f}" if row["then"] else "missing",
            f"{float(row['here']):.0f}",
            f"the first {row['alike']} of {row['evaluations']}",
            row["processor"],
            row["commit"],
        ]
        for row in found
    ]
    return Table(header, lines).markdown() + (
        "\n\nSeed 0 of version 1, whose machine was not recorded, made again by the code of the "
        "commit named, which is not that of then. Bits hold on one machine and commit: "
        "else rounding differs, and after some thousand updates so does the run, which is then "
        "another draw from the same distribution. These two enter no other number."
    )
