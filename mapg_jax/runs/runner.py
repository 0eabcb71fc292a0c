"""The host's side of a run: between chunks it logs, evaluates, checkpoints and obeys signals."""

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import psutil

from mapg_jax.training.config import Config
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.loop import Loop
from mapg_jax.runs.member import Member
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.signals import StoppedError, caught_signals
from mapg_jax.runs.metrics import MetricsFile, Progress

CHUNK_SECONDS = 1.0  # how often the host looks up


def prepare(*configs: Config) -> Lockstep:
    """The static part of a run, or of several in lockstep, refused before anything is compiled.

    Raises:
      ValueError: if the environment cannot be made or the buffers do not fit the memory.
    """
    program = Lockstep(configs)
    (replay_size,) = {config.replay_size for config in configs}
    needed, available = program.bytes, available_bytes()
    if needed > available:
        together = f"{len(configs)} runs in lockstep need" if len(configs) > 1 else "the run needs"
        what, remedy = "", "fewer --environments"
        if program.trainer.config.algorithm == "mapg":
            what = f", of which the replay of {replay_size:,} transitions is the most,"
            remedy = "a smaller --replay-size"
        raise ValueError(
            f"{together} {needed / 1e9:.1f} GB{what} but {available / 1e9:.1f} GB are available; "
            f"choose {remedy}"
        )
    return program


def available_bytes() -> int:
    """Memory free for the training state: of the accelerator, or of this machine."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return psutil.virtual_memory().available
    stats = device.memory_stats() or {}
    return stats.get("bytes_limit", 2**63) - stats.get("bytes_in_use", 0)


def start(config: Config, out: str | os.PathLike | None = None) -> "Run":
    """A new run in a new folder, nothing compiled yet.

    Args:
      config: of the run.
      out: the run folder, which must not exist or be empty; by default the next free number under
        `runs/`.

    Raises:
      ValueError: if the run cannot be made, before anything is written.
    """
    program = prepare(config)
    return Run(program, [RunFolder.create(out, config)])


def resume(path: str | os.PathLike, steps: int | None = None) -> "Run":
    """A run from its newest checkpoint, or from the beginning where there is none.

    Args:
      path: the run folder.
      steps: a new total of environment steps; by default that of the run.

    Raises:
      ValueError: if the folder holds no run, the run cannot be made or its checkpoint is damaged.
      BlockingIOError: if another process trains it.
    """
    folder = RunFolder.open(path)
    folder.lock().close()  # refused before anything is changed
    if steps is not None:
        folder = RunFolder(folder.path, dataclasses.replace(folder.config, steps=steps))
    run = Run(prepare(folder.config), [folder])
    run.restore()
    if not run.finished:
        folder.write_config()
    return run


def train(config: Config, out: str | os.PathLike | None = None) -> RunFolder:
    """Trains from the first step to the last, and returns the run folder; see `start`, `Run.go`."""
    run = start(config, out)
    run.go()
    return run.folder


class Run:
    """A run under way on the host, or several in lockstep; it counts in the trainer's turns."""

    def __init__(self, program: Lockstep, folders: Sequence[RunFolder]):
        config = folders[0].config
        self.program, self.config = program, config
        self.members = [Member(folder) for folder in folders]
        self.turn = 0
        self.last_turn = math.ceil(config.steps / self.trainer.steps_per_turn)
        self._turns_per_evaluation = max(
            1, round(config.evaluate_every / self.trainer.steps_per_turn)
        )
        self._state: Any = None

    @property
    def trainer(self) -> Loop:
        return self.program.trainer

    @property
    def folder(self) -> RunFolder:
        """Of a run alone."""
        (member,) = self.members
        return member.folder

    @property
    def env_steps(self) -> int:
        """Environment steps taken."""
        return self.turn * self.trainer.steps_per_turn

    @property
    def finished(self) -> bool:
        return self.turn >= self.last_turn

    def restore(self) -> None:
        """Takes up the newest checkpoints, if there are any; all must be of one step."""
        (newest,) = {member.checkpoints.newest() for member in self.members}
        if newest is None:
            return
        self.turn = newest // self.trainer.steps_per_turn
        if self.finished and not all(m.checkpoints.can_go_on() for m in self.members):
            return  # nothing is left to do with the state
        shapes = self.program.plain_shapes
        self._state = self.program.join([m.load(shapes(k)) for k, m in enumerate(self.members)])

    def go(self, progress: bool = False) -> None:
        """Runs to the last turn; a member that diverges does not stop the others.

        Args:
          progress: whether to show it on standard error.

        Raises:
          BlockingIOError: if another process trains it.
          DivergedError: at the first loss or parameter that is not finite, if no run is left.
          StoppedError: on SIGINT or SIGTERM, once the state is saved.
        """
        with contextlib.ExitStack() as stack:
            for member in self.members:
                stack.enter_context(member.folder.lock())
            signals = stack.enter_context(caught_signals())
            metrics = [
                stack.enter_context(contextlib.closing(member.metrics_file(self.env_steps)))
                for member in self.members
            ]
            bar = stack.enter_context(
                Progress(self.last_turn * self.trainer.steps_per_turn, progress)
            )
            self._loop(signals, metrics, bar)

    def _loop(self, signals: list[int], metrics: Sequence[MetricsFile], bar: Progress) -> None:
        started = saved = time.monotonic()
        state, self._state = self._state, None  # its buffers are donated to the first chunk
        if state is None:
            state = self.program.init()
        run = self.program.jitted_run.lower(state, 0).compile()
        chunk, interval = Pace(), Pace()
        learning = False
        while not self.finished:
            done = self.turn % self._turns_per_evaluation
            stop = min(self.turn + self._turns_per_evaluation - done, self.last_turn)
            turns = min(chunk.turns_ahead(), stop - self.turn)
            begun = time.monotonic()
            state = run(state, turns)
            self.turn += turns
            self._check_finite(state)
            for pace in (chunk, interval):
                pace.add(turns, time.monotonic() - begun)
            bar.advance(self.env_steps, chunk.rate() * self.trainer.steps_per_turn)
            if not learning and (state.agent.learner.updates > 0).any():
                learning = True
                bar.learning()

            if self.turn == stop:
                rows = self._rows(state, interval.rate(), started)
                for k, row in rows.items():
                    metrics[k].write(row)
                first = next(iter(rows.values()))
                bar.evaluated(first, (self.last_turn - self.turn) / interval.rate())
                totals = jax.tree.map(jnp.zeros_like, state.totals)
                state, interval = state.replace(totals=totals), Pace()
            over = time.monotonic() - saved >= self.config.checkpoint_seconds
            if over or signals or self.finished:
                for k in self._healthy():
                    plain = self.program.plain_state(state, k)
                    self.members[k].save(plain, time.monotonic() - started)
                saved = time.monotonic()
            if signals:
                raise StoppedError(signals[0], f"mapg resume {self.members[0].folder.path}")

    def _healthy(self) -> list[int]:
        return [k for k, member in enumerate(self.members) if member.failure is None]

    def _rows(self, state: Any, rate: float, started: float) -> dict[int, dict]:
        """An evaluation: a row of metrics.csv for each healthy run."""
        keys = self.program.evaluation_keys(self.env_steps)
        played = jax.device_get(self.program.jitted_evaluation(state.agent, keys))
        counters = jax.device_get((state.env_steps, state.agent.learner.updates, state.totals))
        seconds = time.monotonic() - started
        rows = {}
        for k in self._healthy():
            of_run, episodes = self.program.of_run((counters, played), k)
            rows[k] = self.members[k].row(self.trainer, of_run, episodes, rate, seconds)
        return rows

    def _check_finite(self, state: Any) -> None:
        fetched = jax.device_get((state.agent.learner, state.diverged_at))
        for k in self._healthy():
            learner, diverged_at = self.program.of_run(fetched, k)
            self.members[k].check_finite(learner, int(diverged_at), self.env_steps)
        if not self._healthy():
            raise next(member.failure for member in self.members if member.failure)


class Pace:
    """Turns a second, and how many turns make the next chunk."""

    def __init__(self):
        self._turns, self._seconds, self._ahead = 0, 0.0, 16

    def add(self, turns: int, seconds: float) -> None:
        """Counts a chunk."""
        self._turns += turns
        self._seconds += seconds
        self._ahead = max(1, round(turns * min(4.0, CHUNK_SECONDS / seconds)))

    def turns_ahead(self) -> int:
        """Turns that should take a chunk's time, growing fourfold at most."""
        return self._ahead

    def rate(self) -> float:
        """Turns per second so far."""
        return self._turns / self._seconds
