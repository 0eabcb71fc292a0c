"""Running statistics against NumPy over all observations seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mapg_jax.algorithms import normalization
from mapg_jax.algorithms.normalization import VARIANCE_FLOOR

D = 3
update = jax.jit(normalization.update)


def see(batches):
    state = normalization.init(D)
    for batch in batches:
        state = update(state, jnp.asarray(batch))
    return state


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_statistics_are_numpys_over_all_data(n, offset):
    rng = np.random.default_rng(0)
    scale = np.array([0.1, 1.0, 30.0])
    batches = (offset + scale * rng.normal(size=(400, n, D))).astype(np.float32)
    state = see(batches)
    seen = batches.reshape(-1, D).astype(np.float64)
    assert state.count == len(seen)
    # float32 means of numbers near 100 are good to 1e-5 · 100; the sums of 2,800 squares to 1e-3.
    np.testing.assert_allclose(state.mean, seen.mean(0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(state.deviations / state.count, seen.var(0), rtol=1e-3)


def test_the_order_of_batches_does_not_matter():
    batches = np.random.default_rng(1).normal(size=(50, 4, D)).astype(np.float32)
    forth, back = see(batches), see(batches[::-1])
    for x, y in zip(jax.tree.leaves(forth), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6)  # float32 sums


def test_normalized_data_has_mean_0_and_deviation_1():
    data = np.random.default_rng(2).normal(3.0, 2.0, size=(5000, D)).astype(np.float32)
    normalized = normalization.normalize(see([data]), jnp.asarray(data), 100.0)
    np.testing.assert_allclose(normalized.mean(0), 0.0, atol=1e-5)  # float32 sums
    np.testing.assert_allclose(normalized.std(0), 1.0, rtol=1e-4)


def test_normalized_observations_are_clipped():
    state = see([np.random.default_rng(3).normal(size=(1000, D)).astype(np.float32)])
    far = jnp.array([[1e6, -1e6, 0.0]])
    clipped = normalization.normalize(state, far, 5.0)
    np.testing.assert_array_equal(clipped[0, :2], [5.0, -5.0])
    assert abs(clipped[0, 2]) < 0.2  # 6 standard errors of a mean of 1,000


def test_a_constant_is_divided_by_the_floor():
    """A dimension that has not moved yet may move later: it must not explode then."""
    state = see([np.full((10, D), 2.0, np.float32)])
    np.testing.assert_array_equal(normalization.normalize(state, jnp.full(D, 2.0), 5.0), 0.0)
    off = normalization.normalize(state, jnp.full(D, 2.1), 5.0)
    np.testing.assert_allclose(off, 0.1 / np.sqrt(VARIANCE_FLOOR), rtol=1e-5)  # float32


def test_nothing_seen_changes_no_small_observation_to_nan():
    normalized = normalization.normalize(normalization.init(D), jnp.ones(D), 100.0)
    np.testing.assert_allclose(normalized, 1 / np.sqrt(VARIANCE_FLOOR), rtol=1e-6)
