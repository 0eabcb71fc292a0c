"""Noise against its closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms import exploration, shards
from mapg_jax.algorithms.exploration import OU_DT, OU_THETA

N, A = 2_000, 2
SIGMA = 0.2


def assert_moments(x, mean, variance):
    """5 standard errors of the mean and of the variance of a normal sample."""
    n = x.size
    assert abs(x.mean() - mean) < 5 * np.sqrt(variance / n)
    assert abs(x.var() - variance) < 5 * variance * np.sqrt(2 / n)


@pytest.mark.parametrize(("start", "steps"), [(0.0, 1), (1.0, 1), (1.0, 100), (0.0, 3000)])
def test_ornstein_uhlenbeck_has_the_moments_of_its_closed_form(start, steps):
    """After one step, on the way, and after 3,000 steps, where 1 % of a start is left."""

    def step(noise, key):
        return exploration.advance("ou", key, noise, jnp.full((1, 1), SIGMA)), None

    keys = jax.random.split(jax.random.key(0), steps)
    noise = jax.lax.scan(step, jnp.full((N, A), start), keys)[0]
    moments = oracles.ou_moments(start, OU_THETA, SIGMA, OU_DT, steps)
    assert_moments(np.asarray(noise, np.float64), *moments)


def test_gaussian_noise_forgets():
    scale = jnp.full((1, 1), SIGMA)
    noise = exploration.advance("gaussian", jax.random.key(0), jnp.full((N, A), 9.0), scale)
    assert_moments(np.asarray(noise, np.float64), 0.0, SIGMA**2)


def test_no_noise_is_zero():
    scale = jnp.full((1, 1), SIGMA)
    assert not exploration.advance("none", jax.random.key(0), jnp.ones((N, A)), scale).any()


@pytest.mark.parametrize("kind", ["ou", "gaussian"])
def test_every_environment_has_its_own_scale(kind):
    """Noise is linear in σ: a ladder of scales is one draw, row by row."""
    ladder = jnp.linspace(0.05, 0.8, 4)[:, None]
    zeros = jnp.zeros((4, A))
    unit = exploration.advance(kind, jax.random.key(0), zeros, jnp.ones((1, 1)))
    noise = exploration.advance(kind, jax.random.key(0), zeros, ladder)
    np.testing.assert_allclose(noise, ladder * unit, rtol=1e-6)  # float32


def test_scales_rise_through_all_shards():
    """Of 2 shards on each of 2 devices, which `vmap` stands in for."""

    def of_a_shard(_):
        return exploration.scales(jnp.float32(0.05), jnp.float32(8.0), 3)

    of_a_device = jax.vmap(of_a_shard, axis_name=shards.SHARD)
    parts = jax.vmap(of_a_device, axis_name=shards.DEVICE)(jnp.zeros((2, 2)))
    np.testing.assert_allclose(parts.reshape(-1), np.linspace(0.05, 8.0, 12), rtol=1e-6)


def test_scales_take_even_steps_and_one_scale_is_exact():
    np.testing.assert_allclose(
        exploration.scales(jnp.float32(0.05), jnp.float32(8.0), 4)[:, 0],
        np.linspace(0.05, 8.0, 4),
        rtol=1e-6,  # float32
    )
    alike = exploration.scales(jnp.float32(SIGMA), jnp.float32(SIGMA), 16)
    np.testing.assert_array_equal(alike, np.full((16, 1), SIGMA, np.float32))
