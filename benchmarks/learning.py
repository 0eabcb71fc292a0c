"""Ours and other people's learners on the same settings, in one interleaved run."""

import json
import os
import subprocess
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from benchmarks import commands

PEERS = commands.ROOT / ".venv-peers/bin/python"
TITLE = "## Learning: 64-64, batch 64, no layer norm, one update a step, one thread"
SETTINGS = "--no-layer-norm --updates-per-step 1"


class Speed(NamedTuple):
    """Of one learner, in one round."""

    steps_per_second: float
    products: float  # µs, the matrix products of one update by themselves


Learner = Callable[[], Speed]


def ours(env: str, heads: int, steps: int) -> Learner:
    """A training by the command line, then the floor of its updates in a process of its own."""

    def measure() -> Speed:
        flags = ["--env", env, "--heads", str(heads), *SETTINGS.split()]
        rate = commands.steps_per_second(commands.ROOT, flags, steps)
        floor = commands.python(
            commands.ROOT, "-m", "benchmarks.products", env, heads, environment={"NPROC": "1"}
        )
        return Speed(rate, float(floor))

    return measure


def peer(module: str, *arguments: object) -> Learner:
    """A module of `benchmarks.peers`, with one thread of XLA as ours has."""

    def measure() -> Speed:
        command = [str(PEERS), "-m", f"benchmarks.peers.{module}", *map(str, arguments)]
        done = subprocess.run(
            command,
            cwd=commands.ROOT,
            env={**os.environ, "NPROC": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        return Speed(**json.loads(done.stdout.splitlines()[-1]))

    return measure


def halfcheetah(quick: bool) -> Mapping[str, Learner]:
    """The learners on HalfCheetah-v5, ours first."""
    few, many = (500, 2_000) if quick else (5_000, 60_000)
    return {
        "M = 1": ours("halfcheetah", 1, many),
        "M = 10": ours("halfcheetah", 10, many),
        "SBX, DDPG": peer("stable_baselines", "sbx", few),
        "Stable-Baselines3, DDPG": peer("stable_baselines", "sb3", few),
        "CleanRL's settings for DDPG in JAX, written anew": peer("cleanrl", few),
    }


def pendulum(quick: bool) -> Mapping[str, Learner]:
    """The learners on a Pendulum in JAX, ours first."""
    return {
        "M = 1": ours("pendulum", 1, 2_000 if quick else 100_000),
        "rejax, TD3": peer("rejax_td3", 1_000 if quick else 10_000),
    }


def report(rounds: int, quick: bool) -> str:
    """The section of the page."""
    if not PEERS.exists():
        return f"{TITLE}\n\nnot measured: `make bench-peers` installs the peers"
    learners = {"HalfCheetah-v5": halfcheetah(quick), "Pendulum": pendulum(quick)}
    found = {(task, name): [] for task, of_task in learners.items() for name in of_task}
    for _ in range(rounds):
        for task, name in found:
            found[task, name].append(learners[task][name]())
    lines = [
        TITLE,
        "",
        "Ours steps 16 environments side by side, the others one. rejax's TD3 has two critics, "
        "whose actor is updated at every step. The last column is the floor of an update: its "
        "matrix products alone, in the learner's own library, measured beside it.",
    ]
    for task in learners:
        rates = {name: found[task, name] for name in learners[task]}
        lines += ["", f"### {task}", "", *_table(rates)]
    m1, m10 = (_rates(found["HalfCheetah-v5", name]) for name in ("M = 1", "M = 10"))
    cost = np.median(m1 / m10)
    lines += [
        "",
        f"On HalfCheetah-v5 M = 10 takes {cost:.2f} times the time of M = 1, the median over "
        "rounds (wanted: at most 1.35).",
    ]
    return "\n".join(lines)


def _table(found: Mapping[str, list[Speed]]) -> list[str]:
    """A row a learner; the ratio is that of the first one's rate to its, round by round."""
    first = _rates(next(iter(found.values())))
    lines = [
        "| | environment steps/s | M = 1 is faster by (smallest to largest) | µs a step "
        "| of these, products |",
        "|---|---|---|---|---|",
    ]
    for name, speeds in found.items():
        rates = _rates(speeds)
        ratio = first / rates
        products = np.median([speed.products for speed in speeds])
        lines.append(
            f"| {name} | {np.median(rates):,.0f} "
            f"| {np.median(ratio):.1f} ({ratio.min():.1f} to {ratio.max():.1f}) "
            f"| {1e6 / np.median(rates):,.0f} | {products:,.0f} |"
        )
    return lines


def _rates(speeds: list[Speed]) -> np.ndarray:
    return np.array([speed.steps_per_second for speed in speeds])
