"""python -m benchmarks.compare OTHER: how many times as fast this checkout is as another one.

Both run over the same Python and its packages, in turn, in one run on one machine; a ratio is that
of one round, and the table gives the median, the smallest and the largest of them.
"""

import argparse
import dataclasses
import functools
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable

import numpy as np

from benchmarks import commands

PLAIN = "--updates-per-step 1 --no-layer-norm"
TRAINING = {  # flags, and steps: about ten seconds each
    "HalfCheetah, M = 1": ("--env halfcheetah --heads 1", 60_000),
    "HalfCheetah, M = 10": ("--env halfcheetah --heads 10", 60_000),
    "HalfCheetah, M = 50": ("--env halfcheetah --heads 50", 40_000),
    "Humanoid, M = 10": ("--env humanoid --heads 10", 20_000),
    "A3C, HalfCheetah": ("--env halfcheetah --algorithm a3c", 150_000),
    "driving, M = 10": ("--env driving --heads 10", 60_000),
    "HalfCheetah, M = 1, an update a step, no layer norm": (
        f"--env halfcheetah --heads 1 {PLAIN}",
        60_000,
    ),
    "HalfCheetah, M = 10, an update a step, no layer norm": (
        f"--env halfcheetah --heads 10 {PLAIN}",
        60_000,
    ),
}
QUICK_STEPS = 2_000


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What is measured."""

    name: str
    unit: str
    more_is_better: bool = False


Subject = Callable[[pathlib.Path], dict[Quantity, float]]
"""Measures some quantities of a checkout."""


def training(name: str, quick: bool, root: pathlib.Path) -> dict[Quantity, float]:
    """Whole training by `mapg train`, its evaluation and compilation apart."""
    flags, steps = TRAINING[name]
    rate = commands.steps_per_second(root, flags.split(), QUICK_STEPS if quick else steps)
    return {Quantity(f"training: {name}", "steps/s", more_is_better=True): rate}


def turns(quick: bool, root: pathlib.Path) -> dict[Quantity, float]:
    """Updates and collecting by themselves."""
    script = commands.ROOT / "benchmarks" / "turns.py"
    flags = ["--quick"] if quick else []
    text = commands.python(root, "-P", script, *flags, environment={"NPROC": "1"})
    return {Quantity(name, "µs"): value for name, value in json.loads(text).items()}


def start(env: str, root: pathlib.Path) -> dict[Quantity, float]:
    """From `mapg train` to its first learning step, nothing compiled yet and then once more."""
    with tempfile.TemporaryDirectory() as cache:
        return {
            Quantity(f"mapg train --env {env}, to learning, {state}", "s"): (
                commands.seconds_to_learning(root, env, cache)
            )
            for state in ("cold", "warm")
        }


def asking_for_help(root: pathlib.Path) -> dict[Quantity, float]:
    """`mapg --help`."""
    return {Quantity("mapg --help", "s"): commands.seconds_of_help(root)}


def subjects(quick: bool) -> dict[str, list[Subject]]:
    """All that can be measured, by the names of `--only`."""
    return {
        "training": [functools.partial(training, name, quick) for name in TRAINING],
        "turns": [functools.partial(turns, quick)],
        "start": [functools.partial(start, env) for env in ("halfcheetah", "pendulum")],
        "help": [asking_for_help],
    }


def measure(
    subject: Subject, other: pathlib.Path, other_first: bool
) -> dict[Quantity, tuple[float, float]]:
    """Each quantity in the other checkout and in this one."""
    roots = (other, commands.ROOT) if other_first else (commands.ROOT, other)
    values = {root: subject(root) for root in roots}
    return {
        quantity: (values[other][quantity], values[commands.ROOT][quantity])
        for quantity in values[other]
    }


def table(found: dict[Quantity, list[tuple[float, float]]]) -> str:
    """In Markdown."""
    lines = [
        "| | other | this | | times as fast (smallest to largest) |",
        "|---|---|---|---|---|",
    ]
    for quantity, pairs in found.items():
        other, this = np.array(pairs).T
        ratio = this / other if quantity.more_is_better else other / this
        digits = 2 if quantity.unit == "s" else 0
        lines.append(
            f"| {quantity.name} | {np.median(other):,.{digits}f} | {np.median(this):,.{digits}f} "
            f"| {quantity.unit} | {np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f}) |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=pathlib.Path, help="the root of the other checkout")
    parser.add_argument("--rounds", type=int, default=5, help="of each measurement")
    parser.add_argument("--only", nargs="+", choices=subjects(False), help="some of them")
    parser.add_argument("--quick", action="store_true", help="one short round: does all run?")
    arguments = parser.parse_args()
    other = arguments.other.absolute()
    if not (other / "mapg_jax").is_dir():
        parser.error(f"{other} is no checkout of this project: it has no folder mapg_jax")

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # the table is printed
    groups = subjects(arguments.quick)
    chosen = [subject for name in arguments.only or groups for subject in groups[name]]
    rounds = 1 if arguments.quick else arguments.rounds
    found: dict[Quantity, list[tuple[float, float]]] = {}
    try:
        for i in range(rounds):
            for done, subject in enumerate(chosen):
                print(f"round {i + 1} of {rounds}: {done} of {len(chosen)}", file=sys.stderr)
                for quantity, pair in measure(subject, other, other_first=i % 2 == 0).items():
                    found.setdefault(quantity, []).append(pair)
    except subprocess.CalledProcessError as error:
        sys.exit(f"{' '.join(error.cmd)} failed:\n{error.stderr}")
    finally:  # what was measured until then, whatever ended it
        print(f"{rounds} interleaved rounds on {len(os.sched_getaffinity(0))} cores.\n")
        print(table(found))


if __name__ == "__main__":
    main()
