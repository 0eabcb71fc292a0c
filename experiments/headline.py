"""DDPG (M = 1) and MAPG (M = 10) on three tasks, several seeds: the tables of README and docs.

    python -m experiments.headline --workers 2    # runs what results/headline.csv lacks
    python -m experiments.headline --tables       # writes the tables into the README and the docs

A run that was cut off goes on from its checkpoint. What is written is what the runs wrote.
"""

import argparse
import concurrent.futures
import csv
import json
import pathlib
import re
import subprocess
import sys
import threading
from typing import NamedTuple

import numpy as np

from mapg_jax.run_folder import RunFolder
from mapg_jax.tracking import read_metrics

RESULTS = pathlib.Path("results/headline.csv")
CURVES = pathlib.Path("results/headline_curves.csv")
CURVE_COLUMNS = ("env_steps", "return_mean", "spread", "q_gap_relative", "critic_loss", "q_mean")
STEPS = {"pendulum": 100_000, "hopper": 600_000, "halfcheetah": 600_000}
ONE_ENVIRONMENT_STEPS = {"pendulum": 100_000, "halfcheetah": 300_000}
HEADS = (1, 10)
_writing = threading.Lock()


class Cell(NamedTuple):
    """One run."""

    env: str
    heads: int
    environments: int
    seed: int
    steps: int

    @property
    def folder(self) -> pathlib.Path:
        name = f"{self.env}-m{self.heads}-n{self.environments}-s{self.seed}"
        return pathlib.Path("runs/headline") / name


def cells(seeds: int) -> list[Cell]:
    """All runs, in an order that is useful wherever it stops."""
    found = []
    for seed in range(seeds):
        found += [Cell(env, m, 16, seed, steps) for env, steps in STEPS.items() for m in HEADS]
        found += [Cell(env, 10, 1, seed, steps) for env, steps in ONE_ENVIRONMENT_STEPS.items()]
    return found


def read(path: pathlib.Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run(cell: Cell) -> None:
    """Trains, or goes on with, one cell in a process of its own, and records it."""
    if cell.folder.exists():
        arguments = ["resume", str(cell.folder)]
    else:
        arguments = ["train", "--env", cell.env, "--heads", str(cell.heads)]
        arguments += ["--environments", str(cell.environments), "--seed", str(cell.seed)]
        arguments += ["--steps", str(cell.steps), "--out", str(cell.folder)]
    done = subprocess.run([sys.executable, "-m", "mapg_jax", *arguments], capture_output=True)
    if done.returncode:
        print(f"{cell.folder} failed:\n{done.stderr.decode()[-2000:]}", file=sys.stderr)
        return
    with _writing:
        record(cell)


def record(cell: Cell) -> None:
    """Appends the run's score and curve to the results."""
    folder = RunFolder.open(cell.folder)
    score = json.loads(folder.evaluation.read_text())
    rows = read_metrics(folder.metrics)
    written = json.loads((folder.path / "config.json").read_text())["history"][0]
    key = {
        "env": cell.env,
        "algorithm": "ddpg" if cell.heads == 1 else "mapg",
        "heads": cell.heads,
        "environments": cell.environments,
        "seed": cell.seed,
    }
    result = {
        **key,
        "steps": int(rows[-1]["env_steps"]),
        "return_mean": score["mean"],
        "return_std": score["std"],
        "episodes": score["episodes"],
        "seconds": round(rows[-1]["seconds"]),
        "command": written["command"],
        "packages": " ".join(f"{k}={v}" for k, v in written["packages"].items() if v),
    }
    append(RESULTS, [result])
    append(CURVES, [{**key, **{c: f"{row[c]:.6g}" for c in CURVE_COLUMNS}} for row in rows])
    print(f"{cell}: {score['mean']:.1f} ± {score['std']:.1f}", flush=True)


def append(path: pathlib.Path, rows: list[dict]) -> None:
    """Adds rows to a CSV file, with a header if it is new."""
    path.parent.mkdir(exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        if new:
            writer.writeheader()
        writer.writerows(rows)


def over_seeds(scores: list[float]) -> str:
    """Mean, lowest and highest, and how many."""
    if not scores:
        return "missing"
    return f"{np.mean(scores):.0f} ({min(scores):.0f} to {max(scores):.0f}; n = {len(scores)})"


def headline_table() -> str:
    """Scores of the finished runs with 16 environments."""
    rows = [row for row in read(RESULTS) if row["environments"] == "16"]
    lines = [
        "| task | steps | DDPG (M = 1) | MAPG (M = 10) | wall time a run |",
        "|---|---|---|---|---|",
    ]
    for env, steps in STEPS.items():
        of_env = [row for row in rows if row["env"] == env]
        scores = [
            over_seeds([float(r["return_mean"]) for r in of_env if r["heads"] == str(m)])
            for m in HEADS
        ]
        minutes = [float(row["seconds"]) / 60 for row in of_env]
        time = f"{np.median(minutes):.1f} min" if minutes else "missing"
        lines.append(f"| {env} | {steps:,} | {' | '.join(scores)} | {time} |")
    return "\n".join(lines)


def one_environment_table() -> str:
    """The last evaluations with one environment, beside those at the same step with sixteen."""
    rows = [row for row in read(CURVES) if row["heads"] == "10"]
    lines = ["| task, M = 10 | steps | 1 environment | 16 environments |", "|---|---|---|---|"]
    for env, steps in ONE_ENVIRONMENT_STEPS.items():
        at_end = [r for r in rows if r["env"] == env and float(r["env_steps"]) == steps]
        texts = [
            over_seeds([float(r["return_mean"]) for r in at_end if r["environments"] == n])
            for n in ("1", "16")
        ]
        lines.append(f"| {env} | {steps:,} | {' | '.join(texts)} |")
    return "\n".join(lines)


def insert(path: pathlib.Path, name: str, text: str) -> None:
    """Replaces what stands between a page's two comments of that name."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    page = path.read_text()
    if begin not in page or end not in page:
        raise ValueError(f"{path} lacks {begin} and {end}")
    pattern = re.escape(begin) + ".*" + re.escape(end)
    path.write_text(re.sub(pattern, lambda _: f"{begin}\n{text}\n{end}", page, flags=re.DOTALL))


def main() -> None:
    parser = argparse.ArgumentParser(description="Runs and tables of README and docs.")
    parser.add_argument("--workers", type=int, default=1, help="runs side by side")
    parser.add_argument("--seeds", type=int, default=5, help="seeds a cell")
    parser.add_argument("--tables", action="store_true", help="only write the tables")
    arguments = parser.parse_args()
    if not arguments.tables:
        keys = ("env", "heads", "environments", "seed")
        done = {tuple(row[k] for k in keys) for row in read(RESULTS)}
        waiting = [c for c in cells(arguments.seeds) if tuple(map(str, c[:4])) not in done]
        with concurrent.futures.ThreadPoolExecutor(arguments.workers) as pool:
            list(pool.map(run, waiting))
    insert(pathlib.Path("README.md"), "headline", headline_table())
    insert(pathlib.Path("docs/paper.md"), "one environment", one_environment_table())


if __name__ == "__main__":
    main()
