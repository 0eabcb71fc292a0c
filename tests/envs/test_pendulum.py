"""Pendulum is Gymnasium's Pendulum-v1."""

import gymnasium
import jax
import jax.export
import numpy as np
import pytest
import scipy.stats

import envs

STEPS = envs.spec("pendulum").time_limit


def play(starts, actions):
    """Observations and rewards from starts [N, 2] under actions [N, T, 1]."""
    env = envs.make("pendulum")

    def episode(start, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, (state.obs, state.reward)

        return jax.lax.scan(step, env.reset_to(*start), actions)[1]

    return jax.jit(jax.vmap(episode))(starts, actions)


def gymnasium_play(start, actions):
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset()
    env.state = np.float64(start)
    observations, rewards = [], []
    for action in actions:
        observation, reward, *_ = env.step(action * env.action_space.high)
        observations.append(observation)
        rewards.append(reward)
    return np.stack(observations), np.stack(rewards)


@pytest.mark.parametrize("hold", [1, 20])  # steps an action lasts; 20 swings it over the top
def test_an_episode_is_gymnasiums(hold):
    rng = np.random.default_rng(hold)
    starts = rng.uniform([-np.pi, -1], [np.pi, 1], (50, 2)).astype(np.float32)
    actions = rng.uniform(-1, 1, (50, STEPS // hold, 1)).astype(np.float32)
    actions = np.repeat(actions, hold, axis=1)
    observations, rewards = play(starts, actions)
    for i in range(len(starts)):
        expected_observations, expected_rewards = gymnasium_play(starts[i], actions[i])
        np.testing.assert_allclose(observations[i], expected_observations, rtol=0, atol=1e-5)
        np.testing.assert_allclose(rewards[i], expected_rewards, rtol=0, atol=1e-5)


def test_starts_are_drawn_as_gymnasium_draws_them():
    """Uniform within ±π and ±1; p < 1e-6 comes once in a million runs, and the keys are fixed."""
    env = envs.make("pendulum")
    cosine, sine, speed = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 1000)).obs.T
    for values, bound in ((np.arctan2(sine, cosine), np.pi), (speed, 1.0)):
        uniform = scipy.stats.uniform(-bound, 2 * bound)
        assert scipy.stats.kstest(values, uniform.cdf).pvalue > 1e-6


def test_reset_to_keeps_float64():
    start = np.array([1.0, 2.0]) + 1e-12
    state = envs.make("pendulum").reset_to(*start)
    np.testing.assert_array_equal(np.asarray(state.pipeline_state).view(np.float64)[:, 0], start)


def test_gravity_is_an_option():
    strong, weak = (
        envs.make("pendulum", g=g).reset_to(np.float32(1.0), np.float32(0.0)) for g in (9.81, 0.0)
    )
    still = np.zeros(1, np.float32)
    assert envs.make("pendulum", g=0.0).step(weak, still).obs[2] == 0
    expected = 3 * 9.81 / 2 * np.sin(1.0) * 0.05  # rad/s after one step
    speed = envs.make("pendulum", g=9.81).step(strong, still).obs[2]
    assert speed == pytest.approx(expected, rel=1e-6)  # float32


def test_actions_are_clipped_and_wrappers_kept():
    env = envs.make("pendulum")
    state = env.reset(jax.random.key(0)).replace(info={"wrapper": 1}, metrics={"wrapper": 2})
    wild, clipped = env.step(state, np.float32([7])), env.step(state, np.float32([1]))
    jax.tree.map(np.testing.assert_array_equal, wild, clipped)
    assert (wild.info, wild.metrics) == ({"wrapper": 1}, {"wrapper": 2})


def test_it_lowers_for_accelerators():
    env = envs.make("pendulum")
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    step = jax.jit(jax.vmap(env.step))
    exported = jax.export.export(step, platforms=["cuda", "tpu"])(states, np.zeros((4, 1)))
    assert exported.platforms == ("cuda", "tpu")
