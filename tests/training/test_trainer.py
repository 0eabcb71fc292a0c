"""The loop: what is stored, how often it learns, that chunks change nothing, and what it learns."""

import dataclasses
import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from jax import export

import envs
from mapg_jax.algorithms import heads, registry
from mapg_jax.training.agent import Agent
from mapg_jax.training.config import Config, preset
from mapg_jax.training.state import tree_bytes
from mapg_jax.training.trainer import Trainer, make_trainer, run_keys

TIME_LIMIT = 5
LIGHT = dataclasses.replace(oracles.TINY, hidden=(4, 4), layer_norm=False, normalize=False)


@functools.cache
def random_length(**changes) -> Trainer:
    """Compiled once for the tests that share it."""
    config = dataclasses.replace(oracles.TINY, **changes)
    return oracles.make_trainer(oracles.RandomLength(), TIME_LIMIT, config)


def untrained() -> Trainer:
    """One that acts without noise, normalisation or learning."""
    return random_length(noise="none", learning_starts=10_000, normalize=False)


def counting(env: envs.Env, config: Config) -> Trainer:
    """One whose agent only counts its updates."""
    trainer = oracles.make_trainer(env, 1, config)
    agent = oracles.CountingAgent(**vars(trainer.agent))
    return dataclasses.replace(trainer, agent=agent)


def run(trainer: Trainer, turns: int, seed: int = 0):
    return trainer.jitted_run(trainer.jitted_init(seed), turns)


# ----- collecting


@pytest.mark.parametrize("truncation", ["bootstrap", "terminal"])
def test_stored_transitions_are_the_environments(truncation):
    """RandomLength shows the steps left, so each stored row can be checked on its own."""
    trainer = random_length(truncation=truncation, noise="none")
    state = run(trainer, 40)
    n = trainer.config.environments
    rows = jax.tree.map(
        lambda x: x.reshape(-1, n, *x.shape[1:]), oracles.stored(state)
    )  # [T, N, ...]
    left, worth = rows.observation[..., 0], rows.observation[..., 1]
    np.testing.assert_allclose(rows.reward, left * worth + rows.action[..., 0], rtol=1e-6)
    following = rows.next_observation[..., 0]
    np.testing.assert_array_equal(following, left - ~rows.terminal)  # nothing follows an end
    np.testing.assert_array_equal(rows.next_observation[..., 1], worth)

    steps = np.zeros(n, int)
    kinds = set()
    for t in range(40):
        steps += 1
        terminated, truncated = left[t] == 1, steps == TIME_LIMIT
        expected = terminated | truncated if truncation == "terminal" else terminated
        np.testing.assert_array_equal(rows.terminal[t], expected)
        ended = terminated | truncated
        if t + 1 < 40:  # what follows: the next step, or a fresh start
            same = np.all(rows.observation[t + 1] == rows.next_observation[t], axis=-1)
            np.testing.assert_array_equal(same, ~ended)
        steps[ended] = 0
        kinds |= set(zip(terminated.tolist(), truncated.tolist(), strict=True))
    assert kinds == {(False, False), (True, False), (False, True), (True, True)}


class Breaking(oracles.RandomLength):
    """Observes what is not a number one step before the end, or is rewarded by it at the end."""

    def step(self, state, action):
        after = super().step(state, action)
        left = after.obs[0]
        broken = jnp.where((left == 1) & (after.obs[1] > 0.5), jnp.nan, 0.0)
        reward = jnp.where(left == 0, jnp.inf, after.reward)
        return after.replace(obs=after.obs + broken, reward=reward)


@pytest.mark.parametrize("algorithm", ["mapg", "a3c"])
def test_what_is_not_finite_ends_its_episode_and_is_not_learnt_from(algorithm):
    changes = {"noise": "none"} if algorithm == "mapg" else {"rollout_steps": 5}
    config = preset("smoke", algorithm=algorithm, environments=4, hidden=(4, 4), **changes)
    trainer = oracles.make_trainer(Breaking(), 20, config)
    state = run(trainer, 40)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.agent.learner))
    assert int(state.diverged_at) == -1
    episodes, broken = int(state.totals.episodes), int(state.totals.broken)
    assert episodes == broken > 20  # no episode ends otherwise
    if state.replay is not None:
        assert int(state.replay.size) == int(state.env_steps) - broken
        rows = oracles.stored(state)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(rows))
        assert not rows.terminal.any()


def test_actions_are_the_drawn_heads_proposals():
    """Before the first update the actor is the initial one, so all proposals can be known."""
    trainer = untrained()
    rows = oracles.stored(run(trainer, 40))
    agent = trainer.jitted_init(0).agent
    proposals, _ = trainer.agent.proposals(agent, jnp.asarray(rows.observation))
    expected = np.asarray(proposals)[np.arange(len(rows.extra)), rows.extra]
    # A batch of 4 and one of 160 may round differently, and proposals are near 1e-3.
    np.testing.assert_allclose(rows.action, expected, atol=1e-6)
    assert set(rows.extra) == {0, 1, 2}


def test_noise_is_added_before_the_clip_and_grows_along_the_ladder():
    trainer = random_length(
        noise="gaussian", noise_scale=0.05, noise_scale_last=8.0, learning_starts=10_000
    )
    state = run(trainer, 40)
    actions = oracles.stored(state).action.reshape(-1, 4)
    assert np.abs(actions).max() == 1.0  # σ = 8 is clipped
    deviation = actions.std(0)
    assert (np.diff(deviation) > 0).all()
    # 40 draws of σ = 0.05: the deviation within 5 of its standard errors, σ / √(2 · 40).
    assert abs(deviation[0] - 0.05) < 5 * 0.05 / np.sqrt(80)


def test_noise_restarts_with_each_episode():
    trainer = random_length()
    assert trainer.config.noise == "ou"
    state = run(trainer, 1)
    ends = starts = 0
    for _ in range(40):
        ended = np.asarray(state.env.done) == 1
        assert not np.asarray(state.explorer.noise)[ended].any()
        assert np.asarray(state.explorer.noise)[~ended].all()
        ends, starts = ends + ended.sum(), starts + (~ended).sum()
        state = trainer.jitted_run(state, 1)
    assert ends > 20
    assert starts > 20


def test_finished_episodes_are_counted():
    """Totals against a slow loop over the stored rows."""
    trainer = random_length(noise="none")
    state = run(trainer, 40)
    n = trainer.config.environments
    rows = oracles.stored(state)
    returns, lengths = [], []
    for i in range(n):
        total, length = 0.0, 0
        for reward, left in zip(rows.reward[i::n], rows.observation[i::n, 0], strict=True):
            total, length = total + reward, length + 1
            if left == 1 or length == TIME_LIMIT:
                returns.append(total)
                lengths.append(length)
                total, length = 0.0, 0
    assert state.totals.episodes == len(returns) > 20
    assert state.totals.episode_length == sum(lengths)
    np.testing.assert_allclose(state.totals.episode_return, sum(returns), rtol=1e-5)  # float32


def test_the_normaliser_has_seen_what_the_agent_acted_on():
    trainer = random_length(noise="none")
    state = run(trainer, 40)
    seen = oracles.stored(state).observation.astype(np.float64)
    assert state.agent.normalizer.count == len(seen)
    np.testing.assert_allclose(state.agent.normalizer.mean, seen.mean(0), rtol=1e-5)
    off = run(untrained(), 40)
    assert off.agent.normalizer.count == 0


# ----- how often it learns


@pytest.mark.parametrize(
    ("ratio", "environments", "learning_starts"),
    [
        (0.5, 1, 7),
        (0.5, 16, 100),
        (1 / 512, 4, 30),
        (3.0, 1, 0),
        (1.37, 3, 20),
    ],
)
def test_updates_are_exactly_those_earned(ratio, environments, learning_starts):
    config = dataclasses.replace(
        LIGHT,
        updates_per_step=ratio,
        environments=environments,
        learning_starts=learning_starts,
    )
    trainer = counting(oracles.OneStep(), config)
    exact = Fraction(str(ratio)) if ratio != 1 / 512 else Fraction(1, 512)
    state = trainer.jitted_init(0)
    for turns, chunk in enumerate([1] * 40 + [600 - 40]):
        state = trainer.jitted_run(state, chunk)
        turns = turns + 1 if chunk == 1 else 600
        learning = sum(t * environments >= learning_starts for t in range(1, turns + 1))
        expected = int(learning * environments * exact)
        assert int(state.agent.learner.updates) == expected
        assert int(state.totals.updates) == expected
    assert int(state.env_steps) == 600 * environments
    assert expected > 0


def test_the_updates_of_a_turn_have_their_own_keys_and_batches():
    """Numbers of each are not all equal: n Σx² > (Σx)²."""
    config = dataclasses.replace(LIGHT, updates_per_step=4.0, learning_starts=0)
    state = run(counting(oracles.Side(), config), 1)
    n, sums = state.totals.updates, state.totals.update_metrics
    assert n == 16
    assert n * sums.actor_loss - sums.critic_loss**2 > 1  # keys
    assert n * sums.critic_gradient_norm - sums.q_mean**2 > 1  # batches


def test_before_learning_starts_nothing_is_learned():
    trainer = random_length()
    assert (trainer.config.learning_starts, trainer.config.environments) == (16, 4)
    first = jax.device_get(trainer.jitted_init(0).agent.learner)
    oracles.assert_equal(run(trainer, 3).agent.learner, first)
    assert run(trainer, 4).agent.learner.updates == 2


# ----- divergence


class Poisoned(Agent):
    """At its third update the metric number `hyper.heads`, from 1, is `hyper.discount`; else 0."""

    def learn(self, state, batch, key):
        learner = state.learner.replace(updates=state.learner.updates + 1)
        value = jnp.where(learner.updates == 3, state.hyper.discount, 0.0)
        count = len(self.algorithm.Metrics._fields)
        metrics = (jnp.where(state.hyper.heads == k, value, 0.0) for k in range(1, 1 + count))
        return state.replace(learner=learner), self.algorithm.Metrics(*metrics)


@pytest.mark.parametrize(
    ("config", "third"),
    [
        (LIGHT, 20),  # two updates a turn of 4 steps, the first ones at step 16
        (Config(algorithm="a3c", environments=4, rollout_steps=2, hidden=(4, 4)), 24),
    ],
    ids=["mapg", "a3c"],
)
def test_any_metric_that_is_not_finite_is_a_divergence_of_its_step(config, third):
    trainer = oracles.make_trainer(oracles.OneStep(), 5, config)
    trainer = dataclasses.replace(trainer, agent=Poisoned(**vars(trainer.agent)))
    for metric in range(1, 1 + len(trainer.agent.algorithm.Metrics._fields)):
        for value, expected in {np.nan: third, np.inf: third, -np.inf: third, 3e38: -1}.items():
            state = trainer.jitted_init(0)
            hyper = state.agent.hyper.replace(heads=jnp.int32(metric), discount=jnp.float32(value))
            state = state.replace(agent=state.agent.replace(hyper=hyper))
            state = trainer.jitted_run(state, 10)
            assert state.agent.learner.updates > 3
            assert int(state.diverged_at) == expected


# ----- chunks, seeds and padding


def test_where_the_host_cuts_changes_nothing():
    trainer = random_length()
    whole = run(trainer, 60)
    cut = trainer.jitted_init(0)
    for turns in (30, 1, 0, 29):
        cut = trainer.jitted_run(cut, turns)
    oracles.assert_equal(cut, whole)
    assert whole.agent.learner.updates > 100


def test_seeds_are_repeatable_and_differ():
    trainer = random_length()
    oracles.assert_equal(run(trainer, 10, seed=3), run(trainer, 10, seed=3))
    one, other = oracles.stored(run(trainer, 10, 3)), oracles.stored(run(trainer, 10, 4))
    for x, y in zip(one, other, strict=True):
        if x.dtype != bool:
            assert not np.array_equal(x, y)


def test_the_streams_of_a_seed_are_apart():
    keys = [jax.random.key_data(key).tolist() for key in (*run_keys(0), *run_keys(1))]
    assert len({tuple(key) for key in keys}) == 8


# ----- what it learns


def train(env, time_limit, turns, **changes):
    config = dataclasses.replace(
        LIGHT,
        hidden=(16, 16),
        environments=4,
        updates_per_step=1.0,
        replay_size=2_000,
        batch_size=32,
        discount=0.5,
        tau=0.05,
        critic_l2=0.0,
        critic_learning_rate=1e-2,
        actor_learning_rate=1e-2,
        noise="gaussian",
        noise_scale=0.5,
        **changes,
    )
    trainer = oracles.make_trainer(env, time_limit, config)
    return trainer, run(trainer, turns)


def q(trainer, state, observation, action):
    observation = jnp.asarray([observation], jnp.float32)
    actions = jnp.asarray([[[action]]], jnp.float32)
    return trainer.agent.algorithm.values(state.agent.learner.critic, observation, actions)[0, 0]


@pytest.mark.parametrize(
    ("env", "time_limit", "changes", "values"),
    [
        (oracles.TwoSteps(), 10, {}, {(0.0,): 0.5, (1.0,): 1.0}),
        # Reward 1 for ever at γ = ½ is worth 2, wherever the time limit cuts; where the limit
        # counts as an end, one of five steps is worth 1: Q = 1 + ½ · ⅘ · Q.
        (oracles.Endless(), 5, {}, {(0.0,): 2.0}),
        (oracles.Endless(), 5, {"truncation": "terminal"}, {(0.0,): 1 / 0.6}),
    ],
)
def test_trained_critic_matches_known_values(env, time_limit, changes, values):
    trainer, state = train(env, time_limit, turns=300, **changes)
    for observation, value in values.items():
        for action in (-1.0, 0.0, 1.0):
            assert float(q(trainer, state, observation, action)) == pytest.approx(value, abs=0.1)


@pytest.mark.parametrize("gradient", ["stored", "all"])
def test_every_head_finds_the_best_action(gradient):
    """Reward s · a at s = ±1: the critic knows it within 0.1, and all heads propose a = s."""
    trainer, state = train(oracles.Side(), 10, turns=400, gradient=gradient)
    for side in (-1.0, 1.0):
        for action in (-1.0, 0.0, 1.0):
            value = float(q(trainer, state, (side,), action))
            assert value == pytest.approx(side * action, abs=0.1)
        proposals, _ = trainer.agent.proposals(state.agent, jnp.array([side]))
        np.testing.assert_allclose(proposals, side, atol=0.1)
    assert heads.spread(proposals, jnp.int32(3)) < 0.1


# ----- memory and accelerators


@pytest.mark.parametrize(("env", "limit"), [("hopper", 80e6), ("humanoid", 1.5e9)])
def test_a_run_takes_the_memory_it_may(env, limit):
    trainer = make_trainer(Config(env=env))
    steps, observations = trainer.shapes.replay.data
    assert all(leaf.shape[0] == 1_000_000 for leaf in jax.tree.leaves(steps))
    assert 1_000_000 < len(observations) < 1_002_000
    assert 0.8 * limit < trainer.bytes < limit


def test_the_bytes_are_those_of_the_state():
    trainer = random_length()
    state = jax.device_get(
        jax.tree.map(
            lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x,
            trainer.jitted_init(0),
        )
    )
    assert trainer.bytes == tree_bytes(state) == sum(x.nbytes for x in jax.tree.leaves(state))


PARALLEL = [("hopper", name) for name in registry.names()] + [
    (name, "mapg") for name in envs.names() if "mjx" in envs.spec(name).engines
]


@pytest.mark.slow
@pytest.mark.parametrize("env, algorithm", sorted(set(PARALLEL)))
def test_the_parallel_preset_lowers_for_accelerators(env, algorithm, their_code):
    """4,096 environments of MJX, a whole chunk, without a GPU or a TPU."""
    config = preset("parallel", algorithm, env=env, engine="mjx")
    trainer = make_trainer(config)
    assert (config.environments, trainer.env.backend) == (4096, "mjx")
    lowered = export.export(trainer.jitted_run, platforms=("cuda", "tpu"))(
        trainer.shapes, jax.ShapeDtypeStruct((), jnp.int32)
    )
    assert lowered.platforms == ("cuda", "tpu")
    shapes = [x.shape for x in jax.tree.leaves(trainer.shapes)]
    assert [aval.shape for aval in lowered.out_avals] == shapes
