"""Directions that keep heads apart, against slow sums and known states; and the floor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mapg_jax.algorithms import repulsion

M, PADDED, A = 4, 7, 2


def proposals(seed=0):
    """Actions and slopes of PADDED heads, of which M are in use, for three states."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (3, PADDED, A)), rng.normal(size=(3, PADDED, A))


def slow_stein(actions, slopes, weight):
    """M φ_m of Liu and Wang's Eq. 8, times α: the double sum, heads in use alone."""
    actions, slopes = actions[:M], slopes[:M]
    squares = [
        np.sum((x - y) ** 2) for i, x in enumerate(actions) for j, y in enumerate(actions) if i != j
    ]
    width = np.mean(squares) / np.log(M + 1)
    total = np.zeros((M, A))
    for m in range(M):
        for j in range(M):
            kernel = np.exp(-np.sum((actions[j] - actions[m]) ** 2) / width)
            slope_of_kernel = -2 * (actions[j] - actions[m]) / width * kernel  # in a_j
            total[m] += kernel * slopes[j] + weight * slope_of_kernel
    return total


def test_steins_direction_is_the_double_sum_and_padding_stays():
    actions, slopes = proposals()
    added = repulsion.stein(
        jnp.asarray(actions), jnp.asarray(slopes), jnp.float32(0.3), jnp.int32(M)
    )
    for state in range(3):
        expected = slow_stein(actions[state], slopes[state], 0.3) - slopes[state, :M]
        np.testing.assert_allclose(added[state, :M], expected, rtol=1e-4, atol=1e-5)
    assert not np.asarray(added)[:, M:].any()


def test_steins_particles_settle_on_the_density():
    """Q = -x²/2 with α = 0.25: 40 particles end as a Gaussian of variance α, within a tenth."""
    weight, heads = jnp.float32(0.25), jnp.int32(40)

    def step(x, _):
        return x + 0.01 * (repulsion.stein(x, -x, weight, heads) - x), None

    start = jax.random.uniform(jax.random.key(0), (40, 1), minval=0.5, maxval=1.5)
    end = np.asarray(jax.jit(lambda x: jax.lax.scan(step, x, None, 3000)[0])(start))
    assert abs(end.mean()) < 1e-3  # at rest the sum of all slopes is 0
    assert abs(end.var() / 0.25 - 1) < 0.1


def test_equal_proposals_are_not_pushed_anywhere():
    """Neither rule can tell where to; nothing is divided by 0."""
    same, slopes = jnp.full((5, 2), 0.3), jnp.zeros((5, 2))
    assert not np.asarray(repulsion.stein(same, slopes, jnp.float32(1), jnp.int32(5))).any()
    assert not np.asarray(repulsion.inverse_distance(same, jnp.float32(1), jnp.int32(5))).any()


@pytest.mark.parametrize("heads", [1, M])
def test_inverse_distance_is_the_slope_of_its_energy(heads):
    actions = jnp.asarray(proposals()[0][0], jnp.float32)

    def energy(own, m):
        others = [j for j in range(heads) if j != m]
        distances = [
            jnp.sqrt(jnp.square(own - actions[j]).sum() + repulsion.SOFTENING**2) for j in others
        ]
        return sum(1 / d for d in distances) / max(len(others), 1) if others else 0.0 * own.sum()

    found = repulsion.inverse_distance(actions, jnp.float32(0.7), jnp.int32(heads))
    for m in range(heads):
        expected = -0.7 * jax.grad(energy)(actions[m], m)
        np.testing.assert_allclose(found[m], expected, rtol=1e-4, atol=1e-6)
    assert not np.asarray(found)[heads:].any()


def test_a_head_is_credited_above_those_before_it():
    values = jnp.asarray([[1.0, 3.0, 2.0, 5.0]])
    found = repulsion.credit(values, jnp.float32(1e-3))
    above = [1.0, 3.0 - 1.0, 0.0, 5.0 - 3.0]  # with a sharp floor: max(Q_m - F_m, 0)
    np.testing.assert_allclose(found[0], above, atol=1e-5)

    slope = jax.jacobian(lambda v: repulsion.credit(v, jnp.float32(0.5)))(values[0])
    gate = 1 / (1 + np.exp(-np.array([np.inf, 2.0, -1.0, 2.0]) / 0.5))
    np.testing.assert_allclose(slope, np.diag(gate), rtol=1e-5, atol=1e-7)
