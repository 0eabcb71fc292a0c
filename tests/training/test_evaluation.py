"""E episodes are E starts; returns and the statistics of the heads against a slow loop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.stats

from mapg_jax.algorithms import heads
from mapg_jax.training.agent import hyperparameters, make_agent
from mapg_jax.training.evaluation import play, summarize

EPISODES, TIME_LIMIT = 24, 7
ENV = oracles.RandomLength()
CONFIG = dataclasses.replace(oracles.TINY, heads=3)


@pytest.fixture(scope="module")
def agent_and_state():
    """An agent whose proposals and values are far apart, and whose normaliser has seen a little."""
    agent = make_agent(CONFIG, ENV.action_size)
    init = jax.jit(agent.init, static_argnums=2)
    state = init(jax.random.key(1), hyperparameters(CONFIG), ENV.observation_size)
    state = agent.see(state, jnp.array([[1.0, 0.2], [9.0, 0.9]]))

    def grown(params):
        last = {k: 300 * params["params"][k] for k in ("kernel", "bias")}
        return {"params": {**params["params"], **last}}

    learner = state.learner
    learner = learner.replace(actor=grown(learner.actor), critic=grown(learner.critic))
    return agent, state.replace(learner=learner)


def slow_play(agent, state, key, select):
    """One episode after the other, one state at a time; the same draws as `play`."""
    start_key, head_key = jax.random.split(key)
    look = jax.jit(agent.proposals)
    step, reset = jax.jit(ENV.step), jax.jit(ENV.reset)
    returns, lengths, spreads, gaps, means, distances, shares = [], [], [], [], [], [], []
    lattice = jnp.linspace(-1, 1, 41)[:, None]
    for episode, start in enumerate(jax.random.split(start_key, EPISODES)):
        env_state, total, t = reset(start), 0.0, 0
        q_values = agent.q_values(state, env_state.obs, lattice)
        shares.append(oracles.optima_share(q_values, look(state, env_state.obs)[0]))
        while True:
            proposals, values = map(np.asarray, look(state, env_state.obs))
            spreads.append(oracles.spread(proposals))
            gaps.append(oracles.q_gap(values))
            distances.append(oracles.distance(proposals))
            means.append(values.astype(np.float64).mean())
            head = {
                "uniform": heads.draw(jax.random.fold_in(head_key, t), jnp.int32(3), (EPISODES,))[
                    episode
                ],
                "argmax-q": values.argmax(),
                "first": 0,
                "mean": None,
            }[select]
            action = proposals.mean(0) if head is None else proposals[head]
            env_state, t = step(env_state, jnp.asarray(action)), t + 1
            total += float(env_state.reward)
            if env_state.done or t == TIME_LIMIT:
                break
        returns.append(total)
        lengths.append(t)
    gap = np.mean(gaps)
    statistics = np.mean(spreads), gap, gap / np.std(means), np.mean(distances), np.nanmean(shares)
    return returns, lengths, statistics


@pytest.mark.parametrize("select", ["uniform", "argmax-q", "mean", "first"])
def test_play_is_the_slow_loop(agent_and_state, select):
    agent, state = agent_and_state
    key = jax.random.key(0)
    played = jax.jit(
        lambda state, key: play(
            ENV, agent, state, key, episodes=EPISODES, time_limit=TIME_LIMIT, select=select
        )
    )(state, key)
    returns, lengths, statistics = slow_play(agent, state, key, select)
    np.testing.assert_array_equal(played.lengths, lengths)
    starts = jax.vmap(ENV.reset)(jax.random.split(jax.random.split(key)[0], EPISODES)).obs[:, 0]
    np.testing.assert_array_equal(played.lengths, np.minimum(starts, TIME_LIMIT))
    left = np.maximum(starts - TIME_LIMIT, 0)  # as the last step of each left it
    np.testing.assert_array_equal(played.metrics["left"], left)
    # float32 sums over at most 7 steps, and over about 110 states; a batch may round differently.
    np.testing.assert_allclose(played.returns, returns, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(played.heads, statistics, rtol=1e-3)
    assert played.heads.spread > 0.1  # there is something to compare
    assert played.heads.q_gap > 0.01


def test_summaries_are_students():
    returns = np.random.default_rng(0).normal(100.0, 10.0, 20)
    summary = summarize(returns)
    expected = scipy.stats.ttest_1samp(returns, 0).confidence_interval(0.95)
    assert summary.mean == pytest.approx(returns.mean(), rel=1e-12)
    assert summary.std == pytest.approx(returns.std(ddof=1), rel=1e-12)
    assert summary.ci95 == pytest.approx(tuple(expected), rel=1e-12)
    assert summary.episodes == 20


def test_the_interval_covers_the_mean_as_often_as_it_says():
    """2,000 samples of 5 normal returns: coverage within 5 standard errors of 95 %."""
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(2000):
        low, high = summarize(rng.normal(size=5)).ci95
        covered += low <= 0 <= high
    assert abs(covered / 2000 - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 2000)


def test_one_episode_has_no_spread():
    assert summarize([3.0]) == (3.0, 0.0, (3.0, 3.0), 1)
