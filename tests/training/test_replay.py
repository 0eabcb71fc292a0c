"""The ring against a deque, and its draws against the uniform distribution."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.training import replay


@jax.jit
def add(state, items):
    """All of them."""
    return replay.add(state, items, jnp.ones(len(jax.tree.leaves(items)[0]), bool))


def items(start, n):
    """n items that can be told apart, with leaves of two shapes and types."""
    count = jnp.arange(start, start + n)
    return {"a": count, "b": jnp.stack([count, -count], 1).astype(jnp.float32)}


def empty(slots):
    return replay.init({"a": jnp.int32(0), "b": jnp.zeros(2)}, slots)


@pytest.mark.parametrize("slots", [1, 7, 32])
def test_ring_keeps_exactly_the_newest(slots):
    state, oracle = empty(slots), collections.deque(maxlen=slots)
    rng, count = np.random.default_rng(slots), 0
    for _ in range(40):
        n = int(rng.choice([1, 2, 3, slots // 2, slots], p=[0.3, 0.2, 0.2, 0.2, 0.1]))
        n = min(max(n, 1), slots)
        state = add(state, items(count, n))
        oracle.extend(range(count, count + n))
        count += n
        filled = int(state.size)
        assert filled == len(oracle)
        first = int(state.position) if filled == slots else 0
        kept = np.roll(np.asarray(state.data["a"])[:filled], -first)
        np.testing.assert_array_equal(kept, oracle)  # oldest first
        pairs = np.asarray(state.data["b"])[:filled]
        np.testing.assert_array_equal(pairs[:, 0], state.data["a"][:filled])
        np.testing.assert_array_equal(pairs[:, 1], -pairs[:, 0])


def test_items_take_the_type_of_their_slots():
    state = replay.init(jnp.zeros((), jnp.uint8), 4)
    state = add(state, jnp.array([3, 255]))
    assert state.data.dtype == jnp.uint8
    np.testing.assert_array_equal(state.data[:2], [3, 255])


def test_more_items_than_slots_are_refused():
    with pytest.raises(ValueError, match="5 items do not fit 4 slots"):
        add(empty(4), items(0, 5))


@pytest.mark.parametrize("slots", [5, 8])
def test_what_is_not_kept_takes_no_slot(slots):
    """Against the ring to which only the kept were added."""
    rng, state, oracle = np.random.default_rng(slots), empty(slots), empty(slots)
    for start in range(0, 60, 5):
        kept = rng.random(5) < 0.6
        state = jax.jit(replay.add)(state, items(start, 5), jnp.asarray(kept))
        for i in np.flatnonzero(kept):
            oracle = add(oracle, items(start + i, 1))
        oracles.assert_equal(state, oracle)


@pytest.mark.parametrize("added", [5, 20, 33])  # partly filled, full, wrapped
def test_samples_are_uniform_over_filled_slots(added):
    """Chi-square below its mean plus 6 standard deviations, and the key is fixed."""
    slots, n = 20, 40_000
    state = empty(slots)
    for start in range(added):
        state = add(state, items(start, 1))
    kept = range(max(0, added - slots), added)
    sampled = replay.sample(state, jax.random.key(0), n)
    np.testing.assert_array_equal(sampled["b"][:, 0], sampled["a"])
    values, counts = np.unique(sampled["a"], return_counts=True)
    np.testing.assert_array_equal(values, kept)
    expected = n / len(kept)
    statistic = ((counts - expected) ** 2 / expected).sum()
    assert statistic < oracles.chi_square_limit(len(kept))


def test_trim_keeps_the_filled_slots():
    state = add(empty(9), items(0, 4))
    trimmed = replay.trim(state)
    np.testing.assert_array_equal(trimmed.data["a"], range(4))
    assert replay.capacity(trimmed) == 4
    full = add(add(empty(4), items(0, 4)), items(4, 1))
    oracles.assert_equal(replay.trim(full).data, jax.tree.map(np.asarray, full.data))
