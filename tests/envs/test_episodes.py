"""Episodes end honestly: both ends told apart, the last observation kept, every start fresh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Env, State, with_episodes

SIZE, TIME_LIMIT, STEPS = 64, 5, 40


class Countdown(Env):
    """Starts at a random number of steps, 1 to 9, and terminates after as many."""

    observation_size, action_size, backend = 2, 1, "jax"

    def reset(self, rng):
        left_key, tag_key = jax.random.split(rng)
        left = jax.random.randint(left_key, (), 1, 10).astype(jnp.float32)
        tag = jax.random.uniform(tag_key)  # tells one start from another
        zero = jnp.zeros(())
        return State(left, jnp.stack([left, tag]), zero, zero, {"left": zero}, {"tag": tag})

    def step(self, state, action):
        left = state.pipeline_state - 1
        return state.replace(
            pipeline_state=left,
            obs=state.obs.at[0].set(left),
            reward=action[0],
            done=(left == 0).astype(jnp.float32),
            metrics={**state.metrics, "left": left},
        )


def play(env, key, actions):
    """The start and every state after it of one instance."""
    start = env.reset(key)

    def step(state, action):
        state = env.step(state, action)
        return state, state

    return start, jax.lax.scan(step, start, actions)[1]


def oracle(reset, step, time_limit, key, actions):
    """What `with_episodes` should show, step by step."""
    start_key, key = jax.random.split(key)
    state, steps, episode, shown = reset(start_key), 0, 0, []
    for action in actions:
        state, steps = step(state, action), steps + 1
        final, reward = state.obs, state.reward  # before a reset
        terminated, truncated = bool(state.done), steps == time_limit
        if terminated or truncated:
            episode, steps = episode + 1, 0
            state = reset(jax.random.fold_in(key, episode))
        shown.append((state.obs, final, reward, terminated, truncated, steps, episode))
    return [np.stack(column) for column in zip(*shown, strict=True)]


def test_a_step_that_is_not_finite_cuts_the_episode_off_where_it_began():
    wrapped = with_episodes(Countdown(), TIME_LIMIT)
    actions = jnp.zeros((12, 1)).at[jnp.array([0, 5, 6]), 0].set(jnp.nan)
    start, states = jax.jit(lambda: play(wrapped, jax.random.key(3), actions))()
    broken = states.info["broken"]
    np.testing.assert_array_equal(np.flatnonzero(broken), [0, 5, 6])
    assert states.info["truncated"][broken].all()
    assert not states.info["terminated"][broken].any()
    np.testing.assert_array_equal(states.reward[broken], 0.0)
    before = jnp.concatenate([start.obs[None], states.obs[:-1]])
    np.testing.assert_array_equal(states.info["final_observation"][broken], before[broken])
    assert (states.obs[broken, 1] != before[broken, 1]).all()  # another start
    np.testing.assert_array_equal(states.info["steps"][broken], 0)


def assert_is_the_oracle(env, time_limit, keys, actions):
    wrapped = with_episodes(env, time_limit)
    _, states = jax.jit(jax.vmap(lambda key, a: play(wrapped, key, a)))(keys, actions)
    states = jax.device_get(states)
    info, reset, step = states.info, jax.jit(env.reset), jax.jit(env.step)
    for i in range(len(keys)):
        obs, final, reward, terminated, truncated, steps, episode = oracle(
            reset, step, time_limit, keys[i], actions[i]
        )
        np.testing.assert_array_equal(states.obs[i], obs)
        np.testing.assert_array_equal(info["final_observation"][i], final)
        np.testing.assert_array_equal(states.reward[i], reward)
        np.testing.assert_array_equal(info["terminated"][i], terminated)
        np.testing.assert_array_equal(info["truncated"][i], truncated)
        np.testing.assert_array_equal(states.done[i], terminated | truncated)
        np.testing.assert_array_equal(info["steps"][i], steps)
        np.testing.assert_array_equal(info["episode"][i], episode)
    return states


@pytest.mark.parametrize("make_key", [jax.random.PRNGKey, jax.random.key])
def test_countdown_episodes_are_the_oracles(make_key):
    keys = jax.random.split(make_key(0), SIZE)
    actions = np.zeros((SIZE, STEPS, 1), np.float32)
    states = assert_is_the_oracle(Countdown(), TIME_LIMIT, keys, actions)
    assert (states.info["terminated"] & states.info["truncated"]).any()
    tags = states.obs[..., 1][states.done == 1]  # of the starts that followed
    assert len(tags) > 500
    # 2^23 values: 500 draws share one with probability 1.5 %, and the keys are fixed.
    assert len(np.unique(tags)) == len(tags)


@pytest.mark.parametrize("size", [1, 5])
def test_native_episodes_are_the_oracles(size):
    env = envs.make("hopper", "native")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (size, 60, env.action_size)).astype(np.float32)
    assert_is_the_oracle(env, 25, jax.random.split(jax.random.key(1), size), actions)


def test_nested_batches_are_flat_batches():
    env = with_episodes(Countdown(), TIME_LIMIT)
    keys = jax.random.split(jax.random.key(0), (4, SIZE // 4))
    one = lambda key: play(env, key, np.zeros((STEPS, 1), np.float32))[1]  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(one)))(keys)
    flat = jax.vmap(one)(keys.reshape(-1))
    for name in ("obs", "reward", "done"):
        got, expected = getattr(nested, name), getattr(flat, name)
        np.testing.assert_array_equal(got.reshape(expected.shape), expected)


@pytest.mark.parametrize("shape", [(SIZE,), (4, SIZE // 4), (1,), (SIZE, 1)])
def test_only_instances_that_ended_are_reset(monkeypatch, shape):
    """Rows the engine starts: those that ended, up to a whole round of a sixteenth."""
    env = envs.make("inverted_pendulum", "native")
    wrapped = with_episodes(env, 1000)
    simulator = env.engine._host._simulator
    started, start = [], simulator.forward
    monkeypatch.setattr(simulator, "forward", lambda rows: started.append(len(rows)) or start(rows))
    keys = jax.random.split(jax.random.key(0), shape)
    reset, step = wrapped.reset, wrapped.step
    for _ in shape:
        reset, step = jax.vmap(reset), jax.vmap(step)
    state, step = reset(keys), jax.jit(step)
    rng = np.random.default_rng(0)
    ended_in_all = 0
    for _ in range(60):
        actions = rng.uniform(-1, 1, (*shape, 1)).astype(np.float32)
        jax.block_until_ready(state)
        started.clear()
        state = jax.block_until_ready(step(state, actions))
        group = SIZE if shape[-1] == 1 < len(shape) else shape[-1]  # groups of one are one group
        ended = np.asarray(state.done).reshape(-1, group).sum(-1).astype(int)
        per_round = max(1, group // 16)
        rounds = -(-ended.max() // per_round)
        assert sum(started) == rounds * per_round * ended.size
        ended_in_all += ended.sum()
    assert ended_in_all > keys.size


def test_a_reset_renews_the_environments_own_info_and_no_wrappers():
    env = with_episodes(Countdown(), 1)
    state = env.reset(jax.random.key(0))
    state = state.replace(
        info={**state.info, "wrapper": jnp.ones(())}, metrics={**state.metrics, "sum": jnp.ones(())}
    )
    after = env.step(state, jnp.zeros(1))
    assert after.info["tag"] == after.obs[1] != state.info["tag"]
    assert after.info["wrapper"] == 1
    assert after.metrics["sum"] == 1
    assert after.metrics["left"] == after.info["final_observation"][0]  # of the step, not the start


def test_a_time_limit_below_one_step_is_refused():
    with pytest.raises(ValueError, match="at least 1 step, got 0"):
        with_episodes(Countdown(), 0)
