"""The host's side of a run: between chunks it logs, evaluates, checkpoints and obeys signals."""

import contextlib
import dataclasses
import functools
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil

from mapg_jax.checkpointing import Checkpoints
from mapg_jax.config import Config
from mapg_jax.evaluation import play, summarize
from mapg_jax.loop import Loop, run_keys, state_bytes
from mapg_jax.run_folder import RunFolder
from mapg_jax.tracking import MetricsFile, Progress, cut_metrics
from mapg_jax.training import make_trainer

CHUNK_SECONDS = 1.0  # how often the host looks up


class DivergedError(ArithmeticError):
    """A loss or a parameter is no longer finite."""


class StoppedError(Exception):
    """A signal asked the run to stop; its state is saved."""

    def __init__(self, number: int, path: os.PathLike):
        super().__init__(
            f"stopped by {signal.Signals(number).name}; go on with: mapg resume {path}"
        )
        self.number = number


def prepare(config: Config) -> Loop:
    """The run's static part, refused before anything is allocated or compiled if it cannot run.

    Raises:
      ValueError: if the environment cannot be made or the buffers do not fit the memory.
    """
    trainer = make_trainer(config)
    needed, available = state_bytes(trainer), available_bytes()
    if needed > available:
        what, remedy = "", "fewer --environments"
        if config.algorithm == "mapg":
            what = f", of which the replay of {config.replay_size:,} transitions is the most,"
            remedy = "a smaller --replay-size"
        raise ValueError(
            f"the run needs {needed / 1e9:.1f} GB{what} but {available / 1e9:.1f} GB are available; "
            f"choose {remedy}"
        )
    return trainer


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
      out: the run folder, which must not exist; by default the next free number under `runs/`.

    Raises:
      ValueError: if the run cannot be made, before anything is written.
    """
    trainer = prepare(config)
    return Run(trainer, RunFolder.create(out, config))


def resume(path: str | os.PathLike, steps: int | None = None) -> "Run":
    """A run from its newest checkpoint, or from the beginning where there is none.

    Args:
      path: the run folder.
      steps: a new total of environment steps; by default that of the run.

    Raises:
      ValueError: if the folder holds no run, the run cannot be made or its checkpoint is damaged.
    """
    folder = RunFolder.open(path)
    if steps is not None:
        folder = RunFolder(folder.path, dataclasses.replace(folder.config, steps=steps))
    run = Run(prepare(folder.config), folder)
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
    """A run under way on the host; it counts in the trainer's turns."""

    def __init__(self, trainer: Loop, folder: RunFolder):
        config = folder.config
        self.trainer, self.folder, self.config = trainer, folder, config
        self.turn = 0
        self.last_turn = math.ceil(config.steps / trainer.steps_per_turn)
        self._turns_per_evaluation = max(1, round(config.evaluate_every / trainer.steps_per_turn))
        self._state: Any = None
        self._seconds_before = 0.0
        self._checkpoints = Checkpoints(folder.checkpoints, config.checkpoints_kept)

    def restore(self) -> None:
        """Takes up the newest checkpoint, if there is one."""
        if self._checkpoints.newest() is None:
            return
        self._state, host = self._checkpoints.load(self.trainer.shapes)
        self.turn = int(self._state.env_steps) // self.trainer.steps_per_turn
        self._seconds_before = host["seconds"]

    @property
    def env_steps(self) -> int:
        """Environment steps taken."""
        return self.turn * self.trainer.steps_per_turn

    @property
    def finished(self) -> bool:
        return self.turn >= self.last_turn

    def go(self, progress: bool = False) -> None:
        """Runs to the last turn.

        Args:
          progress: whether to show it on standard error.

        Raises:
          DivergedError: at the first loss or parameter that is not finite.
          StoppedError: on SIGINT or SIGTERM, once the state is saved.
        """
        cut_metrics(self.folder.metrics, self.env_steps)
        self.folder.evaluation.unlink(missing_ok=True)  # it will be of an earlier policy
        with (
            caught_signals() as signals,
            contextlib.closing(MetricsFile(self.folder.metrics, self.env_steps)) as metrics,
            Progress(self.last_turn * self.trainer.steps_per_turn, progress) as bar,
        ):
            self._loop(signals, metrics, bar)

    def _loop(self, signals: list[int], metrics: MetricsFile, bar: Progress) -> None:
        started = saved = time.monotonic()
        state, self._state = self._state, None  # its buffers are donated to the first chunk
        if state is None:
            state = self.trainer.jitted_init(self.config.seed)
        run = self.trainer.jitted_run.lower(state, 0).compile()
        evaluate = self._jitted_evaluation()
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
            if not learning and state.agent.learner.updates > 0:
                learning = True
                bar.learning()

            if self.turn == stop:
                seconds = self._seconds_before + time.monotonic() - started
                row = self._row(state, evaluate, interval.rate(), seconds)
                metrics.write(row)
                bar.evaluated(row, (self.last_turn - self.turn) / interval.rate())
                totals = jax.tree.map(jnp.zeros_like, state.totals)
                state, interval = state.replace(totals=totals), Pace()
            over = time.monotonic() - saved >= self.config.checkpoint_seconds
            if over or signals or self.finished:
                seconds = self._seconds_before + time.monotonic() - started
                self._checkpoints.save(state, {"seconds": seconds})
                saved = time.monotonic()
            if signals:
                raise StoppedError(signals[0], self.folder.path)

    def _jitted_evaluation(self):
        return jax.jit(
            functools.partial(
                play,
                self.trainer.env.env,
                self.trainer.agent,
                episodes=self.config.evaluation_episodes,
                time_limit=self.trainer.env.time_limit,
                select="uniform",
            )
        )

    def _row(self, state: Any, evaluate, turns_per_second: float, seconds: float) -> dict:
        """One row of metrics.csv; docs/metrics.md defines the columns."""
        env_steps = int(state.env_steps)
        key = jax.random.fold_in(run_keys(self.config.seed).evaluation, env_steps)
        played = evaluate(state.agent, key)
        summary = summarize(played.returns)
        totals = jax.tree.map(float, state.totals)
        updates, episodes = totals.updates or math.nan, totals.episodes or math.nan
        return {
            "env_steps": env_steps,
            "updates": int(state.agent.learner.updates),
            "return_mean": summary.mean,
            "return_std": summary.std,
            "episodes": summary.episodes,
            "episode_length": float(played.lengths.mean()),
            "training_return": totals.episode_return / episodes,
            "training_episode_length": totals.episode_length / episodes,
            "training_episodes": int(totals.episodes),
            **{k: v / updates for k, v in totals.update_metrics._asdict().items()},
            **{k: float(v) for k, v in played.heads._asdict().items()},
            "steps_per_second": turns_per_second * self.trainer.steps_per_turn,
            "updates_per_second": turns_per_second
            * float(self.trainer.updates_ratio * self.trainer.steps_per_turn),
            "seconds": seconds,
        }

    def _check_finite(self, state: Any) -> None:
        at = int(state.diverged_at)
        if at < 0 and not all(np.isfinite(x).all() for x in jax.tree.leaves(state.agent.learner)):
            at = int(state.env_steps)
        if at >= 0:
            newest = self._checkpoints.newest()
            kept = f"the checkpoint at step {newest:,} stays" if newest else "no checkpoint was due"
            raise DivergedError(f"a loss or parameter is no longer finite at step {at:,}; {kept}")


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


@contextlib.contextmanager
def caught_signals() -> Iterator[list[int]]:
    """SIGINT and SIGTERM in a list instead of an exception; a second one acts as usual.

    One that is ignored, as SIGINT is in a shell's background jobs, stays ignored.
    """
    caught: list[int] = []
    previous = {}

    def handle(number, _frame):
        caught.append(number)
        signal.signal(number, previous[number])

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, handle)
    try:
        yield caught
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
