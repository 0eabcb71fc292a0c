"""Bandits: their reward, their optima, and which of them an action lies at."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs

NAMES = ["two_mode_bandit", "four_bump_bandit"]
PUBLISHED = {  # centre, σ, height
    "two_mode_bandit": [((-0.6,), 2**-0.5, 0.0), ((0.6,), 6**-0.5, 0.0)],
    "four_bump_bandit": [
        ((-0.2, 0), 0.08, 0.21),
        ((-0.15, 0), 0.08, 0.21),
        ((0.15, 0), 0.08, 0.20),
        ((0.7, 0), 0.08, 0.23),
    ],
}


def rewards(name, actions):
    """Of every action, [N]."""
    env = envs.make(name)
    start = env.reset(jax.random.key(0))
    return np.asarray(jax.jit(jax.vmap(lambda a: env.step(start, a)))(jnp.asarray(actions)).reward)


@pytest.mark.parametrize("name", NAMES)
def test_rewards_are_the_published_ones(name):
    env = envs.make(name)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.2, 1.2, (500, env.action_size))  # clipped to ±1
    expected = [
        max(h - np.sum((np.clip(a, -1, 1) - c) ** 2) / (2 * s**2) for c, s, h in PUBLISHED[name])
        for a in actions
    ]
    # float32 rounds terms of up to 300.
    np.testing.assert_allclose(rewards(name, actions), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_search_of_the_actions_finds_the_optima(name):
    """On a grid of 0.01, which has the centres, no others are above their neighbours."""
    env = envs.make(name)
    size = env.action_size
    side = np.linspace(-1, 1, 201)
    grid = np.stack(np.meshgrid(*[side] * size, indexing="ij"), -1)
    values = rewards(name, grid.reshape(-1, size)).reshape(grid.shape[:-1])
    padded = np.pad(values, 1, constant_values=-np.inf)
    centre = (slice(1, -1),) * size
    best = np.full(values.shape, True)
    for shift in itertools.product((-1, 0, 1), repeat=size):
        if any(shift):
            best &= values > np.roll(padded, shift, range(size))[centre]
    found = sorted(map(tuple, grid[best].round(6)))
    assert found == sorted(c for c, _, _ in PUBLISHED[name])
    np.testing.assert_allclose(rewards(name, env.optima), env.heights, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "action", "optimum"),
    [
        ("two_mode_bandit", [-0.6], 1),
        ("two_mode_bandit", [0.64], 2),
        ("two_mode_bandit", [0.66], 0),
        ("two_mode_bandit", [0.0], 0),
        ("four_bump_bandit", [-0.2, 0.04], 1),
        ("four_bump_bandit", [-0.18, 0], 1),  # nearer to 1 than to 2
        ("four_bump_bandit", [-0.17, 0], 2),
        ("four_bump_bandit", [0.15, 0.06], 0),
        ("four_bump_bandit", [0.7, 0], 4),
    ],
)
def test_an_action_lies_at_the_optimum_that_pays_for_it(name, action, optimum):
    env = envs.make(name)
    state = env.step(env.reset(jax.random.key(0)), jnp.asarray(action))
    assert state.metrics["optimum"] == optimum
    assert (state.done, state.metrics.keys()) == (1, {"optimum"})
    np.testing.assert_array_equal(state.obs, np.float32(action))


def test_what_a_score_counts():
    optima = [4, 4, 0, 1]  # of four episodes
    numbers = {m.name: m.over(optima) for m in envs.make("four_bump_bandit").scored_metrics}
    entropy = (np.log(3) / 3 + np.log(3 / 2) * 2 / 3) / np.log(4)
    assert numbers.pop("optimum_entropy") == pytest.approx(entropy, rel=1e-12)
    assert numbers == {
        "optima_reached": 2,
        "optimum_1_share": 0.25,
        "optimum_2_share": 0,
        "optimum_3_share": 0,
        "optimum_4_share": 0.5,
    }


@pytest.mark.parametrize("name", NAMES)
def test_they_are_drawn(name, player, tmp_path):
    env = envs.make(name)
    start = np.asarray(env.reset(jax.random.key(0)).obs)
    asked = []

    def value(observations, actions):
        asked.append(np.shape(actions))
        return -np.square(actions).sum(-1)

    episodes = [
        envs.Episode(np.stack([start, a]), np.stack([start, a]), a[None]) for a in env.optima
    ]
    (picture,) = env.render(episodes, player(env.optima, value), tmp_path)
    assert picture.name == "actions.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert max(k for _, k, _ in asked) >= 201  # the critic, over all actions
