"""Workers as tasks of Ray: one a group, tried again on another node when theirs is lost."""

import os
import pathlib
from collections.abc import Sequence

import ray  # pyright: ignore[reportMissingImports]

from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.launchers import Share
from mapg_jax.sweeps.task import Task, stop_file

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
        if not ray.is_initialized():
            try:
                ray.init(address, log_to_driver=False, include_dashboard=False)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ValueError(f"Ray cannot be reached: {str(error).splitlines()[0]}") from None
        # A task whose node is lost is started again; it goes on from its run folders.
        self._remote = ray.remote(**of_tasks)(_carry)

    def shares(self, workers: int) -> list[Share]:
        return [Share()] * workers

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> "RayTask":
        stop_file(log).unlink(missing_ok=True)
        return RayTask(self._remote.remote(Task(command, log, launchers.environment())), log)


def _carry(task: Task) -> int:
    return task()


class RayTask:
    """A task, perhaps waiting for a node."""

    def __init__(self, reference, log: pathlib.Path):
        self._reference, self._log = reference, log

    def running(self) -> bool:
        ready, _ = ray.wait([self._reference], timeout=0)
        return not ready

    def stop(self) -> None:
        stop_file(self._log).touch()
        ready, _ = ray.wait([self._reference], timeout=30)
        if not ready:  # it never began, or does not see the file
            ray.cancel(self._reference, force=True)

    def wait(self) -> int:
        try:
            return int(ray.get(self._reference))
        except ray.exceptions.RayError:
            return 1
        finally:
            stop_file(self._log).unlink(missing_ok=True)
