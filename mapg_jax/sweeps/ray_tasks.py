"""Workers as tasks of Ray: one a group, tried again on another node when theirs is lost."""

import os
import pathlib
import time
from collections.abc import Sequence

import ray.exceptions  # pyright: ignore[reportMissingImports]

from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.launchers import Share
from mapg_jax.sweeps.task import GRACE_SECONDS, Task, dismiss, report

ADDRESS = "address"
"""The option that says which cluster: by default the one that Ray finds, or this machine."""
RETRIES = 20


class Launcher:
    """Starts tasks."""

    here = False

    def __init__(self, options: launchers.Options):
        """`address` of the cluster, and what `ray.remote` takes: num_cpus, num_gpus, …"""
        of_tasks = {"num_cpus": 1, "max_retries": RETRIES, **options}
        address = of_tasks.pop(ADDRESS, os.environ.get("RAY_ADDRESS"))
        try:  # a task whose node is lost is started again; it goes on from its run folders
            self._remote = ray.remote(**of_tasks)(_carry)
        except (TypeError, ValueError) as error:
            raise ValueError(f"Ray takes no such task: {str(error).splitlines()[0]}") from None
        if not ray.is_initialized():
            try:
                ray.init(address, log_to_driver=False, include_dashboard=False)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ValueError(f"Ray cannot be reached: {str(error).splitlines()[0]}") from None

    def shares(self, workers: int) -> list[Share]:
        return [Share()] * workers

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> "RayTask":
        task = Task(command, log, launchers.environment())
        return RayTask(self._remote.remote(task), task)


def _carry(task: Task) -> int:
    return task()


class RayTask:
    """A task, perhaps waiting for a node."""

    def __init__(self, reference, task: Task):
        self._reference, self._task = reference, task
        self._asked: float | None = None
        """The time at which it was to end, in seconds."""

    def running(self) -> bool:
        ready, _ = ray.wait([self._reference], timeout=0)
        return not ready

    def stop(self) -> None:
        dismiss(self._task.log)
        self._asked = self._asked or time.monotonic()

    def wait(self) -> int:
        """One that is asked to end and has not begun for want of a node never begins."""
        if self._asked:  # all are asked before one is waited for: together they have the time
            left = max(0.0, self._asked + GRACE_SECONDS - time.monotonic())
            ready, _ = ray.wait([self._reference], timeout=left)
            if not ready and not self._task.begun():
                ray.cancel(self._reference)
        try:
            return int(ray.get(self._reference))
        except ray.exceptions.TaskCancelledError:
            return 1
        except ray.exceptions.RayError as error:
            report(self._task.log, error)
            return 1
