"""make bench: measures, prints the tables and writes them to benchmarks/results.md."""

import datetime
import importlib.metadata
import os
import pathlib
import platform
import tempfile

import numpy as np

from benchmarks import driving, learner, physics, sweep

ROUNDS = 3
STEPS = 60_000
PEER_STEPS = 5_000
REPORT = pathlib.Path("benchmarks/results.md")


def main() -> None:
    sections = [_header(), _learner(), _physics(), _start(), driving.report(), sweep.report()]
    text = "\n\n".join(sections) + "\n"
    REPORT.write_text(text)
    print(text)


def _header() -> str:
    packages = ("jax", "mujoco", "flax", "optax")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    return (
        "# Speed\n\n"
        f"Written by `make bench` on {datetime.date.today()}: {platform.machine()}, "
        f"{len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}, {versions}. "
        f"Medians of {ROUNDS} interleaved rounds, each run a process of its own; of learning, the "
        "rate once compiled and learning, evaluation apart, on both sides alike."
    )


def _learner() -> str:
    rates = {"M = 1": [], "M = 10": [], "sbx": []}
    for _ in range(ROUNDS):
        rates["M = 1"].append(learner.ours(1, STEPS))
        rates["sbx"].append(learner.sbx(PEER_STEPS))
        rates["M = 10"].append(learner.ours(10, STEPS))
    lines = [
        "## Learning: HalfCheetah, 64-64, batch 64, no layer norm, one update a step",
        "",
        "| | environment steps/s | times sbx-rl's DDPG | wanted |",
        "|---|---|---|---|",
    ]
    peers = None if rates["sbx"][0] is None else np.array(rates["sbx"])
    for name, wanted in (("M = 1", 6), ("M = 10", 4.5)):
        ours = np.array(rates[name])
        ratio = "not measured" if peers is None else f"{np.median(ours / peers):.1f}"
        lines.append(f"| {name} | {np.median(ours):,.0f} | {ratio} | {wanted} |")
    if peers is None:
        lines += ["", "sbx-rl is missing: `make bench-peers` installs it."]
    else:
        lines.append(f"| sbx-rl DDPG | {np.median(peers):,.0f} | 1 | |")
    cost = np.median(np.array(rates["M = 1"]) / np.array(rates["M = 10"]))
    lines += ["", f"M = 10 takes {cost:.2f} times the time of M = 1 (wanted: at most 1.35)."]
    return "\n".join(lines)


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


def _start() -> str:
    colds, warms = [], []
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory() as cache:
            colds.append(learner.seconds_to_first_update(cache))
            warms.append(learner.seconds_to_first_update(cache))
    return (
        "## From `mapg train --env halfcheetah` to the first learning step\n\n"
        f"cold {np.median(colds):.1f} s (wanted: under 15), "
        f"warm {np.median(warms):.1f} s (wanted: under 10)"
    )


if __name__ == "__main__":
    main()
