"""Rows of results as runs would have written them."""

import numpy as np

from experiments import curves, rows, scores
from experiments.plan import DRIVING, FIRST_SEED
from mapg_jax.reports.results import Result, run_key
from mapg_jax.reports.results_csv import append_csv

ON_ONE = {"processor": "A", "instructions": "x", "commit": "abc", "threads": "1"}
"""Where a run or a timing was made."""


def result(config, score, **extra) -> Result:
    rest = {"return_std": 1.0, "episodes": 100, "select": "uniform", "physics": "native",
            "versions": "", "seconds": 1.0, "date": "2026-01-01", "command": "",
            **ON_ONE, **extra}  # fmt: skip
    rest.setdefault("engine", rest["physics"])
    return Result(**run_key(config)._asdict(), return_mean=float(score), **rest)


def write(plan, env, changes, values):
    """Scores of a cell, a value a seed."""
    cell = [plan.config(env, FIRST_SEED + k, **changes) for k in range(len(values))]
    found = [result(config, x) for config, x in zip(cell, values, strict=True)]
    append_csv(scores.path(plan), found)


def write_laps(plan, changes, shares):
    """Of driving, the share of the episodes that complete a lap, a value a seed."""
    found = [
        result(plan.config("driving", seed, **DRIVING, **changes), 100 * share, physics="jax",
               metrics={"distance_mean": 1000 * share, "laps_mean": share, "lap_share": share})
        for seed, share in enumerate(shares, FIRST_SEED)
    ]  # fmt: skip
    append_csv(scores.path(plan), found)


def write_curve(plan, config, **columns):
    """Of one run; what is not given is 0, and an evaluation follows every step."""
    length = len(next(iter(columns.values())))
    columns = {
        **{name: np.zeros(length) for name in curves.COLUMNS},
        "env_steps": np.arange(length),
        **columns,
    }
    lines = [
        {**rows.identity(config), **{k: v[i] for k, v in columns.items()}} for i in range(length)
    ]
    rows.append(plan.measured / curves.FILE, lines)
