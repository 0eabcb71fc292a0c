"""A3C: returns, losses and gradients against closed forms, what it learns, and that it resumes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.stats

from mapg_jax import load_policy
from mapg_jax.algorithms import a3c, returns
from mapg_jax.algorithms.a3c import UpdateMetrics
from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import adam
from mapg_jax.algorithms.networks import VARIANCE_FLOOR
from mapg_jax.runs.member import DivergedError
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.train import begin, take_up
from mapg_jax.training.config import Config
from mapg_jax.training.evaluation import play
from mapg_jax.training.trainer import make_trainer

TINY = Config(
    algorithm="a3c",
    environments=4,
    rollout_steps=5,
    hidden=(16, 16),
    layer_norm=False,
    normalize=False,
)
RUN = Config(
    algorithm="a3c", environments=4, rollout_steps=2, hidden=(8, 8), steps=800, time_limit=50,
    evaluate_every=200, evaluation_episodes=2, final_episodes=3, checkpoint_seconds=1e-9,
    checkpoints_kept=100,
)  # fmt: skip
"""A whole run in turns of 2 steps of 4 environments."""


def run(trainer, turns, seed=0):
    return trainer.jitted_run(trainer.jitted_init(seed), turns)


def rollout(observation, sample=None) -> Transition:
    """What losses read of a rollout."""
    return Transition(observation, sample, None, None, None, None)


def train_run(config, path):
    """The folder of a whole run, which is not scored."""
    whole = begin(config, path)
    whole.go()
    return whole.folder


def fresh():
    """The algorithm of TINY and an untrained learner of it."""
    algorithm = oracles.make_trainer(oracles.Side(), 10, TINY).agent.algorithm
    return algorithm, jax.jit(algorithm.init, static_argnums=1)(jax.random.key(1), 1)


# ----- returns


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_n_step_returns_against_a_slow_sum(steps):
    """Σ γ^k r to the end of the episode or of the rollout, then γ^k V unless it terminated."""
    rng = np.random.default_rng(steps)
    shape, discount = (steps, 50), 0.9
    reward, next_value = rng.normal(size=(2, *shape))
    terminated = rng.random(shape) < 0.2
    truncated = rng.random(shape) < 0.2
    expected = np.zeros(shape)
    for t in range(steps):
        for i in range(50):
            for k in range(t, steps):
                expected[t, i] += discount ** (k - t) * reward[k, i]
                if terminated[k, i] or truncated[k, i] or k == steps - 1:
                    if not terminated[k, i]:
                        expected[t, i] += discount ** (k - t + 1) * next_value[k, i]
                    break
    found = returns.n_step_returns(
        jnp.float32(reward),
        jnp.where(terminated, 0.0, jnp.float32(discount)),
        jnp.asarray(terminated | truncated),
        jnp.float32(next_value),
    )
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float32 sums of 7 terms near 1


# ----- the Gaussian


def test_density_and_entropy_are_the_multivariate_normals():
    rng = np.random.default_rng(0)
    for variance in (1e-4, 0.3, 2.0):
        mean, action = rng.normal(size=(2, 3))
        normal = scipy.stats.multivariate_normal(mean, variance * np.eye(3))
        found = a3c.log_probability(jnp.float32(action), jnp.float32(mean), jnp.float32(variance))
        np.testing.assert_allclose(found, normal.logpdf(action), rtol=1e-5)
        np.testing.assert_allclose(
            a3c.entropy(jnp.float32(variance), 3), normal.entropy(), rtol=1e-5
        )


def test_samples_have_the_mean_and_the_variance_of_the_network():
    """Of 100,000 draws the mean is within 5 σ / √n, the variance within 5 σ² √(2/n)."""
    algorithm, learner = fresh()
    n = 100_000
    observation = jnp.full((n, 1), 0.7)
    mean, variance = algorithm.gaussian(learner.actor, observation[0])
    draws = np.asarray(algorithm.sample(learner.actor, observation, jax.random.key(0)))[:, 0]
    sigma = float(jnp.sqrt(variance))
    assert abs(draws.mean() - float(mean[0])) < 5 * sigma / np.sqrt(n)
    assert abs(draws.var() - sigma**2) < 5 * sigma**2 * np.sqrt(2 / n)
    assert np.abs(draws).max() > 1  # what is executed is clipped, the sample is not
    state = oracles.make_trainer(oracles.Side(), 10, TINY).jitted_init(0).agent
    acted = algorithm.act(learner, state.hyper, observation, jax.random.key(0), select="uniform")
    np.testing.assert_array_equal(acted[:, 0], np.clip(draws, -1, 1))
    chosen = algorithm.act(learner, state.hyper, observation[:1], jax.random.key(0), select="mean")
    np.testing.assert_allclose(chosen[0], mean, atol=1e-6)


# ----- losses


def test_the_actors_gradient_is_the_closed_form():
    r"""One state, actions of two dimensions.

    With the gain $g = A \log\pi + \beta H$: $dg/d\mu = A (a - \mu) / \sigma^2$ and
    $dg/d\sigma^2 = A (\|a - \mu\|^2 / 2\sigma^4 - d / 2\sigma^2) + \beta d / 2\sigma^2$, d = 2.
    """
    d, beta = 2, 0.3
    network = a3c.GaussianActor(action_size=d, hidden=(4, 4), layer_norm=True)
    algorithm = a3c.A3c(network, a3c.StateCritic((4, 4), True), adam(None))
    observation = jnp.array([[0.4, -0.8]])
    actor = jax.jit(network.init)(jax.random.key(0), observation)
    action, advantage = np.array([[0.9, -1.3], [0.2, 0.1], [-2.0, 0.5]]), np.array([2.0, -1.0, 0.5])
    repeated = jnp.repeat(observation, 3, 0)[:, None]
    steps = rollout(repeated, jnp.float32(action)[:, None])

    def loss(actor):
        return algorithm.actor_loss(
            actor, steps, jnp.float32(advantage)[:, None], jnp.float32(beta)
        )[0]

    gradient = jax.jit(jax.grad(loss))(actor)["params"]
    (mean,), (variance,) = map(np.asarray, network.apply(actor, observation))
    difference = action - mean
    to_mean = (advantage[:, None] * difference / variance).mean(0)
    squares = (difference**2).sum(1)
    to_variance = (
        advantage * (squares / (2 * variance**2) - d / (2 * variance)) + beta * d / (2 * variance)
    ).mean()
    # The last biases: through tanh, 1 - μ²; through softplus, 1 - exp(-softplus).
    through = 1 - np.exp(-(variance - VARIANCE_FLOOR))
    np.testing.assert_allclose(gradient["Dense_2"]["bias"], -to_mean * (1 - mean**2), rtol=1e-4)
    np.testing.assert_allclose(gradient["Dense_3"]["bias"], [-to_variance * through], rtol=1e-4)


def test_the_critic_loss_is_the_mean_square():
    algorithm, learner = fresh()
    rng = np.random.default_rng(0)
    observation, returns = rng.normal(size=(3, 4, 1)), rng.normal(size=(3, 4))
    steps = rollout(jnp.float32(observation))
    value = np.asarray(algorithm.value(learner.critic, steps.observation))
    found = algorithm.critic_loss(learner.critic, steps, jnp.float32(returns))
    np.testing.assert_allclose(found, ((returns - value) ** 2).mean(), rtol=1e-5)


# ----- the rollout


@pytest.mark.parametrize("truncation", ["bootstrap", "terminal"])
def test_rollouts_are_the_environments(truncation):
    """RandomLength shows the steps left, so each row can be checked on its own."""
    config = dataclasses.replace(TINY, truncation=truncation, rollout_steps=60, normalize=True)
    trainer = oracles.make_trainer(oracles.RandomLength(), 5, config)
    state, collected = jax.jit(trainer.turn.collect)(trainer.jitted_init(0), jax.random.key(1))
    rows = collected.steps
    left, worth = np.moveaxis(np.asarray(rows.observation), -1, 0)
    executed = np.clip(rows.extra[..., 0], -1, 1)
    np.testing.assert_array_equal(rows.action[..., 0], executed)
    assert (executed != rows.extra[..., 0]).any()  # the sample is kept, and may lie outside
    np.testing.assert_allclose(rows.reward, left * worth + executed, rtol=1e-5)
    np.testing.assert_array_equal(rows.next_observation[..., 0], left - 1)
    steps = np.zeros(config.environments, int)
    for t in range(60):
        steps += 1
        terminated, truncated = left[t] == 1, steps == 5
        np.testing.assert_array_equal(collected.ended[t], terminated | truncated)
        ends = terminated | truncated if truncation == "terminal" else terminated
        np.testing.assert_array_equal(rows.terminal[t], ends)
        following = rows.observation[t + 1] if t < 59 else state.env.obs
        same = np.all(np.asarray(following) == np.asarray(rows.next_observation[t]), axis=-1)
        np.testing.assert_array_equal(same, ~(terminated | truncated))
        steps[terminated | truncated] = 0
    assert int(state.env_steps) == trainer.steps_per_turn == 60 * config.environments
    assert state.totals.episodes == np.asarray(collected.ended).sum() > 20

    # The statistics stand still while a turn lasts, and then hold every observation acted on.
    learned = jax.jit(trainer.turn.learn)(state, collected, jax.random.key(2))
    seen = np.concatenate([rows.observation, np.asarray(state.env.obs)[None]]).reshape(-1, 2)
    assert learned.agent.normalizer.count == len(seen)
    np.testing.assert_allclose(learned.agent.normalizer.mean, seen.mean(0), rtol=1e-5)
    assert state.agent.normalizer.count == config.environments


# ----- what it learns


def train(env, time_limit, turns, **changes):
    rates = {"actor_learning_rate": 3e-3, "critic_learning_rate": 1e-2}
    config = dataclasses.replace(TINY, environments=16, discount=0.5, **rates, **changes)
    trainer = oracles.make_trainer(env, time_limit, config)
    return trainer, run(trainer, turns)


@pytest.mark.parametrize(
    ("env", "time_limit", "changes", "values"),
    [
        (oracles.TwoSteps(), 10, {}, {0.0: 0.5, 1.0: 1.0}),
        # Reward 1 for ever at γ = ½ is worth 2 wherever the time limit cuts, also in the middle of
        # a rollout; where the limit counts as an end, 3 steps are worth 1 + ½ + ¼, 1 + ½ and 1, and
        # one that cannot tell them apart learns their mean, 17 / 12.
        (oracles.Endless(), 3, {"rollout_steps": 4}, {0.0: 2.0}),
        (
            oracles.Endless(),
            3,
            {"rollout_steps": 30, "truncation": "terminal"},
            {0.0: 17 / 12},
        ),
    ],
)
def test_trained_critic_matches_known_values(env, time_limit, changes, values):
    trainer, state = train(env, time_limit, turns=400, **changes)
    for observation, value in values.items():
        found = trainer.agent.algorithm.value(
            state.agent.learner.critic, jnp.array([observation], jnp.float32)
        )
        assert float(found) == pytest.approx(value, abs=0.05)


def test_the_mean_finds_the_best_action():
    """Reward s · a at s = ±1, a clipped to [-1, 1]: μ goes to s."""
    trainer, state = train(oracles.Side(), 10, turns=1_500)
    for side in (-1.0, 1.0):
        (mean,), _ = trainer.agent.algorithm.gaussian(state.agent.learner.actor, jnp.array([side]))
        assert float(mean) == pytest.approx(side, abs=0.1)


def test_entropy_keeps_the_variance_where_nothing_is_to_be_gained():
    """Reward 1 whatever is done: with a weight σ² grows beyond 1.2, without it stays near 0.69."""
    for weight, (low, high) in {0.0: (0.6, 0.8), 1.0: (1.2, np.inf)}.items():
        trainer, state = train(oracles.OneStep(), 10, turns=400, entropy_weight=weight)
        _, variance = trainer.agent.algorithm.gaussian(state.agent.learner.actor, jnp.zeros(1))
        assert low < float(variance) < high


@pytest.mark.slow
def test_it_learns_pendulum():
    """A random policy has about -1,200 and a good one -150; 600,000 steps give some -220."""
    trainer = make_trainer(Config(env="pendulum", algorithm="a3c", seed=100))
    state = run(trainer, 600_000 // trainer.steps_per_turn, seed=100)
    played = jax.jit(
        functools.partial(
            play, trainer.env.env, trainer.agent, episodes=50, time_limit=200, select="uniform"
        )
    )(state.agent, jax.random.key(0))
    assert played.returns.mean() > -300


# ----- a run


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The first of its checkpoints is at step 128."""
    return train_run(RUN, tmp_path_factory.mktemp("runs") / "pendulum")


def test_metrics_have_a_row_an_evaluation(finished):
    rows = read_metrics(finished.metrics)
    assert [row["env_steps"] for row in rows] == [200, 400, 600, 800]
    assert [row["updates"] for row in rows] == [25, 50, 75, 100]
    assert set(UpdateMetrics._fields) < set(rows[0])
    for row in rows:
        undefined = {"q_gap_relative", "optima_share"}  # V(s) has no slope in the action
        assert {name for name, value in row.items() if not np.isfinite(value)} <= undefined
        assert (row["spread"], row["q_gap"]) == (0, 0)  # of the one proposal there is
        # σ starts at √(log 2 + the floor), and 100 updates move it little.
        assert row["action_std"] == pytest.approx(np.log(2) ** 0.5, abs=0.05)
        assert row["entropy"] == pytest.approx(
            np.log(row["action_std"] * np.sqrt(2 * np.pi * np.e)), abs=0.01
        )


@pytest.mark.parametrize("upto", [128, 400])
def test_resuming_equals_not_stopping(finished, tmp_path, upto):
    folder = oracles.copy_run(finished, tmp_path / "run", upto)
    run = take_up(folder.path)
    assert run.env_steps == upto
    run.go()
    oracles.assert_same_run(folder, finished)


def test_a_finished_run_goes_further(finished, tmp_path):
    folder = train_run(dataclasses.replace(finished.config, steps=400), tmp_path / "run")
    take_up(folder.path, steps=800).go()
    oracles.assert_same_run(folder, finished)


def test_divergence_stops_at_its_step(tmp_path):
    """A rate of 1e30: the second update meets parameters near 1e30."""
    config = dataclasses.replace(RUN, critic_learning_rate=1e30)
    with pytest.raises(DivergedError, match="no longer finite at step 16"):
        train_run(config, tmp_path / "run")


def test_the_saved_policy_samples_or_takes_the_mean(finished):
    """Actions of Pendulum are twice the network's; 4,000 draws, within 5 standard errors."""
    rows = np.repeat(np.array([[0.6, 0.8, 1.0]], np.float32), 4_000, 0)
    mean = load_policy(finished.path, select="mean")(rows)
    drawn = load_policy(finished.path, seed=3)(rows)
    np.testing.assert_array_equal(mean, load_policy(finished.path).proposals(rows)[:, 0])
    assert (np.ptp(mean), len(np.unique(drawn)) > 1_000) == (0, True)
    assert np.abs(drawn).max() == 2  # clipped, alike on both sides as μ is near 0
    assert abs(drawn.mean() - mean.mean()) < 5 * drawn.std() / np.sqrt(4_000)
    np.testing.assert_array_equal(load_policy(finished.path, seed=3)(rows), drawn)


@pytest.mark.parametrize("select", ["first", "argmax-q"])
def test_choices_among_heads_are_refused(finished, select):
    with pytest.raises(ValueError, match=f"select must be one of uniform, mean, got '{select}'"):
        load_policy(finished.path, select=select)


def test_it_proposes_one_action_and_has_no_option_of_its_heads():
    assert Config(algorithm="a3c").heads == 1
    with pytest.raises(ValueError, match=r"heads is an option of mapg, .* and .*, not of a3c"):
        Config(algorithm="a3c", heads=1)
