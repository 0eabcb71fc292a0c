"""What a run needs of memory, refused before anything is compiled."""

import dataclasses
import logging
import math

import jax
import psutil

from mapg_jax.runs import hosts
from mapg_jax.runs.host import precise
from mapg_jax.training.config import Config, ReplayConfig, RolloutConfig
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.replay import capacity
from mapg_jax.training.state import tree_bytes
from mapg_jax.training.trainer import Trainer

LOG = logging.getLogger(__name__)
FILLED = 0.8
"""Of the memory, by a run whose replay is made to fit: a program takes more than can be counted."""


def prepare(*configs: Config, devices: int | None = 1) -> Lockstep:
    """The static part of a run, or of several in lockstep, refused before anything is compiled.

    Args:
      *configs: of the runs.
      devices: for the shards of a run; None takes as many as there are that serve.

    Raises:
      ValueError: if the environment cannot be made, the buffers do not fit the memory, the shards
        cannot be on so many devices, or the algorithm averages nothing over them.
    """
    program = Lockstep(configs, devices)
    with precise():  # as it is compiled: it is not traced again
        program.trainer.refuse_unshared()
    needed, available = needed_bytes(program), available_bytes()
    if needed > available:
        together = f"{len(configs)} runs in lockstep need" if len(configs) > 1 else "the run needs"
        several = program.trainer.layout.devices > 1 and jax.default_backend() != "cpu"
        where = " on each device" if several else ""
        what, remedy = _what_takes_the_most(program.trainer)
        raise ValueError(
            f"{together} {needed / 1e9:.1f} GB{where}{what} but {available / 1e9:.1f} GB are "
            f"available; choose {remedy}"
        )
    return program


def fitting(config: Config, devices: int | None = 1) -> Config:
    """The configuration; if its replay is too large for the memory, with the largest that fits.

    Args:
      config: of a run.
      devices: as of `prepare`.
    """
    if not isinstance(config, ReplayConfig):
        return config
    ours = hosts.by_all(lambda: _largest_replay(config, devices))
    size = -int(hosts.largest(-ours))  # of the host with the least
    if size < config.replay_size:
        wanted = f"{config.replay_size:,}"
        LOG.warning(
            "%s transitions do not fit the memory; the replay holds %s", wanted, f"{size:,}"
        )
    return dataclasses.replace(config, replay_size=size)


def _largest_replay(config: ReplayConfig, devices: int | None) -> int:
    """Its size, or the largest that fits; where no replay fits, its size."""

    def needed(size):
        return needed_bytes(Lockstep((dataclasses.replace(config, replay_size=size),), devices))

    size, available = config.replay_size, available_bytes()
    whole = needed(size)
    if whole <= FILLED * available:
        return size
    least = config.shards * math.ceil(max(config.batch_size, config.environments) / config.shards)
    base = needed(least)
    room = (FILLED * available - base) * (size - least) / max(1, whole - base)
    return least + int(room) // config.shards * config.shards if room > 0 else size


def needed_bytes(program: Lockstep) -> int:
    """Memory that a program needs of each accelerator, or of this machine, at least."""
    each = program.bytes + program.turn_bytes
    if jax.default_backend() != "cpu":
        return each
    layout = program.trainer.layout
    here = sum(d.process_index == jax.process_index() for d in layout.mesh.devices.flat)
    whole = len(program.configs) * tree_bytes(program.trainer.shapes)
    return here * each + min(whole, here * program.bytes)  # a checkpoint's copy of what is here


def _what_takes_the_most(trainer: Trainer) -> tuple[str, str]:
    """Of a device's memory, and what would need less."""
    replay = trainer.shapes.replay
    if trainer.turn_bytes > trainer.bytes:
        return _of_a_turn(trainer.config)
    if replay is not None and 2 * tree_bytes(replay) // trainer.layout.devices > trainer.bytes:
        what = f", of which the replay of {capacity(replay):,} transitions is the most,"
        return what, "a smaller --replay-size"
    if 2 * tree_bytes(trainer.shapes.agent) > trainer.bytes:
        what = f", of which the networks with {trainer.config.heads:,} heads are the most,"
        return what, "fewer --heads, or narrower layers (--hidden)"
    return "", "fewer --environments"


def _of_a_turn(config: Config) -> tuple[str, str]:
    """What a turn needs, and what would need less."""
    if isinstance(config, RolloutConfig):
        return (
            f", of which the rollouts of {config.rollout_steps:,} steps are the most,",
            "fewer --rollout-steps or --environments",
        )
    return (
        ", of which the batches of the updates between two steps are the most,",
        "fewer --updates-per-step or --environments, or a smaller --batch-size",
    )


def with_copy(state: int) -> int:
    """Bytes of a state, and of the copy that a checkpoint is written from where both are here."""
    return 2 * state if jax.default_backend() == "cpu" else state


def available_bytes() -> int:
    """Memory free for the training state: of the accelerator, or of this machine."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return psutil.virtual_memory().available
    stats = device.memory_stats() or {}
    return stats.get("bytes_limit", 2**63) - stats.get("bytes_in_use", 0)
