"""Workers as jobs of Slurm by submitit: one a group, saved and queued again when preempted."""

import pathlib
import subprocess
from collections.abc import Sequence

import submitit
from submitit.core.utils import FailedJobError, UncompletedJobError

from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.launchers import Share
from mapg_jax.sweeps.task import Task, dismiss

CLUSTER = "cluster"
"""The option that says whose jobs: slurm, or local for processes of this machine."""
USUAL: launchers.Options = {"timeout_min": 24 * 60, "cpus_per_task": 1, "name": "mapg"}


class Launcher:
    """Submits jobs."""

    here = False

    def __init__(self, options: launchers.Options):
        """Parameters of a job, as submitit names them: timeout_min, slurm_partition, …"""
        self._options = {**USUAL, **options}
        self._cluster = self._options.pop(CLUSTER, "slurm")
        # What is wrong is refused before anything is written.
        self._executor(pathlib.Path())
        if self._cluster == "slurm":
            _refuse_without_controller()

    def shares(self, workers: int) -> list[Share]:
        return [Share()] * workers

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> "Job":
        executor = self._executor(log.parent.parent / "slurm")  # a run folder holds no links
        try:
            job = executor.submit(Task(command, log, launchers.environment()))
        except FailedJobError as error:
            raise OSError(f"Slurm takes no job: {str(error).splitlines()[0]}") from None
        return Job(job, log)

    def _executor(self, folder: pathlib.Path) -> submitit.AutoExecutor:
        try:
            executor = submitit.AutoExecutor(folder, cluster=self._cluster)
            executor.update_parameters(**self._options)
        except (NameError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"Slurm cannot be used as asked: {reason}") from None
        return executor


def _refuse_without_controller() -> None:
    """Raises ValueError if Slurm does not answer."""
    try:
        asked = subprocess.run(["sinfo", "-h"], capture_output=True, text=True, timeout=60)
        said = asked.stderr if asked.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        said = str(error)
    if said:
        raise ValueError(f"Slurm does not answer here: {said.strip().splitlines()[-1]}")


class Job:
    """A job, perhaps in its queue."""

    def __init__(self, job: submitit.Job, log: pathlib.Path):
        self._job, self._log = job, log

    def running(self) -> bool:
        return not self._job.done(force_check=False)

    def stop(self) -> None:
        dismiss(self._log)
        if self._job.state in ("PENDING", "UNKNOWN"):
            self._job.cancel()

    def wait(self) -> int:
        try:
            return int(self._job.result())
        except (FailedJobError, UncompletedJobError):
            return 1
