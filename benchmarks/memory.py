"""What a run holds in memory: its replay, and runs in lockstep that are resumed."""

import json
import pathlib
import resource
import sys
import tempfile
from typing import NamedTuple

import jax

from benchmarks import commands, growth
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.memory import prepare
from mapg_jax.runs.run import Run
from mapg_jax.training import replay
from mapg_jax.training.config import preset
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.state import tree_bytes

TASKS = ("humanoid", "halfcheetah")
RUNS = (1, 4, 16)
"""In lockstep."""
STEPS = 1_000_000
"""Of each of them, and the slots of its replay, which they fill."""


class Resumed(NamedTuple):
    """A group of runs, in a process that only takes it up."""

    state: int
    """Bytes of all runs."""
    before: int
    """Bytes the process had held at most, its program prepared."""
    peak: int
    """Bytes it had held at most with the state."""


def report(quick: bool) -> str:
    """The section of the page."""
    lines = [
        "## What is held in memory",
        "",
        "The replay of the preset `paper`, which holds each observation once, beside what its "
        "steps would take with both of theirs:",
        "",
        "| | slots | MB | with both observations | share |",
        "|---|---|---|---|---|",
    ]
    for env in TASKS:
        slots, held, twice = of_replay(env)
        lines.append(
            f"| {env} | {slots:,} | {held / 1e6:,.0f} | {twice / 1e6:,.0f} | {held / twice:.0%} |"
        )
    steps = STEPS // 100 if quick else STEPS
    lines += [
        "",
        f"Runs in lockstep whose replays of {steps:,} steps are full, resumed: what the process "
        "held at most beyond what it had held before it read the first checkpoint. It should be "
        "their state once, that of one run beside it, and what reading and putting together take "
        "(Orbax, and two programs that are compiled), which should not grow with the runs:",
        "",
        "| runs | state, MB | more at most, MB | beyond the state, MB |",
        "|---|---|---|---|",
    ]
    for n in RUNS[:2] if quick else RUNS:
        state, before, peak = resumed(n, steps)
        more = peak - before
        lines.append(
            f"| {n} | {state / 1e6:,.0f} | {more / 1e6:,.0f} | {(more - state) / 1e6:,.0f} |"
        )
    return "\n".join(lines)


def of_replay(env: str) -> tuple[int, int, int]:
    """Slots, bytes, and bytes if every step held both of its observations."""
    state = jax.eval_shape(Lockstep([preset("paper", env=env)]).init).replay
    slots = replay.capacity(state)
    return slots, tree_bytes(state), slots * replay.bytes_of_a_step(state)


def resumed(runs: int, steps: int) -> Resumed:
    """Trains a group in one process, and takes it up in another."""
    with tempfile.TemporaryDirectory() as parent:
        for step in ("train", "take-up"):
            out = commands.python(
                commands.ROOT, "-m", "benchmarks.memory", step, parent, runs, steps
            )
    return Resumed(**json.loads(out.splitlines()[-1]))


def _main(step: str, parent: str, runs: int, steps: int) -> None:
    growth.register()
    configs = [
        growth.configure(
            256, steps=steps, replay_size=steps, seed=k,
            evaluate_every=steps, evaluation_episodes=1,
        )
        for k in range(runs)
    ]  # fmt: skip
    paths = [pathlib.Path(parent) / str(config.seed) for config in configs]
    if step == "train":
        folders = [RunFolder.create(*pair) for pair in zip(paths, configs, strict=True)]
        Run(prepare(*configs), folders).go()
        return
    run = Run(prepare(*configs), [RunFolder.open(path) for path in paths])
    before = _peak()
    run.restore()
    print(json.dumps(Resumed(run.program.bytes, before, _peak())._asdict()))


def _peak() -> int:
    """Bytes this process has held at most."""
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # On Linux that begins at the most of the process that started this one.
    status = pathlib.Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


if __name__ == "__main__":
    _main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
