"""Where the workers of a sweep run: on this machine, as jobs of Slurm, or as tasks of Ray.

The run folders, on storage that all machines share, are the truth: what a worker did is read from
them, and one that was lost is started again on what they hold.
"""

import dataclasses
import importlib
import os
import pathlib
import subprocess
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import jax

from envs import values

Name = Literal["local", "slurm", "ray"]
Options = Mapping[str, Any]
CHECKOUT = pathlib.Path(__file__).parents[2]
"""Of this package, where it is one."""
PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"


@dataclasses.dataclass(frozen=True)
class Share:
    """What a worker has of this machine; nothing where it runs elsewhere."""

    cores: tuple[int, ...] = ()
    gpu: str | None = None
    """The only one that it sees; None leaves it those that this process sees."""


@runtime_checkable
class Launched(Protocol):
    """A worker that was started."""

    def running(self) -> bool: ...

    def stop(self) -> None:
        """Asks it to save and to end."""
        ...

    def wait(self) -> int:
        """Until it has ended; its exit status, below 0 if a signal killed it."""
        ...


@runtime_checkable
class Launcher(Protocol):
    """Starts workers."""

    here: bool
    """Whether they need the cores and the memory of this machine."""

    def shares(self, workers: int) -> list[Share]:
        """Of so many workers side by side."""
        ...

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> Launched:
        """A worker; what it prints goes to `log`."""
        ...


def launcher(name: Name, options: Sequence[str] = ()) -> Launcher:
    """The launcher of a name; to be made before JAX first looks for a device.

    Args:
      name: local, slurm or ray.
      options: name=value each: parameters of Slurm's jobs, or of Ray's tasks.

    Raises:
      ValueError: if there is none, its package is missing, or an option is not written name=value.
    """
    if name not in typing.get_args(Name):
        raise ValueError(f"a launcher is local, slurm or ray, got {name!r}")
    given = {}
    for text in options:
        key, equals, value = text.partition("=") if isinstance(text, str) else ("", "", "")
        if not key or not equals:
            raise ValueError(f"options of a launcher are written name=value, got {text!r}")
        if key in given:
            raise ValueError(f"the launcher's option {key} is given twice; leave one out")
        given[key] = values.read(value)
    _leave_the_memory_to_workers()
    if name == "local":
        if given:
            raise ValueError("the launcher local has no options; --workers says how many")
        return Local()
    module = {"slurm": "mapg_jax.sweeps.slurm", "ray": "mapg_jax.sweeps.ray_tasks"}[name]
    try:
        return importlib.import_module(module).Launcher(given)
    except ImportError as error:
        raise ValueError(
            f"the launcher {name} needs a package that is not installed ({error.name}); "
            f"pip install 'mapg-jax[{name}]'"
        ) from None


class Local:
    """Processes of this machine, each pinned to its share of it."""

    here = True

    def shares(self, workers: int) -> list[Share]:
        """Of several GPUs each worker sees one alone."""
        gpus = visible_gpus()
        cores = deal(own_cores(), workers)
        return [
            Share(tuple(own), gpus[i % len(gpus)] if len(gpus) > 1 else None)
            for i, own in enumerate(cores)
        ]

    def start(self, command: Sequence[str], log: pathlib.Path, share: Share) -> "LocalWorker":
        return LocalWorker(command, log, share)


class LocalWorker:
    """A process."""

    def __init__(self, command: Sequence[str], log: pathlib.Path, share: Share):
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,  # its end tells the worker that this process is gone
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment(), **_one_gpu(share)},
                start_new_session=True,  # Ctrl-C reaches us alone, and we stop the workers
            )
        if hasattr(os, "sched_setaffinity") and share.cores:
            os.sched_setaffinity(self._process.pid, share.cores)  # before it starts any thread

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        if self.running():
            self._process.terminate()

    def wait(self) -> int:
        status = self._process.wait()
        if self._process.stdin:
            self._process.stdin.close()
        return status


# The process of a sweep only asks a GPU for its size; its workers need the memory, and have it as
# the user says.
_PREALLOCATION = {PREALLOCATE: os.environ.get(PREALLOCATE, "true")}


def _leave_the_memory_to_workers() -> None:
    """Serves if JAX has not looked for a device yet."""
    os.environ[PREALLOCATE] = "false"


def environment() -> dict[str, str]:
    """One thread of XLA a process, and the cache of compiled programs that this one has.

    A checkout that is not installed is found by its path: workers leave their working folder out.
    """
    ours = {"NPROC": "1", **_PREALLOCATION}
    if (CHECKOUT / "pyproject.toml").exists():
        paths = [str(CHECKOUT), os.environ.get("PYTHONPATH", "")]
        ours["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    settings: Any = jax.config  # JAX gives it its attributes at run time
    if settings.jax_compilation_cache_dir:
        seconds = settings.jax_persistent_cache_min_compile_time_secs
        ours["JAX_COMPILATION_CACHE_DIR"] = str(settings.jax_compilation_cache_dir)
        ours["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(seconds)
    return ours


def deal(cores: Sequence[int], workers: int) -> list[list[int]]:
    """The cores dealt out to workers; several workers may share one."""
    if not cores:
        return [[] for _ in range(workers)]
    return [list(cores[i::workers]) or [cores[i % len(cores)]] for i in range(workers)]


def own_cores() -> list[int]:
    """The processors that this process may use, where the platform tells."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def visible_gpus() -> list[str]:
    """Of this machine, as CUDA_VISIBLE_DEVICES names them: by numbers, or by UUIDs."""
    if jax.default_backend() != "gpu":
        return []
    count = jax.local_device_count()
    named = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
    return [name.strip() for name in named.split(",")][:count]


def _one_gpu(share: Share) -> Mapping[str, str]:
    return {} if share.gpu is None else {"CUDA_VISIBLE_DEVICES": share.gpu}
