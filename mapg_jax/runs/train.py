"""Whole runs from Python: trained, saved and scored."""

import dataclasses
import json
import logging
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import jax

from mapg_jax.runs import disk, hosts
from mapg_jax.runs.finishing import finish
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.host import this_host
from mapg_jax.runs.memory import prepare
from mapg_jax.runs.run import Callback, Event, Run
from mapg_jax.training.config import Config
from mapg_jax.training.lockstep import Lockstep

LOG = logging.getLogger(__name__)
SMALLER = "a smaller --replay-size, fewer --checkpoints-kept or --no-save-replay"

__all__ = ["Event", "Trained", "begin", "resume", "take_up", "train"]


@dataclasses.dataclass(frozen=True)
class Trained:
    """A run that has been trained."""

    path: pathlib.Path
    """Of its run folder."""
    config: Config
    score: dict[str, Any]
    """Of its last policy, as evaluation.json has it (docs/metrics.md): mean, std, returns, …"""


def train(
    config: Config,
    out: str | os.PathLike | None = None,
    callbacks: Sequence[Callback] = (),
    *,
    devices: int | None = None,
    progress: bool = False,
) -> Trained:
    """Trains a run to its end, saves it, and scores its last policy.

    Args:
      config: of the run.
      out: the run folder, which must not exist or be empty; by default the next free number under
        `runs/`.
      callbacks: called with an `Event` at every evaluation and checkpoint; one that returns True
        stops the run, which is saved and scored where it is.
      devices: D, which divides the run's shards; by default as many as there are that serve.
      progress: whether to show it on standard error.

    Raises:
      ValueError: if the run cannot be made, before anything is written.
      DivergedError: at the first metric or parameter that is not finite.
    """
    run = begin(config, out, devices)
    run.go(callbacks, progress=progress)
    return _finished(run)


def resume(
    path: str | os.PathLike,
    steps: int | None = None,
    callbacks: Sequence[Callback] = (),
    *,
    devices: int | None = None,
    progress: bool = False,
) -> Trained:
    """Goes on with a run, as if it had not stopped; see `train`.

    Args:
      path: the run folder.
      steps: a new total of environment steps; by default that of the run.
      callbacks: as of `train`.
      devices: as of `train`, whatever they were before.
      progress: whether to show it on standard error.

    Raises:
      ValueError: if the folder holds no run, it is past those steps, it cannot be made, or its
        checkpoint is damaged.
      BlockingIOError: if another process trains it.
      DivergedError: at the first metric or parameter that is not finite.
    """
    run = take_up(path, steps, devices)
    if not run.finished:
        run.go(callbacks, progress=progress)
    return _finished(run)


def begin(config: Config, out: str | os.PathLike | None = None, devices: int | None = None) -> Run:
    """A new run in a new folder, nothing compiled yet; see `train`.

    Raises:
      ValueError: if the run cannot be made, before anything is written.
    """
    if out is None and jax.process_count() > 1:
        raise ValueError("several hosts need --out, a folder that all of them see")
    place = pathlib.Path("runs" if out is None else out)
    program = hosts.by_all(lambda: _prepared(config, devices, place, 0, SMALLER))
    folder = hosts.by_first(
        lambda: RunFolder.create(out, config),
        lambda: RunFolder(place, config),  # storage may show the others a new file late
    )
    return Run(program, [folder])


def take_up(path: str | os.PathLike, steps: int | None = None, devices: int | None = None) -> Run:
    """A run from its newest checkpoint, or from the beginning where there is none; see `resume`.

    Raises:
      ValueError: if the folder holds no run, it is past those steps, it cannot be made, or its
        checkpoint is damaged.
      BlockingIOError: if another process trains it.
    """
    folder = hosts.by_all(lambda: RunFolder.open(path))
    # Held until the run has ended: nobody else trains it in between.
    locks = hosts.by_first(lambda: [folder.lock()], lambda: [])
    if steps is not None:
        folder = RunFolder(folder.path, dataclasses.replace(folder.config, steps=steps))
    taken, remedy = disk.taken_bytes(folder.path), "another disk: copy the run folder there"
    program = hosts.by_all(lambda: _prepared(folder.config, devices, folder.path, taken, remedy))
    run = Run(program, [folder], locks)
    run.restore()
    if run.turn > run.last_turn:
        raise ValueError(
            f"{path} has {run.env_steps:,} steps already, more than {run.folder.config.steps:,}; "
            "--steps with a larger number trains it further"
        )
    if not run.finished:
        host = this_host(run.trainer.env.backend, run.trainer.layout.devices)
        if run.turn and (others := folder.differences(host)):
            LOG.warning("%s was trained by %s: bits can differ", path, "; ".join(others))
        if hosts.is_first():
            folder.write_config()
    return run


def _prepared(
    config: Config, devices: int | None, place: pathlib.Path, taken: int, remedy: str
) -> Lockstep:
    """The program of a run that this host has the devices, the memory and the disk for."""
    program = prepare(config, devices=devices)
    hosts.refuse_idle(program.trainer)
    disk.refuse_a_full_disk(disk.run_bytes(program.trainer), place, taken, remedy)
    return program


def _finished(run: Run) -> Trained:
    folder = run.folder
    score = hosts.by_first(
        lambda: finish(folder), lambda: json.loads(folder.evaluation.read_text())
    )
    return Trained(folder.path, folder.config, score)
