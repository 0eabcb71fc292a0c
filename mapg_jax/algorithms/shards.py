"""Averages over the shards of a run; in a run of one shard, which has no such axes, the identity.

A run of S shards is one program on two named axes: D devices, and S/D shards on each of them. Every
shard has its environments, replay and draws; what is learnt is one and the same in all of them,
because all that moves it goes through `mean` or `total`.
"""

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
    number: Any = None
    for name in axes():
        index = jax.lax.axis_index(name)
        number = index if number is None else number * jax.lax.axis_size(name) + index
    return key if number is None else jax.random.fold_in(key, number)


def _is_bound(name: str) -> bool:
    try:
        jax.lax.axis_size(name)
    except NameError:
        return False
    return True
