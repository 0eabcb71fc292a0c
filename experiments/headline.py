"""The table of the README: DDPG (M = 1) and MAPG (M = 10) on three tasks, several seeds.

    python -m experiments.headline --workers 2    # runs what results/headline.csv lacks
    python -m experiments.headline --table        # prints the table

A run that was cut off goes on from its checkpoint. What is written is what the runs wrote.
"""

import argparse
import concurrent.futures
import csv
import json
import pathlib
import subprocess
import sys
import threading

import numpy as np

from mapg_jax.run_folder import RunFolder
from mapg_jax.tracking import read_metrics

RESULTS = pathlib.Path("results/headline.csv")
CURVES = pathlib.Path("results/headline_curves.csv")
CURVE_COLUMNS = ("env_steps", "return_mean", "spread", "q_gap_relative", "critic_loss", "q_mean")
TASKS = {"pendulum": 100_000, "hopper": 2_000_000, "halfcheetah": 2_000_000}
HEADS = (1, 10)
_writing = threading.Lock()


def cells(seeds: int) -> list[tuple[str, int, int]]:
    """(env, heads, seed), in an order that is useful wherever it stops."""
    return [(env, m, seed) for seed in range(seeds) for env in TASKS for m in HEADS]


def finished() -> set[tuple[str, int, int]]:
    """The cells that the results hold."""
    if not RESULTS.exists():
        return set()
    with RESULTS.open(newline="") as file:
        return {(r["env"], int(r["heads"]), int(r["seed"])) for r in csv.DictReader(file)}


def run(cell: tuple[str, int, int]) -> None:
    """Trains, or goes on with, one cell in a process of its own, and records it."""
    env, m, seed = cell
    path = pathlib.Path(f"runs/headline/{env}-m{m}-s{seed}")
    if path.exists():
        arguments = ["resume", str(path)]
    else:
        arguments = ["train", "--env", env, "--heads", str(m), "--seed", str(seed)]
        arguments += ["--steps", str(TASKS[env]), "--out", str(path)]
    done = subprocess.run([sys.executable, "-m", "mapg_jax", *arguments], capture_output=True)
    if done.returncode:
        print(f"{path} failed:\n{done.stderr.decode()[-2000:]}", file=sys.stderr)
        return
    with _writing:
        record(cell, RunFolder.open(path))


def record(cell: tuple[str, int, int], folder: RunFolder) -> None:
    """Appends the run's score and curve to the results."""
    env, m, seed = cell
    score = json.loads(folder.evaluation.read_text())
    rows = read_metrics(folder.metrics)
    written = json.loads((folder.path / "config.json").read_text())
    result = {
        "env": env,
        "algorithm": "ddpg" if m == 1 else "mapg",
        "heads": m,
        "seed": seed,
        "steps": int(rows[-1]["env_steps"]),
        "return_mean": score["mean"],
        "return_std": score["std"],
        "episodes": score["episodes"],
        "seconds": round(rows[-1]["seconds"]),
        "command": written["command"],
        "packages": " ".join(f"{k}={v}" for k, v in written["packages"].items() if v),
    }
    append(RESULTS, [result])
    keys = {"env": env, "heads": m, "seed": seed}
    append(CURVES, [{**keys, **{c: f"{row[c]:.6g}" for c in CURVE_COLUMNS}} for row in rows])
    print(f"{env} M={m} seed {seed}: {score['mean']:.1f} ± {score['std']:.1f}", flush=True)


def append(path: pathlib.Path, rows: list[dict]) -> None:
    """Adds rows to a CSV file, with a header if it is new."""
    path.parent.mkdir(exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        if new:
            writer.writeheader()
        writer.writerows(rows)


def table() -> str:
    """Mean over seeds of the runs' scores, with the lowest and highest seed."""
    with RESULTS.open(newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [
        "| task | steps | DDPG (M = 1) | MAPG (M = 10) | seeds | wall time a run |",
        "|---|---|---|---|---|---|",
    ]
    for env, steps in TASKS.items():
        cells, seeds, minutes = [], [], []
        for m in HEADS:
            of_cell = [r for r in rows if r["env"] == env and int(r["heads"]) == m]
            scores = [float(r["return_mean"]) for r in of_cell]
            seeds.append(str(len(scores)))
            minutes += [float(r["seconds"]) / 60 for r in of_cell]
            text = f"{np.mean(scores):.0f} ({min(scores):.0f} to {max(scores):.0f})"
            cells.append(text if scores else "missing")
        counts = seeds[0] if seeds[0] == seeds[1] else " and ".join(seeds)
        time = f"{np.median(minutes):.1f} min" if minutes else "missing"
        lines.append(f"| {env} | {steps:,} | {' | '.join(cells)} | {counts} | {time} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=1, help="runs side by side")
    parser.add_argument("--seeds", type=int, default=5, help="seeds a cell")
    parser.add_argument("--table", action="store_true", help="print the table and stop")
    arguments = parser.parse_args()
    if not arguments.table:
        waiting = [cell for cell in cells(arguments.seeds) if cell not in finished()]
        with concurrent.futures.ThreadPoolExecutor(arguments.workers) as pool:
            list(pool.map(run, waiting))
    print(table())


if __name__ == "__main__":
    main()
