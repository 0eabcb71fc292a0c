"""A sweep: many runs, a few at a time, each in its own folder; what is finished stays finished."""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.runs.signals import StoppedError, caught_signals
from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.groups import (
    Group,
    Grouping,
    Job,
    accelerators,
    at_work,
    checked_workers,
    groups,
    parts,
    refuse_a_full_disk,
    refuse_unshared,
    with_work_for,
    workers_that_fit,
)
from mapg_jax.sweeps.launchers import Launcher
from mapg_jax.sweeps.pool import Worker
from mapg_jax.sweeps.table import SweepTable
from mapg_jax.training.config import Config

POLL_SECONDS = 0.5


class Schedule(NamedTuple):
    """What a sweep will do."""

    groups: list[Group]
    workers: int
    keep_replay: bool
    launcher: Launcher


def make_schedule(
    runs: Sequence[tuple[Config, pathlib.Path]],
    *,
    workers: int | None = None,
    group: Grouping = "auto",
    keep_replay: bool = False,
    launcher: Launcher | None = None,
) -> Schedule:
    """What is missing, in groups, and how many processes will do it.

    Args:
      runs: configurations and folders.
      workers: processes side by side; by default as many as cores and memory allow.
      group: how many runs share a program, see `grouping.Grouping`.
      keep_replay: whether finished runs can be trained further.
      launcher: starts the workers; by default on this machine.

    Raises:
      ValueError: if a folder holds another run, memory or disk do not suffice, or an algorithm does
        not learn in so many shards.
    """
    launcher = launcher or launchers.launcher("local")
    abreast = checked_workers(workers) or (accelerators() if launcher.here else 1)
    cut = groups(unique_jobs(runs), group, abreast)
    waiting = [part for whole in cut for part in _left_of(whole)]
    refuse_unshared(waiting)
    if launcher.here:
        count = workers_that_fit(waiting, workers)
    else:  # the machines that they run on know what fits
        count = max(1, min(workers or len(waiting), len(waiting)))
    refuse_a_full_disk(waiting, count, keep_replay)
    return Schedule(waiting, count, keep_replay, launcher)


def carry_out(
    schedule: Schedule,
    on_finished: Callable[[RunFolder], None] | None = None,
    progress: bool = True,
) -> list[str]:
    """Starts what is missing and goes on with what was cut off, in order.

    Args:
      schedule: what is missing.
      on_finished: called with the folder of each run that finishes, in this process.
      progress: whether to show it on standard error.

    Returns:
      A line for each run that failed; none of them stops the others.

    Raises:
      StoppedError: on SIGINT or SIGTERM, once all workers have saved their state.
    """
    pool = _Pool(schedule)
    with (
        caught_signals() as signals,
        SweepTable(list(map(at_work, schedule.groups)), schedule.workers, progress) as table,
    ):
        try:
            while pool.busy() and not signals:
                for worker in pool.start():
                    table.started(worker.folders)
                for worker in pool.ended():
                    failures = worker.failures()
                    for folder in worker.folders:
                        failure = failures.get(folder.path)
                        if failure and worker.crashed() and len(worker.group) > 1:
                            pool.try_again(worker.group, folder.path)
                            table.retried(folder, failure)
                            continue
                        table.ended(folder, failure)
                        if not failure and on_finished:
                            on_finished(folder)
                table.update()
                time.sleep(POLL_SECONDS)
        finally:
            pool.stop()
    if signals:
        raise StoppedError(signals[0], "the same command")
    return table.failures


def run_all(
    runs: Sequence[tuple[Config, pathlib.Path]],
    *,
    workers: int | None = None,
    group: Grouping = "auto",
    keep_replay: bool = False,
    on_finished: Callable[[RunFolder], None] | None = None,
    progress: bool = True,
) -> list[str]:
    """Carries out the schedule of some runs; see `make_schedule` and `carry_out`."""
    schedule = make_schedule(runs, workers=workers, group=group, keep_replay=keep_replay)
    return carry_out(schedule, on_finished, progress)


class _Pool:
    """Groups that wait, and the workers that do them."""

    def __init__(self, schedule: Schedule):
        self._waiting = list(schedule.groups)
        self._launcher = schedule.launcher
        self._free = self._launcher.shares(schedule.workers)
        self._workers: list[Worker] = []
        self._keep_replay = schedule.keep_replay
        self._tried_again: set[Group] = set()

    def busy(self) -> bool:
        return bool(self._waiting or self._workers)

    def start(self) -> list[Worker]:
        """As many as there are free shares of the cores."""
        begun = []
        while self._waiting and self._free:
            group, share = self._waiting.pop(0), self._free.pop(0)
            begun.append(Worker(group, share, self._keep_replay, self._launcher))
            self._workers.append(begun[-1])  # at once: the next may be refused, and all are stopped
        return begun

    def ended(self) -> list[Worker]:
        """Those that have ended since; their shares are free."""
        ended = [worker for worker in self._workers if not worker.running()]
        for worker in ended:
            worker.wait()
            self._workers.remove(worker)
            self._free.append(worker.share)
        return ended

    def try_again(self, group: Group, path: pathlib.Path) -> None:
        """One run of a group that crashed, since another may be at fault.

        The others are idle first, which leaves its numbers as they are; and if that crashes too,
        they are left out, which can change last bits. (A group in which it was alone at work, the
        others being done, crashed for the first time, too.)
        """
        alone = with_work_for(group, {path})
        if alone in self._tried_again:
            alone = at_work(alone)
        self._tried_again.add(alone)
        self._waiting.append(alone)

    def stop(self) -> None:
        """All workers save and end."""
        for worker in self._workers:
            worker.stop()
        for worker in self._workers:
            worker.wait()


def _left_of(group: Group) -> list[Group]:
    """The parts of a group that are not finished, for the same program: that is exact."""
    left = {job.path for job in group if not _finished(job)}
    return parts(with_work_for(group, left)) if left else []


def unique_jobs(runs: Sequence[tuple[Config, pathlib.Path]]) -> list[Job]:
    """The runs, each folder once.

    Raises:
      ValueError: if one folder is meant for two runs, or holds another run.
    """
    jobs: dict[pathlib.Path, Job] = {}
    for config, path in runs:
        job = jobs.setdefault(pathlib.Path(path), Job(config, pathlib.Path(path)))
        if job.config != config:
            raise ValueError(f"two runs are to be written into {path}")
    return [job if is_blank(job.path) else _begun(job) for job in jobs.values()]


def _begun(job: Job) -> Job:
    """The job as its folder has it: a run of it can have been given more steps since."""
    there = RunFolder.open(job.path).config
    longer = dataclasses.replace(job.config, steps=max(there.steps, job.config.steps))
    if there != longer:
        raise ValueError(f"{job.path} holds a run of another configuration")
    return Job(there, job.path)


def _finished(job: Job) -> bool:
    return not is_blank(job.path) and is_finished(RunFolder.open(job.path))
