"""gym:NAME: Gymnasium's own steps, whatever XLA does with the calls, and honest ends."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import envs
from mapg_jax.runs.train import begin, take_up
from mapg_jax.training.config import Config

N, T = 5, 7


class Counter(gymnasium.Env):
    """Observes its step, pays 1, and truncates itself at the third where it is told to."""

    observation_space = gymnasium.spaces.Box(-1.0, 99.0, (1,))

    def __init__(self, low=-1.0, stops=True):
        self.action_space = gymnasium.spaces.Box(low, 1.0, (2,))
        self._stops = stops

    def reset(self, *, seed=None, options=None):
        self._t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self._t += 1
        return np.full(1, self._t, np.float32), 1.0, False, self._stops and self._t == 3, {}


@pytest.fixture(scope="module", autouse=True)
def _registered():
    gymnasium.register("Counter-v0", Counter)
    yield
    del gymnasium.registry["Counter-v0"]


def test_steps_are_gymnasiums():
    env = envs.make("gym:Pendulum-v1", g=9.0)
    keys = jax.random.split(jax.random.key(0), N)
    state = jax.jit(jax.vmap(env.reset))(keys)
    step = jax.jit(jax.vmap(env.step))
    theirs = [gymnasium.make("Pendulum-v1", g=9.0) for _ in range(N)]
    for key, one, observation in zip(keys, theirs, state.obs, strict=True):
        seed = int(jax.random.key_data(key)[-1]) & 0x7FFFFFFF
        np.testing.assert_array_equal(one.reset(seed=seed)[0], observation)
    for action in np.random.default_rng(0).uniform(-1.5, 1.5, (20, N, 1)).astype(np.float32):
        state = step(state, action)
        for i, one in enumerate(theirs):
            observation, reward, *_ = one.step(np.clip(action[i], -1, 1) * np.float32(2))
            np.testing.assert_array_equal(observation, state.obs[i])
            assert np.float32(reward) == state.reward[i]


def test_an_episode_begins_once():
    """XLA may ask again for a start, and resets of a batch are padded with starts of others."""
    env = envs.make("gym:Pendulum-v1")
    key = jax.random.key(1)
    first = env.reset(key)
    after = env.step(first, jnp.ones(1))
    np.testing.assert_array_equal(env.reset(key).obs, first.obs)
    assert not np.array_equal(env.step(after, jnp.ones(1)).obs, after.obs)
    assert len(env._host._live) == 1


def test_what_has_ended_is_used_again():
    """As many instances as environments, and the one of the padding of the first episodes."""
    env = envs.with_episodes(envs.make("gym:Counter-v0", stops=False), T)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), N))
    step = jax.jit(jax.vmap(env.step))
    for t in range(1, 10 * T):
        state = step(state, jnp.zeros((N, 2)))
        assert (state.info["final_observation"] == (t - 1) % T + 1).all()
        assert state.info["truncated"].all() == (t % T == 0)
    host = env.env._host
    assert len(host._live) + len(host._free) <= N + 2


def test_an_episode_that_is_cut_off_early_is_counted():
    env = envs.with_episodes(envs.make("gym:Counter-v0"), T)
    state = env.reset(jax.random.key(0))
    for t in range(1, 7):
        state = env.step(state, jnp.zeros(2))
        assert bool(state.info["broken"]) == (t % 3 == 0)
        assert not state.info["terminated"]


def test_a_run_goes_on_with_new_episodes(tmp_path, caplog):
    changes = {"env": "gym:Pendulum-v1", "steps": 400, "replay_size": 1_000, "time_limit": 30}
    config = Config(**{**oracles.RUN.__dict__, **changes})
    half = begin(config, tmp_path / "run")
    half.go()
    before = oracles.newest_state(half.folder)
    updates = int(before.agent.learner.updates)
    run = take_up(tmp_path / "run", steps=500)
    assert "the episodes under way begin anew" in caplog.text
    run.go()
    state = oracles.newest_state(run.folder)
    assert int(state.replay.size) == 500 and int(state.agent.learner.updates) > updates
    assert float(state.totals.broken) == 0
    kept = jax.tree.map(lambda x: x[:400], oracles.stored(state))
    oracles.assert_equal(kept, oracles.stored(before))  # also what the last steps led to


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gym:mapg/Hopper-v5", "is one of ours: choose it by its own name, hopper"),
        ("gym:phys2d/Pendulum-v0", "runs JAX, which cannot be called"),
        ("gym:Nowhere-v0", "Gymnasium has no environment 'Nowhere-v0'"),
        (
            "gym:CartPole-v1",
            r"has actions in Discrete\(2\), and only flat boxes of numbers are taken$",
        ),
        ("gym:Counter-v0 low=0.0", "bounds must be finite and alike on both sides of 0"),
        ("gym:Pendulum-v1 gravity=3", "gym:Pendulum-v1 cannot be made: .*gravity"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(name, message):
    name, *options = name.split()
    parsed = {key: float(value) for key, value in (text.split("=") for text in options)}
    with pytest.raises(ValueError, match=message) as caught:
        envs.make(name, **parsed)
    assert len(str(caught.value).splitlines()) == 1
