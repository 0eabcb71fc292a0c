"""Averages over the shards of a run; in a run of one shard, which has no such axes, the identity.

A run of S shards is one program on two named axes: D devices, and S/D shards on each of them. Every
shard has its environments, replay and draws; what is learnt is one and the same in all of them,
because all that moves it goes through `mean` or `total`.
"""

import math
from typing import Any

import jax
from jaxtyping import Array

DEVICE, SHARD = "device", "shard"
"""The axes: over devices, and over the shards of a device."""


def axes() -> tuple[str, ...]:
    """Those that the caller's program has."""
    return tuple(name for name in (DEVICE, SHARD) if _is_bound(name))


def mean(tree: Any) -> Any:
    """Leaves averaged over all shards."""
    names = axes()
    return jax.lax.pmean(tree, names) if names else tree


def total(tree: Any) -> Any:
    """Leaves summed over all shards."""
    names = axes()
    return jax.lax.psum(tree, names) if names else tree


def own(key: Array) -> Array:
    """A shard's own key, of a key that all have."""
    return jax.random.fold_in(key, number()) if axes() else key


def number() -> Any:
    """Of this shard, from 0."""
    found: Any = 0
    for name in axes():
        found = found * jax.lax.axis_size(name) + jax.lax.axis_index(name)
    return found


def count() -> int:
    """How many there are."""
    return math.prod(jax.lax.axis_size(name) for name in axes())


def _is_bound(name: str) -> bool:
    try:
        jax.lax.axis_size(name)
    except NameError:
        return False
    return True
