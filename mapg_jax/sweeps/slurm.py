"""Workers as jobs of Slurm by submitit: one a group, saved and queued again when preempted."""

import os
import pathlib
import subprocess
from collections.abc import Sequence
from typing import Any

import submitit
from submitit.core.utils import FailedJobError, UncompletedJobError
from submitit.slurm.slurm import SlurmInfoWatcher

from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.launchers import Share
from mapg_jax.sweeps.task import Task, dismiss, report

CLUSTER = "cluster"
"""The option that says whose jobs: slurm, or local for processes of this machine."""
POLL_SECONDS = 30
"""How often Slurm is asked what became of jobs that have no result yet."""
SLURMS_OWN = "slurm_"
"""Before the name of an option that submitit hands to Slurm as it is."""
NO_LIMIT = 10**9
"""Of time limits that a job may reach: at each it saves and is queued again."""
WHOLE_NUMBERS = {"timeout_min": 1, "cpus_per_task": 1, "gpus_per_node": 0, "signal_delay_s": 0}
"""Options that are one, and the least of each."""
SIGNAL_DELAY = 90
"""Seconds before its end at which submitit has a job told, unless `signal_delay_s` says else."""
EARLY = 60
"""Seconds by which Slurm may do that earlier: one that it tells before it minds signals dies."""
USUAL: launchers.Options = {"timeout_min": 24 * 60, "cpus_per_task": 1, "name": "mapg"}


class Launcher:
    """Submits jobs."""

    here = False

    def __init__(self, options: launchers.Options):
        """Parameters of a job, as submitit names them: timeout_min, slurm_partition, …"""
        self._options = {**USUAL, **options}
        self._cluster = self._options.pop(CLUSTER, "slurm")
        _refuse_wrong_numbers(self._options)
        # What is wrong is refused before anything is written.
        executor = self._executor(pathlib.Path())
        if self._cluster == "slurm":
            _refuse_what_slurm_would(executor)
        self._queue = Queue(delay_s=POLL_SECONDS)

    def shares(self, workers: int) -> list[Share]:
        return [Share()] * workers

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> "Job":
        executor = self._executor(log.parent.parent / "slurm")  # a run folder holds no links
        try:
            job = executor.submit(Task(command, log, launchers.environment()))
        except FailedJobError as error:
            raise OSError(f"Slurm takes no job: {str(error).splitlines()[0]}") from None
        if isinstance(job, submitit.SlurmJob):
            job.watcher = self._queue
        return Job(job, log)

    def _executor(self, folder: pathlib.Path) -> submitit.AutoExecutor:
        try:
            executor = submitit.AutoExecutor(
                folder, cluster=self._cluster, slurm_max_num_timeout=NO_LIMIT
            )
            executor.update_parameters(**self._options)
        except (AssertionError, NameError, RuntimeError, TypeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"Slurm cannot be used as asked: {reason}") from None
        return executor


def _refuse_wrong_numbers(options: launchers.Options) -> None:
    """Raises ValueError if a number of a job is none, or is that of several tasks.

    The same holds of what submitit hands to Slurm as it is, `slurm_` before its name.
    """
    options = {name.removeprefix(SLURMS_OWN): value for name, value in options.items()}
    if ":" in str(options.get("gpus_per_node")):
        del options["gpus_per_node"]  # by their kind, a100:1, which Slurm knows and we do not
    for name, least in WHOLE_NUMBERS.items():
        value = options.get(name, least)
        if type(value) is not int or value < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    minutes, told = options["timeout_min"], options.get("signal_delay_s", SIGNAL_DELAY) + EARLY
    if 60 * minutes <= told:
        raise ValueError(
            f"timeout_min={minutes} leaves a job no time: Slurm may tell it {told} s before its "
            f"end (signal_delay_s, and a minute); give at least {told // 60 + 1}"
        )
    memory = options.get("mem_gb", 1)
    if type(memory) not in (int, float) or not 0 < memory < float("inf"):
        raise ValueError(f"mem_gb must be a number above 0, got {memory!r}")
    for name, instead in (("time", "timeout_min, in minutes"), ("mem", "mem_gb")):
        if name in options:
            raise ValueError(f"leave {SLURMS_OWN}{name} out; give {instead}")
    for name in ("nodes", "tasks_per_node", "ntasks_per_node"):
        if options.get(name, 1) != 1:
            raise ValueError(f"a group is one task on one node; leave {name} out")


def _refuse_what_slurm_would(executor: submitit.AutoExecutor) -> None:
    """Raises ValueError if Slurm does not answer, or would take no such job."""
    slurm: Any = executor._executor
    script = slurm._make_submission_file_text("true", "")
    try:
        asked = subprocess.run(
            ["sbatch", "--test-only"], input=script, capture_output=True, text=True, timeout=60
        )
        said = asked.stderr if asked.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        said = str(error)
    if said:
        raise ValueError(f"Slurm takes no such job: {said.strip().splitlines()[-1]}")


class Queue(SlurmInfoWatcher):
    """What Slurm has pending or running, by squeue; sacct has nothing where none keeps accounts."""

    def _make_command(self) -> list[str]:
        return ["squeue", "--noheader", f"--user={os.getuid()}", "--format=%A %T"]

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        text = string if isinstance(string, str) else string.decode()
        listed = dict(line.split() for line in text.splitlines())
        return {job: {"State": _state(listed.get(job))} for job in self._registered}


def _state(listed: str | None) -> str:
    """Of a job, as submitit knows them; one that is not listed has ended, somehow."""
    if listed is None:
        return "COMPLETED"
    return "PENDING" if listed == "PENDING" else "RUNNING"


class Job:
    """A job, perhaps in its queue."""

    def __init__(self, job: submitit.Job, log: pathlib.Path):
        self._job, self._log = job, log

    def running(self) -> bool:
        return not self._job.done(force_check=False)

    def stop(self) -> None:
        dismiss(self._log)
        if self._job.state == "PENDING":  # or was, a moment ago
            subprocess.run(["scancel", "--state=PENDING", self._job.job_id], check=False)

    def wait(self) -> int:
        self._job.wait()
        if not self._job.paths.stdout.exists():  # it was cancelled before it began
            return 1
        try:
            return int(self._job.result())
        except (FailedJobError, UncompletedJobError) as error:
            report(self._log, error)
            return 1
