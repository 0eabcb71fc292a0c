"""Environment steps per second of a training process, and the time until it learns."""

import os
import pathlib
import subprocess
import sys
import tempfile
import time

from mapg_jax.runs.metrics import read_metrics

PEER = pathlib.Path(".venv-peers/bin/python")
SETTINGS = ["--env", "halfcheetah", "--no-layer-norm", "--updates-per-step", "1"]


def ours(heads: int, steps: int) -> float:
    """Steps per second of `mapg train` on HalfCheetah, evaluation and compilation apart."""
    arguments = [*SETTINGS, "--heads", str(heads), "--steps", str(steps)]
    arguments += ["--evaluate-every", str(steps), "--evaluation-episodes", "1"]
    with tempfile.TemporaryDirectory() as parent:
        folder = pathlib.Path(parent) / "run"
        command = [sys.executable, "-m", "mapg_jax", "train", *arguments]
        command += ["--final-episodes", "1", "--out", str(folder)]
        subprocess.run(command, capture_output=True, check=True)
        return read_metrics(folder / "metrics.csv")[-1]["steps_per_second"]


def sbx(steps: int) -> float | None:
    """Steps per second of sbx-rl's DDPG; None where the peers are not installed."""
    if not PEER.exists():
        return None
    command = [str(PEER), "benchmarks/peer_sbx.py", str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def seconds_to_first_update(cache: str) -> float:
    """From the command `mapg train --env halfcheetah` to the first learning step.

    Args:
      cache: folder of compiled programs; empty for a cold start.
    """
    with tempfile.TemporaryDirectory() as parent:
        command = [sys.executable, "-m", "mapg_jax", "train", "--env", "halfcheetah"]
        begun = time.perf_counter()
        with subprocess.Popen(
            [*command, "--out", f"{parent}/run"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache},
        ) as process:
            for line in process.stderr or ():
                if line.strip() == "learning":
                    seconds = time.perf_counter() - begun
                    process.kill()
                    return seconds
    raise RuntimeError("mapg train ended before it began to learn")
