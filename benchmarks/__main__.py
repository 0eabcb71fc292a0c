"""make bench: measures, prints the tables and writes them to benchmarks/results.md.

`--quick` measures too little to mean anything and writes no file: it shows that all of it runs.
"""

import argparse
import datetime
import importlib.metadata
import os
import platform
import tempfile
from collections.abc import Callable

import numpy as np

from benchmarks import (
    commands,
    devices,
    driving,
    growth,
    learning,
    memory,
    page,
    physics,
    reach,
    sweep,
)

ROUNDS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only see that it runs")
    parser.add_argument(
        "--only", nargs="+", choices=list(_sections(1, True)), help="these sections, anew"
    )
    arguments = parser.parse_args()
    quick = arguments.quick
    rounds = 1 if quick else ROUNDS
    sections = _sections(rounds, quick)
    if arguments.only:
        for name in arguments.only:
            section = sections[name]()
            print(section)
            if not quick:
                page.renew(section)
        return
    text = "\n\n".join([_header(rounds), *(section() for section in sections.values())]) + "\n"
    if not quick:
        page.FILE.write_text(text)
    print(text)


def _sections(rounds: int, quick: bool) -> dict[str, Callable[[], str]]:
    """What makes each section of the page, in their order there."""
    return {
        "learning": lambda: learning.report(rounds, quick),
        "physics": _physics,
        "start": lambda: _start(rounds),
        "driving": driving.report,
        "sweep": lambda: sweep.report(rounds, quick),
        "devices": lambda: devices.report(quick),
        "growth": lambda: growth.report(quick),
        "memory": lambda: memory.report(quick),
        "reach": reach.report,  # of what has been run: it takes hours
    }


def _header(rounds: int) -> str:
    packages = ("jax", "mujoco", "flax", "optax")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    return (
        "# Speed\n\n"
        f"Written by `make bench` on {datetime.date.today()}: {platform.machine()}, "
        f"{len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}, {versions}. "
        f"Medians of {rounds} interleaved rounds, each run a process of its own; of learning, the "
        "rate once compiled and learning, evaluation apart, on both sides alike."
    )


def _physics() -> str:
    rates = physics.measure()
    lines = [
        f"## Physics: {physics.SIMULATIONS} HalfCheetahs",
        "",
        "| | control steps/s | of raw | wanted |",
        "|---|---|---|---|",
        f"| raw mujoco.batch | {rates['raw']:,.0f} | | |",
    ]
    for name, title, wanted in (
        ("callback", "engine inside jit", "85 %"),
        ("environment", "with observation, reward and automatic reset", "70 %"),
    ):
        share = rates[name] / rates["raw"]
        lines.append(f"| {title} | {rates[name]:,.0f} | {share:.0%} | {wanted} |")
    return "\n".join(lines)


def _start(rounds: int) -> str:
    found = {"halfcheetah": ([], []), "pendulum": ([], [])}
    asking = []
    for _ in range(rounds):
        for env, states in found.items():
            with tempfile.TemporaryDirectory() as cache:  # cold, then warm
                for times in states:
                    times.append(commands.seconds_to_learning(commands.ROOT, env, cache))
        asking.append(commands.seconds_of_help(commands.ROOT))
    lines = [
        "## From the command to the first learning step, s",
        "",
        "| | nothing compiled before | once more | wanted |",
        "|---|---|---|---|",
    ]
    for env, wanted in (("halfcheetah", "under 4.5"), ("pendulum", "under 4")):
        cold, warm = map(np.median, found[env])
        lines.append(f"| mapg train --env {env} | {cold:.1f} | {warm:.1f} | {wanted} |")
    lines.append(f"| mapg --help | | {np.median(asking):.1f} | under 1 |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
