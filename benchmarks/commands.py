"""What a user waits for: the command line of a checkout, timed from outside."""

import contextlib
import csv
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence

ROOT = pathlib.Path(__file__).parent.parent
"""This checkout."""


def python(
    root: pathlib.Path, *arguments: object, environment: Mapping[str, str] | None = None
) -> str:
    """Standard output of this Python over the packages of a checkout.

    Raises:
      subprocess.CalledProcessError: if it fails; with its standard error.
    """
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command,
        cwd=root,
        env={**_environment(root), **(environment or {})},
        capture_output=True,
        text=True,
        check=True,
    ).stdout


def steps_per_second(root: pathlib.Path, flags: Sequence[str], steps: int) -> float:
    """Environment steps per second of `mapg train`, evaluation and compilation apart."""
    length = ["--steps", steps, "--evaluate-every", steps]
    scored = ["--evaluation-episodes", 1, "--final-episodes", 1]
    with tempfile.TemporaryDirectory() as parent:
        out = pathlib.Path(parent) / "run"
        python(root, "-m", "mapg_jax", "train", *flags, *length, *scored, "--out", out)
        return last_rate(out)


def last_rate(run: pathlib.Path) -> float:
    """Environment steps per second of a run up to its last evaluation."""
    with (run / "metrics.csv").open(newline="") as file:
        return float(list(csv.DictReader(file))[-1]["steps_per_second"])


def seconds_to_learning(root: pathlib.Path, env: str, cache: str) -> float:
    """From the command `mapg train --env ENV` to the first learning step.

    Args:
      root: the checkout.
      env: the environment.
      cache: folder of compiled programs; empty for a cold start.
    """
    with tempfile.TemporaryDirectory() as parent:
        command = [sys.executable, "-m", "mapg_jax", "train", "--env", env]
        begun = time.perf_counter()
        with _process([*command, "--out", f"{parent}/run"], root, cache) as process:
            lines = []
            for line in process.stderr or ():
                if line.strip() == "learning":
                    return time.perf_counter() - begun
                lines.append(line)
            raise subprocess.CalledProcessError(process.wait(), command, stderr="".join(lines))


def seconds_of_help(root: pathlib.Path) -> float:
    """`mapg --help`, the process and all."""
    begun = time.perf_counter()
    python(root, "-m", "mapg_jax", "--help")
    return time.perf_counter() - begun


@contextlib.contextmanager
def _process(command: list[str], root: pathlib.Path, cache: str) -> Iterator[subprocess.Popen[str]]:
    """A process that is ended with the block."""
    with subprocess.Popen(
        command,
        cwd=root,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**_environment(root), "JAX_COMPILATION_CACHE_DIR": cache},
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _environment(root: pathlib.Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(root)}
