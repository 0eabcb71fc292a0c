"""The host's side of a run: between chunks it logs, evaluates, checkpoints and obeys."""

import contextlib
import logging
import math
import pathlib
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mapg_jax.runs import hosts
from mapg_jax.runs.checkpoints import DamagedError
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.host import precise, this_host
from mapg_jax.runs.locking import Lock
from mapg_jax.runs.member import Member
from mapg_jax.runs.metrics import MetricsFile, Row
from mapg_jax.runs.progress import Progress
from mapg_jax.runs.signals import ABANDONED, StoppedError
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.trainer import Trainer

LOG = logging.getLogger(__name__)
CHUNK_SECONDS = 1.0  # how often the host looks up


class Event(NamedTuple):
    """What a callback is told."""

    kind: Literal["evaluation", "checkpoint"]
    path: pathlib.Path  # of the run folder
    env_steps: int
    row: Row  # of metrics.csv, at an evaluation; docs/metrics.md


Callback = Callable[[Event], object]
"""Called at every evaluation and checkpoint; one that returns True stops the run."""


class Run:
    """A run under way on the host, or several in lockstep; it counts in the trainer's turns."""

    def __init__(
        self,
        program: Lockstep,
        folders: Sequence[RunFolder],
        locks: Sequence[Lock] = (),
        idle: Collection[int] = (),
    ):
        """A run that has not begun.

        Args:
          program: of its configurations.
          folders: of its members.
          locks: of those folders, where they are held already.
          idle: members that are done or lost, and only keep their place in the program, without
            which the others would be those of another program and differ in their last bits.
        """
        config = folders[0].config
        self.program, self.config = program, config
        self.members = [Member(folder) for folder in folders]
        self._locks, self._idle = locks, frozenset(idle)
        self.turn = 0
        self.last_turn = math.ceil(config.steps / self.trainer.steps_per_turn)
        self._turns_per_evaluation = max(
            1, round(config.evaluate_every / self.trainer.steps_per_turn)
        )
        self._state: Any = None

    @property
    def trainer(self) -> Trainer:
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
        """Takes up the newest checkpoint that all members have; without one, nothing is done yet.

        Raises:
          ValueError: if it is of another configuration, or not all hosts see it.
        """
        while (step := self._newest_of_all()) is not None:
            self.turn = step // self.trainer.steps_per_turn
            working = self._healthy()
            if self.finished and not all(
                self.members[k].checkpoints.can_go_on(step) for k in working
            ):
                return  # nothing is left to do with the state
            try:
                self._state = self.program.join((k, self._loaded(k, step)) for k in working)
            except DamagedError:  # it has been set aside
                continue
            return
        self.turn = 0

    def _newest_of_all(self) -> int | None:
        common = [set(self.members[k].checkpoints.steps()) for k in self._healthy()]
        newest = max(set.intersection(*common), default=-1)
        most, least = map(int, hosts.largest([newest, -newest]))
        if most != -least:  # storage may show a host a new checkpoint late
            raise ValueError(
                f"{self.members[0].folder.path}: the newest checkpoint that each host sees is not "
                f"the same (here {newest:,}); resume once the storage shows all of them one"
            )
        return None if newest < 0 else newest

    def _loaded(self, k: int, step: int) -> Any:
        """The state of a member alone."""
        shapes = hosts.parted(self.program.plain_shapes(k), self.trainer.layout)
        state = self.members[k].load(shapes, step)
        if self.trainer.env.saved:
            return state
        LOG.warning("%s: the episodes under way begin anew", self.members[k].folder.path)
        return self.trainer.restarted(state)

    def go(
        self,
        callbacks: Sequence[Callback] = (),
        *,
        signals: Sequence[int] = (),
        progress: bool = False,
    ) -> None:
        """Runs to the last turn; a member that diverges does not stop the others.

        Args:
          callbacks: called at every evaluation and checkpoint; one that returns True stops the
            run, which is saved.
          signals: what `signals.caught_signals` has caught; the first of them stops the run.
          progress: whether to show it on standard error.

        Raises:
          BlockingIOError: if another process trains it.
          DivergedError: at the first metric or parameter that is not finite, if no run is left.
          StoppedError: on a signal, once the state is saved.
        """
        with contextlib.ExitStack() as stack:
            host = this_host(self.trainer.env.backend, self.trainer.layout.devices)
            stack.enter_context(precise())
            ours = hosts.is_first()  # who writes what is small
            working = [self.members[k] for k in self._healthy() if ours]
            for lock in self._locks or [member.folder.lock() for member in working]:
                stack.enter_context(lock)
            for member in working:
                member.folder.write_host(host)
                stack.callback(member.checkpoints.wait)  # whatever ends the run
            metrics = {
                member.folder.path: stack.enter_context(
                    contextlib.closing(member.metrics_file(self.env_steps))
                )
                for member in working
            }
            bar = stack.enter_context(
                Progress(self.last_turn * self.trainer.steps_per_turn, progress and ours)
            )
            command = f"mapg resume {self.members[0].folder.path}"
            self._loop(_Watch(metrics, bar, callbacks, signals, command))

    def _loop(self, watch: "_Watch") -> None:
        state, self._state = self._state, None  # its buffers are donated to the first chunk
        if state is None:
            state = self.program.init()
        state = hosts.placed(state, self.trainer.layout)
        run = self._compiled(state, watch)
        stop = False
        while not self.finished and not stop:
            done = self.turn % self._turns_per_evaluation
            due = min(self.turn + self._turns_per_evaluation - done, self.last_turn)
            turns = int(hosts.of_first(min(watch.chunk.turns_ahead(), due - self.turn)))
            begun = time.monotonic()
            state = run(state, turns)
            self.turn += turns
            self._check_finite(state)
            watch.advanced(self, state, turns, time.monotonic() - begun)
            if self.turn == due:
                self._evaluate(state, watch)
                totals = jax.tree.map(jnp.zeros_like, state.totals)
                state = hosts.placed(state.replace(totals=totals), self.trainer.layout)
            stop = watch.agreed_to_stop()
            due_to_save = hosts.of_first(watch.save_due(self.config.checkpoint_seconds))
            if self.finished or stop or due_to_save:
                self._save(state, watch, wait=self.finished or stop)
                stop = watch.agreed_to_stop()  # whoever is told of a checkpoint may ask for it
        watch.obey()

    def _compiled(self, state: Any, watch: "_Watch") -> Any:
        """The program; a signal meanwhile stops at once, since nothing has been done yet.

        Raises:
          StoppedError: on a signal.
        """
        lowered = self.program.jitted_run.lower(state, 0)
        done: list[Any] = []
        # Python sees no signal while it is inside of XLA, so that is left to another thread.
        thread = threading.Thread(target=lambda: done.append(_tried(lowered.compile)), daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(0.1)
            if watch.signals:
                thread.name = ABANDONED
                raise watch.stopped(watch.signals[0])
        (result,) = done
        if isinstance(result, Exception):
            raise result
        return result

    def _evaluate(self, state: Any, watch: "_Watch") -> None:
        """A row of metrics.csv for each healthy run."""
        rate = watch.interval.rate()
        rows = self._rows(state, rate, watch.seconds())
        for k, row in rows.items():
            path = self.members[k].folder.path
            if hosts.is_first():
                watch.metrics[path].write(row)
                watch.call(Event("evaluation", path, self.env_steps, row))
        watch.evaluated(next(iter(rows.values())), (self.last_turn - self.turn) / rate)

    def _save(self, state: Any, watch: "_Watch", wait: bool) -> None:
        """A checkpoint of each healthy run, written beside the next chunks unless it is waited for.

        Whoever is told of it may read it.
        """
        members = {k: self.members[k] for k in self._healthy()}
        for k, member in members.items():
            member.begin_to_save(self.program.plain_state(state, k), watch.seconds())
        if wait or watch.callbacks:
            for member in members.values():
                member.checkpoints.wait()
                if hosts.is_first():
                    watch.call(Event("checkpoint", member.folder.path, self.env_steps, {}))
        hosts.wait("saved")
        watch.saved = time.monotonic()

    def _healthy(self) -> list[int]:
        """The members that are neither idle nor lost."""
        failed = {k for k, member in enumerate(self.members) if member.failure}
        return [k for k in range(len(self.members)) if k not in self._idle | failed]

    def _rows(self, state: Any, rate: float, seconds: float) -> dict[int, dict]:
        keys = self.program.evaluation_keys(self.env_steps)
        agent = hosts.fetched(state.agent, self.trainer.layout)
        played = jax.device_get(self.program.jitted_evaluation(agent, keys))
        counters = jax.device_get((state.env_steps, state.agent.learner.updates, state.totals))
        rows = {}
        for k in self._healthy():
            of_run, episodes = self.program.of_run((counters, played), k)
            rows[k] = self.members[k].row(self.trainer, of_run, episodes, rate, seconds)
        return rows

    def _check_finite(self, state: Any) -> None:
        fetched = jax.device_get((state.agent.learner, state.diverged_at, state.totals))
        for k in self._healthy():
            member = self.members[k]
            learner, diverged_at, totals = self.program.of_run(fetched, k)
            member.check_finite(learner, int(diverged_at), totals, self.env_steps)
            if member.failure:
                member.save_for_inspection(self.program.plain_state(state, k))
        if not self._healthy():
            raise next(member.failure for member in self.members if member.failure)


class _Watch:
    """What the host keeps an eye on while a run goes: time, files, callbacks and signals."""

    def __init__(
        self,
        metrics: Mapping[pathlib.Path, MetricsFile],
        bar: Progress,
        callbacks: Sequence[Callback],
        signals: Sequence[int],
        command: str,
    ):
        self.metrics, self._bar, self._command = metrics, bar, command
        self.callbacks, self.signals = callbacks, signals
        self._started = self.saved = time.monotonic()
        self._learning = self._stopped = False
        self._agreed = 0
        self.chunk, self.interval = Pace(), Pace()

    def agreed_to_stop(self) -> bool:
        """Whether a signal or a callback asks for the end, on any host."""
        # Asked once: a signal that comes meanwhile, to one host alone, is for the next time.
        ours = [self.signals[0] if self.signals else 0, int(self._stopped)]
        self._agreed, stopped = map(int, hosts.largest(ours))
        return bool(self._agreed or stopped)

    def obey(self) -> None:
        """Raises StoppedError if a signal was agreed on."""
        if self._agreed:
            raise self.stopped(self._agreed)

    def stopped(self, number: int) -> StoppedError:
        """By that signal."""
        return StoppedError(number, self._command)

    def seconds(self) -> float:
        """Of this process."""
        return time.monotonic() - self._started

    def save_due(self, every: float) -> bool:
        """Whether the last checkpoint is so many seconds old."""
        return time.monotonic() - self.saved >= every

    def advanced(self, run: Run, state: Any, turns: int, seconds: float) -> None:
        """After a chunk."""
        for pace in (self.chunk, self.interval):
            pace.add(turns, seconds)
        self._bar.advance(run.env_steps, self.chunk.rate() * run.trainer.steps_per_turn)
        if not self._learning and (state.agent.learner.updates > 0).any():
            self._learning = True
            self._bar.learning()

    def evaluated(self, row: Row, seconds_left: float) -> None:
        """After an evaluation; the pace until the next one begins anew."""
        self._bar.evaluated(row, seconds_left)
        self.interval = Pace()

    def call(self, event: Event) -> None:
        """Tells every callback."""
        answers = [callback(event) for callback in self.callbacks]
        self._stopped |= any(isinstance(x, bool | np.bool_) and bool(x) for x in answers)


def _tried(function: Callable[[], Any]) -> Any:
    """Its value, or what it raised."""
    try:
        return function()
    except Exception as error:
        return error


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
