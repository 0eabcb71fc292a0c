"""Optima of a critic by a grid search, against critics whose optima are known."""

import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms import optima


def bumps(centres, heights, width=0.2):
    """Q with a peak of each height at each centre, of any K actions."""

    def q_values(actions):
        squares = jnp.square(actions[:, None] - jnp.asarray(centres)[None]).sum(-1)
        return (jnp.asarray(heights)[None] * jnp.exp(-squares / width**2)).max(-1)

    return q_values


CORNERS = np.float32([[-0.5, -0.5], [0.5, 0.5], [-1.0, 1.0], [0.7, -0.6]])


def share(q_values, proposals, heads):
    return float(
        optima.share_found(q_values, jnp.asarray(proposals, jnp.float32), jnp.int32(heads))
    )


def test_the_share_counts_the_high_peaks_that_have_a_head():
    q_values = bumps(CORNERS, [1.0, 0.95, 1.0, 0.5])  # the last is too low, the third in a corner
    proposals = [[-0.45, -0.55], [0.7, -0.6], [-0.92, 0.95]]
    assert share(q_values, proposals, 3) == pytest.approx(2 / 3)
    assert share(q_values, proposals, 2) == pytest.approx(1 / 3)  # a padded head finds nothing
    assert share(q_values, [[0.5, 0.35]], 1) == 0  # 0.15 off


def test_lines_are_searched_too():
    q_values = bumps([[-0.6], [0.6]], [1.0, 1.0])
    assert share(q_values, [[-0.6], [-0.55]], 2) == 0.5
    assert share(q_values, [[-0.6], [0.55]], 2) == 1


def test_a_critic_that_does_not_look_at_the_action_has_no_optimum():
    assert np.isnan(share(lambda actions: jnp.zeros(actions.shape[:-1]), [[0.0]], 1))


def test_any_critic_is_searched_as_by_the_slow_loop():
    """Twenty random waves over a plane, batched."""
    rng = np.random.default_rng(0)
    waves, phase = (
        np.float32(rng.normal(size=(20, 2, 3)) * 3),
        np.float32(rng.uniform(0, 6, (20, 3))),
    )
    proposals = np.float32(rng.uniform(-1, 1, (20, 6, 2)))

    def q_values(actions):
        return jnp.sin(jnp.einsum("bka,baw->bkw", actions, waves) + phase[:, None]).sum(-1)

    got = optima.share_found(q_values, jnp.asarray(proposals), jnp.int32(6))
    axis = np.linspace(-1, 1, 41, dtype=np.float32)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    values = np.asarray(q_values(jnp.broadcast_to(grid, (20, *grid.shape)))).reshape(20, 41, 41)
    expected = [oracles.optima_share(v, p) for v, p in zip(values, proposals, strict=True)]
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    assert 0 < np.mean(expected) < 1
