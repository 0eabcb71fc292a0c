"""A ring buffer of transitions, as data and functions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, PRNGKeyArray

Items = Any
"""A tree of arrays with equal leading axes."""


class ReplayState(struct.PyTreeNode):
    """The slots and where the next item goes."""

    data: Items  # leaves [C, ...]
    position: jax.Array  # [] i32, the slot written next
    size: jax.Array  # [] i32, slots filled


def capacity(state: ReplayState) -> int:
    """C, the number of slots."""
    return jax.tree.leaves(state.data)[0].shape[0]


def init(item: Items, slots: int) -> ReplayState:
    """An empty ring for `slots` items shaped like `item`."""
    data = jax.tree.map(lambda x: jnp.zeros((slots, *jnp.shape(x)), jnp.result_type(x)), item)
    return ReplayState(data, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def add(state: ReplayState, items: Items, kept: Bool[Array, "N"]) -> ReplayState:
    """The ring with those of N items that are kept, in order, each over the oldest once it is full.

    Args:
      state: the ring.
      items: leaves [N, ...], N at most the number of slots.
      kept: which of them.
    """
    slots = capacity(state)
    n = len(kept)
    if n > slots:
        raise ValueError(f"{n} items do not fit {slots} slots")
    place = (state.position + jnp.cumsum(kept) - 1) % slots
    index = jnp.where(kept, place, slots + jnp.arange(n))  # past the end: dropped

    def put(old, new):
        return old.at[index].set(new.astype(old.dtype), mode="drop", unique_indices=True)

    data = jax.tree.map(put, state.data, items)
    n = kept.sum()
    return ReplayState(data, (state.position + n) % slots, jnp.minimum(state.size + n, slots))


def sample(state: ReplayState, key: PRNGKeyArray, n: int) -> Items:
    """`n` items drawn uniformly with replacement; at least one slot must be filled."""
    index = jax.random.randint(key, (n,), 0, state.size)
    return jax.tree.map(lambda x: x[index], state.data)


def emptied(state: ReplayState) -> ReplayState:
    """The ring, or one a shard, as if nothing had been added."""
    return state.replace(position=jnp.zeros_like(state.position), size=jnp.zeros_like(state.size))


def trim(state: ReplayState) -> ReplayState:
    """The ring, or one a shard [S, ...], without slots that are empty in all, on the host."""
    size, shards = np.max(state.size), np.ndim(state.size)
    filled = (*(slice(None),) * shards, slice(int(size)))
    return state.replace(data=jax.tree.map(lambda x: np.asarray(x)[filled], state.data))
