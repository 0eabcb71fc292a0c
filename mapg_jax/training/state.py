"""What changes while a run learns."""

import math
from typing import Any, NamedTuple

import jax
from flax import struct

import envs
from mapg_jax.training.agent import AgentState


class Totals(NamedTuple):
    """Sums since the last evaluation, over updates and over finished training episodes."""

    updates: jax.Array  # [] f32
    update_metrics: Any  # the Metrics of the algorithm
    episodes: jax.Array  # [] f32
    episode_return: jax.Array  # []
    episode_length: jax.Array  # [] steps
    broken: jax.Array  # [] f32, steps whose observation or reward was not finite


class TrainState(struct.PyTreeNode):
    """All that changes while learning: what is jitted, donated, saved and resumed."""

    agent: AgentState
    explorer: Any  # the algorithm's carry of exploration, leaves [N, ...]
    replay: Any  # a ReplayState; None if the algorithm learns from rollouts
    update_credit: Any  # [] i32, updates owed, in units of 1/q (see ReplayTurn); or None
    env: envs.State  # leaves [N, ...]
    running_return: jax.Array  # [N], of the episodes under way
    key: jax.Array  # []
    env_steps: jax.Array  # [] i32, all environments together
    diverged_at: jax.Array  # [] i32, env_steps at the first metric that was not finite, or -1
    totals: Totals


def tree_bytes(shapes: Any) -> int:
    """Memory of a tree of arrays, or of their shapes."""
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(shapes))
