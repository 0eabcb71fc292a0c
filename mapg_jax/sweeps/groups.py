"""Which runs go together as one program, and what they need of memory and disk."""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Collection, Hashable, Sequence
from typing import Literal, NamedTuple

import jax

from envs.engines.simulators import cpus
from mapg_jax.runs import disk
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.host import precise
from mapg_jax.runs.memory import available_bytes, with_copy
from mapg_jax.training.config import Config
from mapg_jax.training.lockstep import program_key
from mapg_jax.training.state import tree_bytes
from mapg_jax.training.trainer import Trainer, make_trainer

Grouping = Literal["auto", "one", "all"] | int
"""How many runs a program has: what pays, one, as many as can, or so many at most."""
PROCESS_BYTES = 1_000_000_000  # Python, JAX, MuJoCo and compiled programs, beside the state

SHARE = 0.5
"""Of an accelerator's memory for training states; turns, evaluations and resuming need the rest."""


class Job(NamedTuple):
    """A run to be done: its configuration and its folder."""

    config: Config
    path: pathlib.Path
    idle: bool = False
    """Whether it is done, and only keeps its place in the program of its group."""


Group = tuple[Job, ...]
"""Runs that go in lockstep: resumed ones too are the numbers of that very program."""


def at_work(group: Group) -> Group:
    """Those that are not idle."""
    return tuple(job for job in group if not job.idle)


def with_work_for(group: Group, chosen: Collection[pathlib.Path]) -> Group:
    """The same program, in which all but the chosen are idle."""
    return tuple(job._replace(idle=job.path not in chosen) for job in group)


def parts(group: Group) -> list[Group]:
    """A group once for each set of its runs at work that has a checkpoint of one step in common.

    Runs that were trained apart before may have none.
    """
    steps = {job.path: frozenset(_steps(job.path)) for job in at_work(group)}
    if frozenset.intersection(*steps.values()) or not any(steps.values()):
        return [group]
    alike: dict[frozenset[int], list[pathlib.Path]] = {}
    for path, of_run in steps.items():
        alike.setdefault(of_run, []).append(path)
    return [with_work_for(group, chosen) for chosen in alike.values()]


def groups(jobs: Sequence[Job], grouping: Grouping = "auto", abreast: int = 1) -> list[Group]:
    """Cuts runs into groups, in their order.

    `auto` is one run a program on a CPU, where lockstep gains nothing, and as many as half of the
    memory holds on an accelerator, or fewer, so that there is one for each worker.

    Args:
      jobs: the runs.
      grouping: how they are cut.
      abreast: workers side by side.

    Raises:
      ValueError: if the grouping is none.
    """
    at_least_1 = type(grouping) is int and grouping >= 1
    if not at_least_1 and grouping not in ("auto", "one", "all"):
        raise ValueError(f"group must be auto, one, all or at least 1, got {grouping!r}")
    most = math.ceil(len(jobs) / abreast)
    alike: dict[Hashable, list[Job]] = {}
    for job in jobs:
        alike.setdefault(program_key(job.config), []).append(job)
    cut = []
    for together in alike.values():
        size = _size(together, grouping, most)
        cut += [tuple(together[i : i + size]) for i in range(0, len(together), size)]
    position = {job: i for i, job in enumerate(jobs)}
    return sorted(cut, key=lambda group: position[group[0]])


def group_bytes(group: Group) -> int:
    """Memory of the training state of a group."""
    return len(group) * _run_bytes(_largest(group))


def workers_that_fit(cut: Sequence[Group], wanted: int | None = None) -> int:
    """How many processes to use: one a core or an accelerator, if the memory allows.

    Raises:
      ValueError: if not even one fits, or not as many as wanted.
    """
    on_cpu = jax.default_backend() == "cpu"
    devices = accelerators()  # alike, each with its memory
    largest = max(map(group_bytes, cut), default=0)
    each = with_copy(largest) + (PROCESS_BYTES if on_cpu else 0)
    fitting = devices * (available_bytes() // each) if each else 1
    workers = min(checked_workers(wanted) or (cpus() if on_cpu else devices), len(cut) or 1)
    if fitting < (workers if wanted else 1):
        raise ValueError(
            f"{wanted or 1} at a time, each of {each / 1e9:.1f} GB, do not fit the "
            f"{available_bytes() / 1e9:.1f} GB that are available; choose fewer --workers, a "
            "smaller --group or a smaller --replay-size"
        )
    return min(workers, fitting)


def checked_workers(wanted: int | None) -> int | None:
    """So many workers; None, if that is open, stays None.

    Raises:
      ValueError: if it is no number of workers.
    """
    if wanted is not None and (type(wanted) is not int or wanted < 1):
        raise ValueError(f"workers must be at least 1, got {wanted!r}")
    return wanted


def accelerators() -> int:
    """Of this machine; 1, if it has none but its processor."""
    return 1 if jax.default_backend() == "cpu" else jax.local_device_count()


def refuse_unshared(cut: Sequence[Group]) -> None:
    """Raises ValueError if an algorithm does not learn in the shards that a run of it has."""
    seen = {}
    for config in map(_largest, cut):
        seen.setdefault((config.algorithm, config.shards), config)
    with precise():
        for config in seen.values():
            _of_any_seed(config).refuse_unshared()


def disk_bytes(cut: Sequence[Group], workers: int, keep_replay: bool) -> int:
    """The most that checkpoints can take: all those kept, and one being written, uncompressed."""
    running = finished = 0
    for group in cut:
        config = _largest(group)
        running = max(running, len(group) * disk.run_bytes(_of_any_seed(config)))
        each = disk.checkpoint_bytes(_of_any_seed(config)) if keep_replay else _agent_bytes(config)
        finished += config.checkpoints_kept * len(group) * each
    return workers * running + finished


def refuse_a_full_disk(cut: Sequence[Group], workers: int, keep_replay: bool) -> None:
    """Raises ValueError if the checkpoints might not fit."""
    needed = disk_bytes(cut, workers, keep_replay)
    taken = sum(disk.taken_bytes(job.path) for group in cut for job in group)
    for out in {job.path.parent for group in cut for job in group}:
        remedy = "fewer --workers or a smaller --replay-size"
        disk.refuse_a_full_disk(needed, out, taken, remedy)


def _size(alike: Sequence[Job], grouping: Grouping, most: int) -> int:
    """Runs a group; `auto` takes no more than `most`, so that no accelerator is idle."""
    if isinstance(grouping, int):
        return grouping
    if grouping == "auto" and jax.default_backend() != "cpu":
        fitting = int(SHARE * available_bytes()) // _run_bytes(_largest(alike))
        return max(1, min(fitting, most))
    return len(alike) if grouping == "all" else 1


def _steps(path: pathlib.Path) -> list[int]:
    return Checkpoints(path / "checkpoints").steps() if path.exists() else []


def _largest(jobs: Sequence[Job]) -> Config:
    return max((job.config for job in jobs), key=lambda config: config.heads)


@functools.cache
def _trainer(config: Config) -> Trainer:
    return make_trainer(config)


def _of_any_seed(config: Config) -> Trainer:
    return _trainer(dataclasses.replace(config, seed=0))


def _run_bytes(config: Config) -> int:
    return _of_any_seed(config).bytes


def _agent_bytes(config: Config) -> int:
    return tree_bytes(_of_any_seed(config).shapes.agent)
