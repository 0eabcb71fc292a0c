"""A ring of transitions that holds each observation once, as data and functions.

What one step leads to is what the next one begins with, so steps hold rows of a second ring, of
observations. Each turn of N environments takes N rows there, and one more for each episode that is
cut off at its time limit: what it observed last is no other step's beginning. A terminal step leads
nowhere, and has its own observation in that place.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mapg_jax.algorithms.base import Transition


class Data(NamedTuple):
    """What fills up."""

    steps: Transition  # leaves [C, ...]; both observations are rows, [C] i32
    observations: jax.Array  # [R, D]


class ReplayState(struct.PyTreeNode):
    """Both rings, and how far they are filled."""

    data: Data
    position: jax.Array  # [] i32, the slot written next
    size: jax.Array  # [] i32, the steps before it that are held
    row: jax.Array  # [] i32, the row that the first environment's present observation takes
    rows: jax.Array  # [] i32, rows filled


def capacity(state: ReplayState) -> int:
    """C, the number of slots, of all shards together."""
    return math.prod(state.data.steps.reward.shape)


def bytes_of_a_step(state: ReplayState) -> int:
    """What one takes where it is read, with both observations."""
    observation = state.data.observations
    leaves = jax.tree.leaves(state.data.steps._replace(observation=(), next_observation=()))
    rest = sum(leaf.size * leaf.dtype.itemsize for leaf in leaves) // capacity(state)
    return rest + 2 * observation.shape[-1] * observation.dtype.itemsize


def init(steps: Transition, slots: int, limit: int) -> ReplayState:
    """Empty rings.

    Args:
      steps: one of each environment, leaves [N, ...], for their shapes and types.
      slots: C, the steps to hold.
      limit: of an episode's steps. R = C + 2N + (C + N) / limit: the C newest steps keep their
        observations, however their episodes end.
    """
    n = len(steps.reward)
    rows = slots + 2 * n + math.ceil((slots + n) / limit)
    row = jnp.zeros(n, jnp.int32)
    of_steps = jax.tree.map(
        lambda x: jnp.zeros((slots, *x.shape[1:]), x.dtype),
        steps._replace(observation=row, next_observation=row),
    )
    observation = steps.observation
    observations = jnp.zeros((rows, *observation.shape[1:]), observation.dtype)
    zero = jnp.zeros((), jnp.int32)
    return ReplayState(Data(of_steps, observations), zero, zero, zero, zero)


def add(
    state: ReplayState,
    steps: Transition,
    ended: Bool[Array, "N"],
    upcoming: Float[Array, "N D"],
    kept: Bool[Array, "N"],
) -> ReplayState:
    """The rings with one step of every environment, in order, each over the oldest once it is full.

    Args:
      state: the rings.
      steps: leaves [N, ...], N at most C.
      ended: which of them ended their episodes.
      upcoming: the observations that the next steps begin with.
      kept: which of the steps are. Where more are left out than R has rows to spare, the oldest
        steps go before C newer ones are there.
    """
    slots, rows, n = capacity(state), len(state.data.observations), len(kept)
    if n > slots:
        raise ValueError(f"{n} steps do not fit {slots} slots")
    lane = jnp.arange(n, dtype=jnp.int32)
    cut = ended & ~steps.terminal & kept
    now = state.row + lane
    last = state.row + n + jnp.cumsum(cut) - 1
    following = state.row + n + cut.sum()
    after = jnp.where(steps.terminal, now, jnp.where(cut, last, following + lane))

    # The upcoming are written already, for who samples them before they are acted on. What is
    # acted on is written again: it is another where the environments, or the rings, began anew.
    written = now % rows, jnp.where(cut, last % rows, rows + lane), (following + lane) % rows
    observations = _put(
        state.data.observations,
        jnp.concatenate(written),
        jnp.concatenate([steps.observation, steps.next_observation, upcoming]),
    )
    place = (state.position + jnp.cumsum(kept) - 1) % slots
    place = jnp.where(kept, place, slots + lane)
    of_steps = steps._replace(observation=now % rows, next_observation=after % rows)
    of_steps = jax.tree.map(lambda old, new: _put(old, place, new), state.data.steps, of_steps)

    count = kept.sum()
    position, size = (state.position + count) % slots, jnp.minimum(state.size + count, slots)
    ahead = jnp.arange(3 * n)
    oldest = of_steps.observation[(position - size + ahead) % slots]
    lost = (oldest - state.row) % rows < following + n - state.row
    return ReplayState(
        data=Data(of_steps, observations),
        position=position,
        size=size - (lost & (ahead < size - count)).sum(),
        row=following % rows,
        rows=jnp.clip(following + n, state.rows, rows),
    )


def _put(old: jax.Array, index: Int[Array, "K"], new: jax.Array) -> jax.Array:
    """`old` with rows written, but for those past its end."""
    return old.at[index].set(new.astype(old.dtype), mode="drop", unique_indices=True)


def read(state: ReplayState, index: Int[Array, "K"]) -> Transition:
    """The steps in some slots."""
    steps, observations = state.data
    found = jax.tree.map(lambda x: x[index], steps)
    return found._replace(
        observation=observations[found.observation],
        next_observation=observations[found.next_observation],
    )


def sample(state: ReplayState, key: PRNGKeyArray, n: int) -> Transition:
    """`n` steps drawn uniformly with replacement; at least one must be held."""
    index = jax.random.randint(key, (n,), 0, state.size)
    return read(state, (_first(state) + index) % capacity(state))


def _first(state: ReplayState) -> Int[Array, "*S"]:
    """A slot from which on `size` slots are held: 0 where all are."""
    slots = state.data.steps.reward.shape[-1]
    return jnp.where(state.size == slots, 0, (state.position - state.size) % slots)


def added(state: ReplayState) -> Int[Array, ""]:
    """The steps since it was empty, C at most."""
    gone_round = state.rows == len(state.data.observations)
    return jnp.where(gone_round, capacity(state), state.size)


def emptied(state: ReplayState) -> ReplayState:
    """The rings, or those a shard, as if nothing had been added."""
    zero = jnp.zeros_like(state.position)
    return state.replace(position=zero, size=zero, row=zero, rows=zero)


def cut_off(state: ReplayState, environments: int) -> ReplayState:
    """The rings, or those a shard, before new episodes: what the old observed last stays."""
    rows = state.data.observations.shape[-2]
    return state.replace(row=(state.row + environments) % rows)


def trim(state: ReplayState) -> ReplayState:
    """The rings, or those a shard [S, ...], without what is empty in all, on the host.

    What lies on several hosts stays there, and whole unless all of it is empty.
    """
    shards = (slice(None),) * np.ndim(state.size)
    c = state.data.steps.reward.shape[-1]
    slots = int(jnp.where(_first(state) == 0, state.size, c).max())
    rows = int(jnp.max(state.rows)) if slots else 0
    data = state.data
    if _is_here(state):
        data = jax.tree.map(np.asarray, data)
    elif slots:
        return state
    steps = jax.tree.map(lambda x: x[*shards, :slots], data.steps)
    return state.replace(data=Data(steps, data.observations[*shards, :rows]))


def _is_here(state: ReplayState) -> bool:
    """Whether this host has all of it."""
    return not isinstance(state.size, jax.Array) or state.size.is_fully_addressable
