"""Brax's environments in ours, and ours in Brax's trainer."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import train as ppo

import envs
from envs.base import with_episodes

pytestmark = pytest.mark.usefixtures("their_code")


@pytest.fixture
def device_put_replicated(monkeypatch):
    """What Brax 0.14.2 calls and these JAX versions no longer have."""

    def replicate(tree, devices):
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    monkeypatch.setattr(jax, "device_put_replicated", replicate, raising=False)


@pytest.mark.slow
@pytest.mark.usefixtures("device_put_replicated")
def test_braxs_ppo_trains():
    evaluations = []
    _, params, _ = ppo.train(
        environment=envs.make("hopper", "native"),
        num_timesteps=2048,
        episode_length=64,
        num_envs=8,
        batch_size=16,
        num_minibatches=4,
        unroll_length=16,
        num_updates_per_batch=2,
        num_evals=2,
        num_eval_envs=8,
        normalize_observations=True,
        seed=0,
        progress_fn=lambda step, metrics: evaluations.append((step, metrics)),
    )
    assert [step > 0 for step, _ in evaluations] == [False, True]
    for _, metrics in evaluations:
        assert np.isfinite(metrics["eval/episode_reward"])
    assert evaluations[-1][1]["training/sps"] > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


@functools.cache
def brax_env():
    return envs.make("brax:inverted_pendulum", backend="spring")


def test_a_brax_environment_keeps_our_contract():
    env = with_episodes(brax_env(), time_limit=3)
    assert env.backend == "spring"
    np.testing.assert_array_equal(env.action_high, np.ones(env.action_size, np.float32))
    assert envs.spec("brax:inverted_pendulum").time_limit == 1000

    @jax.jit
    def play(key, actions):
        start = env.reset(key)
        start = start.replace(
            info={**start.info, "wrapper": jnp.ones(())},
            metrics={**start.metrics, "wrapper": jnp.ones(())},
        )
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, start, actions)[1]

    actions = np.linspace(-3, 3, 9, dtype=np.float32)[:, None]
    states = play(jax.random.key(0), actions)
    assert states.obs.shape == (9, env.observation_size)
    np.testing.assert_array_equal(states.info["truncated"], [0, 0, 1] * 3)
    np.testing.assert_array_equal(states.info["wrapper"], np.ones(9))
    np.testing.assert_array_equal(states.metrics["wrapper"], np.ones(9))
    assert len(np.unique(states.obs[2::3], axis=0)) == 3  # fresh starts
    clipped = play(jax.random.key(0), actions.clip(-1, 1))
    np.testing.assert_array_equal(states.obs, clipped.obs)


def test_step_leaves_the_state_it_was_given_alone():
    """Brax's reacher writes its metrics into the dictionary of the state."""
    env = envs.make("brax:reacher", backend="spring")

    def step(key):
        state = env.reset(key)
        before = dict(state.metrics)
        after = env.step(state, jnp.zeros(env.action_size))
        assert before and all(state.metrics[name] is value for name, value in before.items())
        assert any(after.metrics[name] is not value for name, value in before.items())
        return after

    jax.eval_shape(step, jax.random.key(0))
