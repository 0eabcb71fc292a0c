"""Episodes of a policy, as they are recorded and drawn; an environment's own numbers in a run."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import envs
from mapg_jax.reports.results import read_run
from mapg_jax.runs.episode import draw, player, record
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.policy import open_policy
from mapg_jax.runs.scoring import evaluate
from mapg_jax.runs.train import begin

CONFIG = dataclasses.replace(
    oracles.RUN,
    env="multi_goal",
    env_options=("goals=three",),
    time_limit=None,
    steps=200,
    checkpoint_seconds=300.0,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """On multi_goal, with three goals; its policy has hardly learned."""
    run = begin(CONFIG, tmp_path_factory.mktemp("runs") / "points")
    run.go()
    return run.folder


@pytest.fixture(scope="module")
def policy(run):
    return open_policy(run)


def test_what_is_recorded_is_what_was_played(policy):
    """From each start the recorded actions lead through the recorded states, to the last bit."""
    env = policy.env
    episodes = record(policy, 7, episodes=3, seed=1)
    step = jax.jit(env.step)
    for episode in episodes:
        assert episode.actions.shape == (7, 2)
        state = env.reset_to(episode.states[0])
        for t, action in enumerate(episode.actions):
            np.testing.assert_array_equal(episode.observations[t], state.obs)
            state = step(state, jnp.asarray(action))
            np.testing.assert_array_equal(episode.states[t + 1], state.pipeline_state)
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.split(jax.random.key(1))[0], 3)).obs
    np.testing.assert_array_equal([e.observations[0] for e in episodes], starts)


def test_an_episode_ends_with_the_state_that_ended_it(policy, monkeypatch):
    """Here one step does, which brings the point within 20 of a goal."""
    monkeypatch.setattr(policy.env, "radius", 20.0)
    for episode in record(policy, 30, episodes=2):
        assert (episode.states.shape, episode.observations.shape) == ((2, 2), (2, 2))
        np.testing.assert_array_equal(
            episode.states[1],
            policy.env.move(*map(jnp.asarray, (episode.states[0], *episode.actions))),
        )


def test_the_player_knows_the_policys_proposals_and_their_values(policy):
    rows = np.random.default_rng(0).uniform(-7, 7, (5, 2)).astype(np.float32)
    proposals, values = player(policy).proposals(rows)
    # float32, by several programs
    np.testing.assert_allclose(proposals, policy.proposals(rows), rtol=0, atol=1e-6)
    got = player(policy).q_values(rows, proposals)
    np.testing.assert_allclose(got, values, rtol=0, atol=1e-5)
    other = player(policy).q_values(rows, np.zeros((5, 4, 2)))
    assert other.shape == (5, 4)
    np.testing.assert_array_equal(other, np.tile(other[:, :1], 4))


def test_an_environments_numbers_are_in_every_row_and_in_the_score(run):
    names = [m.name for m in run.config.make_env().scored_metrics]
    assert names == [
        "goals_reached",
        "goal_entropy",
        "goal_1_share",
        "goal_2_share",
        "goal_3_share",
    ]
    rows = read_metrics(run.metrics)
    assert rows and all(set(names) <= row.keys() for row in rows)
    assert all(0 <= row[name] <= 3 for row in rows for name in names)
    score = evaluate(run)
    assert json.loads(run.evaluation.read_text())["scored"] == score["scored"]
    goals = score["metrics"]["goal"]
    shares = {f"goal_{i}_share": goals.count(i) / len(goals) for i in (1, 2, 3)}
    assert read_run(run).metrics == score["scored"]
    assert 0 <= score["scored"].pop("goal_entropy") <= 1
    assert score["scored"] == {"goals_reached": len(set(goals) - {0}), **shares}


def test_wrapped_environments_keep_what_they_count_and_draw():
    bare = envs.make("multi_goal", goals="three")
    wrapped = envs.with_episodes(bare, 30)
    assert wrapped.scored_metrics == bare.scored_metrics
    assert wrapped.drawn_episodes == bare.drawn_episodes == 20


def test_a_run_is_drawn(run):
    paths = draw(run, seed=2)
    assert [path.name for path in paths] == ["paths.png", "paths.html"]
    assert "multi_goal, three goals" in paths[1].read_text()
