"""Worker processes, each pinned to its share of the cores."""

import os
import pathlib
import subprocess
import sys
from collections.abc import Collection, Sequence

import jax

from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.sweeps.groups import Group, Job, at_work
from mapg_jax.sweeps.worker import failure_file
from mapg_jax.training import plugins

WORKER = "mapg_jax.sweeps.worker"

# The process of a sweep only asks a GPU for its size; its workers need the memory, and have it as
# the user says.
_NAME = "XLA_PYTHON_CLIENT_PREALLOCATE"
_PREALLOCATION = {_NAME: os.environ.get(_NAME, "true")}


def leave_the_memory_to_workers() -> None:
    """To be called before JAX first looks for a device."""
    os.environ[_NAME] = "false"


class Worker:
    """A process that does one group."""

    def __init__(self, group: Group, cores: Collection[int], keep_replay: bool):
        self.group, self.cores = group, cores
        self.folders = [_open(job) for job in at_work(group)]
        self._log = self.folders[0].path / "worker.log"
        flags = ["--keep-replay"] if keep_replay else []
        flags += [f"--idle={k}" for k, job in enumerate(group) if job.idle]
        folders = [str(job.path) for job in group]
        imports = [f"--import={module}" for module in plugins.loaded()]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                # -P: a folder `envs` in the working folder would be imported for ours.
                [sys.executable, "-P", "-m", WORKER, *flags, *imports, *folders],
                stdin=subprocess.PIPE,  # its end tells the worker that this process is gone
                stdout=log,
                stderr=subprocess.STDOUT,
                env=_environment(),
                start_new_session=True,  # Ctrl-C reaches us alone, and we stop the workers
            )
        if hasattr(os, "sched_setaffinity") and cores:
            os.sched_setaffinity(self._process.pid, cores)  # before it starts any thread

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        """Asks it to save and to end."""
        if self.running():
            self._process.terminate()

    def wait(self) -> None:
        """Until it has ended; from then on nothing of it is left."""
        self._process.wait()
        if self._process.stdin:
            self._process.stdin.close()

    def crashed(self) -> bool:
        """Whether it ended before it could say what became of its runs."""
        return self._process.returncode != 0

    def failures(self) -> dict[pathlib.Path, str]:
        """Why the runs that did not finish did not, once it has ended."""
        output = self._log.read_text(errors="replace").strip().splitlines()
        code = self._process.returncode
        ended = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
        reason = f"{ended}; last output: {output[-1]}" if output else ended
        reasons = {}
        for folder in self.folders:
            if not is_finished(folder):
                file = failure_file(folder.path)
                if not file.exists():
                    file.write_text(f"{reason}\n")
                reasons[folder.path] = file.read_text().strip()
        return reasons


def shares(cores: Sequence[int], workers: int) -> list[list[int]]:
    """The cores dealt out to workers; several workers may share one."""
    if not cores:
        return [[] for _ in range(workers)]
    return [list(cores[i::workers]) or [cores[i % len(cores)]] for i in range(workers)]


def own_cores() -> list[int]:
    """The processors that this process may use, where the platform tells."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _open(job: Job) -> RunFolder:
    """The folder of a run, new or gone on with, and this process written into its history."""
    if is_blank(job.path):
        return RunFolder.create(job.path, job.config)
    folder = RunFolder.open(job.path)
    failure_file(job.path).unlink(missing_ok=True)
    folder.write_config()
    return folder


def _environment() -> dict[str, str]:
    """One thread of XLA a process, and the cache of compiled programs that this one has."""
    ours = {"NPROC": "1", **_PREALLOCATION}
    if jax.config.jax_compilation_cache_dir:
        seconds = jax.config.jax_persistent_cache_min_compile_time_secs
        ours["JAX_COMPILATION_CACHE_DIR"] = str(jax.config.jax_compilation_cache_dir)
        ours["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(seconds)
    return {**os.environ, **ours}
