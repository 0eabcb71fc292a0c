"""What a run needs of memory, refused before anything is compiled."""

import jax
import psutil

from mapg_jax.training.config import Config, RolloutConfig
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.replay import capacity
from mapg_jax.training.state import tree_bytes


def prepare(*configs: Config, devices: int | None = 1) -> Lockstep:
    """The static part of a run, or of several in lockstep, refused before anything is compiled.

    Args:
      *configs: of the runs.
      devices: for the shards of a run; None takes as many as there are that serve.

    Raises:
      ValueError: if the environment cannot be made, the buffers do not fit the memory, or the
        shards cannot be on so many devices.
    """
    program = Lockstep(configs, devices)
    needed, available = with_copy(program.bytes) + program.turn_bytes, available_bytes()
    if needed > available:
        together = f"{len(configs)} runs in lockstep need" if len(configs) > 1 else "the run needs"
        what, remedy = "", "fewer --environments"
        replay = program.trainer.shapes.replay
        if 2 * program.turn_bytes > needed:
            what, remedy = _of_a_turn(program.trainer.config)
        elif replay is not None and 2 * tree_bytes(replay) > program.trainer.bytes:
            slots = capacity(replay)
            what = f", of which the replay of {slots:,} transitions is the most,"
            remedy = "a smaller --replay-size"
        elif 2 * tree_bytes(program.trainer.shapes.agent) > program.trainer.bytes:
            heads = program.trainer.config.heads
            what = f", of which the networks with {heads:,} heads are the most,"
            remedy = "fewer --heads, or narrower layers (--hidden)"
        raise ValueError(
            f"{together} {needed / 1e9:.1f} GB{what} but {available / 1e9:.1f} GB are available; "
            f"choose {remedy}"
        )
    return program


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
    device = jax.devices()[0]
    if device.platform == "cpu":
        return psutil.virtual_memory().available
    stats = device.memory_stats() or {}
    return stats.get("bytes_limit", 2**63) - stats.get("bytes_in_use", 0)
