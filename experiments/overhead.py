"""Time per training step and per update over M: what the heads cost (C7)."""

import itertools
import os
import time
from collections.abc import Callable
from typing import cast

import jax
import numpy as np

from envs.engines.simulators import cpus
from experiments import rows
from experiments.plan import Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.runs.folder import this_process
from mapg_jax.runs.host import this_host
from mapg_jax.runs.signals import StoppedError, caught_signals
from mapg_jax.training.config import Config, ReplayConfig
from mapg_jax.training.state import TrainState
from mapg_jax.training.trainer import make_trainer
from mapg_jax.training.turns import ReplayTurn

TIMES = "overhead.csv"
MACHINE = ("processor", "instructions", "commit", "threads")
"""Columns that all rows have alike: times of one are not compared with another's."""


def runs(plan: Plan) -> list[Config]:
    """None: it times its own."""
    return []


def carry_out(plan: Plan) -> list[str]:
    """Times every M on Hopper, interleaved, unless that was done before; gives no failures.

    Raises:
      StoppedError: on SIGINT or SIGTERM; rounds are compared as a whole, and none is kept.
    """
    if (plan.measured / TIMES).exists():
        return []
    rounds, seconds = plan.timing
    process, host = this_process(), this_host("native")
    packages = {name: process["packages"][name] for name in ("jax", "jaxlib", "mujoco")}
    where = {
        "date": process["date"],
        "versions": ", ".join(f"{name} {version}" for name, version in packages.items()),
        "cores": cpus(),
        "threads": os.environ.get("NPROC", "all"),  # of XLA
        "load": f"{os.getloadavg()[0]:.2f}",  # of the last minute, by others
        **{name: host[name] for name in ("processor", "instructions", "commit")},
    }
    times = []
    with caught_signals() as signals:
        arms = [TimedArm(plan, m, seconds) for m in (1, *plan.heads)]
        for r, arm in itertools.product(range(rounds), arms):
            if signals:
                raise StoppedError(signals[0], "the same command")
            times.append({"env": "hopper", "heads": arm.config.heads, "round": r, **where, **arm()})
    rows.append(plan.measured / TIMES, times)
    return []


class TimedArm:
    """One M: a training state that has begun to learn, and two programs to time."""

    def __init__(self, plan: Plan, m: int, seconds: float):
        self.config = cast(ReplayConfig, plan.config("hopper", heads=m))
        self.trainer = make_trainer(self.config)
        started = self.config.learning_starts // self.config.environments + 1
        self.state = self.trainer.jitted_run(self.trainer.jitted_init(0), started)
        self.updates = jax.jit(self._updates, donate_argnums=0)
        self.turns = self._enough(self.trainer.jitted_run, seconds)
        self.repeats = self._enough(self.updates, seconds)

    def __call__(self) -> dict[str, str]:
        """Seconds per environment step, its updates included, and per update alone."""
        steps = self.turns * self.config.environments
        updates = self.repeats * self.config.environments * float(self.trainer.turn.updates_ratio)
        return {
            "seconds_per_step": f"{self._time(self.trainer.jitted_run, self.turns) / steps:.4g}",
            "seconds_per_update": f"{self._time(self.updates, self.repeats) / updates:.4g}",
        }

    def _updates(self, state: TrainState, repeats: jax.Array) -> TrainState:
        """The updates of that many turns, without their environment steps."""

        learn = cast(ReplayTurn, self.trainer.turn).learn

        def turn(i, state):
            keys = jax.random.split(jax.random.fold_in(state.key, i))
            return learn(state, *keys)

        return jax.lax.fori_loop(0, repeats, turn, state)

    def _time(self, program: Callable, repeats: int) -> float:
        begun = time.perf_counter()
        self.state = jax.block_until_ready(program(self.state, repeats))
        return time.perf_counter() - begun

    def _enough(self, program: Callable, seconds: float) -> int:
        """Repeats that take about that long, once compiled."""
        self._time(program, 8)
        return max(8, round(8 * seconds / self._time(program, 8)))


def ratios(plan: Plan, column: str) -> dict[int, np.ndarray]:
    """M → the time over that of M = 1, one number a round.

    Raises:
      ValueError: if the rows are not of one timing of all M on one machine.
    """
    file = plan.measured / TIMES
    times = rows.read(file, ("heads", "round", column, *MACHINE))
    if len({tuple(row[name] for name in MACHINE) for row in times}) > 1:
        raise ValueError(f"{file} holds timings of two machines or programs; leave one out")
    found = {(row["heads"], row["round"]): float(row[column]) for row in times}
    rounds = {row["round"] for row in times}
    heads = sorted({1, *(int(row["heads"]) for row in times)})
    if len(found) != len(times) or len(found) != len(heads) * len(rounds):
        raise ValueError(f"{file} has not one time of every M in every round; leave others out")
    return {m: np.array([found[str(m), r] / found["1", r] for r in sorted(rounds)]) for m in heads}


def section(plan: Plan) -> str:
    """Median times, and their ratios to M = 1."""
    if not (plan.measured / TIMES).exists():
        return "Missing: nothing has been timed."
    per_step, per_update = (ratios(plan, c) for c in ("seconds_per_step", "seconds_per_update"))
    times = rows.read(plan.measured / TIMES)
    first = times[0]
    lines = []
    for m in per_step:
        of_m = [row for row in times if row["heads"] == str(m)]
        cells = []
        for column, ratio in (("seconds_per_step", per_step), ("seconds_per_update", per_update)):
            cells.append(f"{1e6 * np.median([float(row[column]) for row in of_m]):.0f}")
            cells.append(f"{statistics.student(ratio[m]):.2f}")
        lines.append([str(m), *cells])
    header = ("M", "µs a step", "over M = 1", "µs an update", "over M = 1")
    return Table(header, lines).markdown() + (
        f"\n\nHopper, {plan.base.environments} environments, MuJoCo's C engine; threads of XLA: "
        f"{first['threads']}; cores: {first['cores']}; load before it: {first['load']}; "
        f"{first['versions']}; {first['date']}. A step is one environment step with the updates it "
        f"earns ({plan.base.updates_per_step:g} each); times are medians of {len(per_step[1])} "
        "interleaved rounds, ratios taken within each round, with Student's 95 % interval."
    )
