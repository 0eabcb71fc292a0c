"""Throughput of two pinned worker processes against one: the same runs, one and two at a time."""

import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks import commands

TITLE = "## Sweeps: HalfCheetah, M = 10, two worker processes on two cores against one on one"
STEPS = 60_000
SETTINGS = ["--env", "halfcheetah", "--evaluation-episodes", "1", "--final-episodes", "1"]


def report(rounds: int, quick: bool) -> str:
    """The section of the page."""
    steps = 2_000 if quick else STEPS
    if len(os.sched_getaffinity(0)) < 2:
        return f"{TITLE}\n\nnot measured: one core"
    ratios = []
    for _ in range(rounds):
        alone = np.median([_rate(1, steps) for _ in range(2)])
        ratios.append(_rate(2, steps) / alone)
    return (
        f"{TITLE}\n\n"
        f"{np.median(ratios):.2f} times the environment steps a second (wanted: 1.7); "
        f"{min(ratios):.2f} to {max(ratios):.2f} over {len(ratios)} interleaved rounds, rates of "
        "training once compiled"
    )


def _rate(workers: int, steps: int) -> float:
    """Environment steps per second of as many runs side by side as there are workers."""
    arguments = [*SETTINGS, "--seeds", str(workers), "--workers", str(workers)]
    arguments += ["--steps", str(steps), "--evaluate-every", str(steps // 2)]
    # One process gets one core: the other would step its physics too.
    cores = sorted(os.sched_getaffinity(0))[:workers]
    with tempfile.TemporaryDirectory() as parent:
        out = pathlib.Path(parent) / "sweep"
        command = [sys.executable, "-m", "mapg_jax", "sweep", *arguments, "--out", str(out)]
        subprocess.run(
            command,
            capture_output=True,
            check=True,
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
        )
        return sum(commands.last_rate(file.parent) for file in out.glob("*/metrics.csv"))
