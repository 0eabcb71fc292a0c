"""A saved policy in a plain Gymnasium loop."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax import load_policy
from mapg_jax.training.trainer import make_trainer


@pytest.fixture(scope="module")
def policy(finished_run):
    return load_policy(finished_run.path, seed=5)


def observations(n):
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, n)
    return np.stack([np.cos(angle), np.sin(angle), rng.uniform(-8, 8, n)], 1)


def test_numpy_in_float32_numpy_out(policy):
    for dtype in (np.float32, np.float64):
        one = policy(observations(1)[0].astype(dtype))
        many = policy(observations(6).astype(dtype))
        assert (type(one), one.dtype, one.shape) == (np.ndarray, np.float32, (1,))
        assert (type(many), many.dtype, many.shape) == (np.ndarray, np.float32, (6, 1))
    assert policy.proposals(observations(1)[0]).shape == (3, 1)
    assert policy.proposals(observations(6)).shape == (6, 3, 1)
    assert policy.proposals(observations(6)).dtype == np.float32


def test_actions_are_in_gymnasiums_units(policy, finished_run):
    """Pendulum's torque reaches 2 N m: actions are twice the networks' proposals."""
    trainer = make_trainer(finished_run.config)
    state = oracles.newest_state(finished_run).agent
    proposals, values = trainer.agent.proposals(state, jnp.asarray(observations(6), jnp.float32))
    np.testing.assert_allclose(policy.proposals(observations(6)), 2 * proposals, rtol=1e-6)
    np.testing.assert_allclose(policy.values(observations(6)), values, rtol=1e-5, atol=1e-6)


def test_every_action_is_a_proposal(policy):
    rows = observations(200)
    actions, proposals = policy(rows), policy.proposals(rows)
    match = actions[:, None] == proposals
    assert match.all(-1).any(-1).all()
    # Each of three heads 200 / 3 times, within 6 standard deviations.
    counts = match.all(-1).sum(0)
    assert np.abs(counts - 200 / 3).max() < 6 * np.sqrt(200 * 1 / 3 * 2 / 3)


def test_a_seed_is_repeatable_and_leaves_the_stream_alone(finished_run):
    rows = observations(50)
    plain, disturbed, other = (load_policy(finished_run.path, seed=s) for s in (5, 5, 6))
    stream = [plain(rows) for _ in range(3)]
    np.testing.assert_array_equal(disturbed(rows), stream[0])
    one, again = disturbed(rows, seed=7), disturbed(rows, seed=7)
    np.testing.assert_array_equal(one, again)
    np.testing.assert_array_equal(other(rows, seed=7), one)  # whatever the policy's own seed
    np.testing.assert_array_equal(disturbed(rows), stream[1])
    disturbed.proposals(rows)
    np.testing.assert_array_equal(disturbed(rows), stream[2])
    assert not np.array_equal(stream[0], stream[1])
    assert not np.array_equal(other(rows), stream[1])


def test_choices_of_a_head(finished_run):
    rows = observations(20)
    first = load_policy(finished_run.path, select="first")
    mean = load_policy(finished_run.path, select="mean")
    proposals = first.proposals(rows)
    np.testing.assert_array_equal(first(rows), proposals[:, 0])
    np.testing.assert_allclose(mean(rows), proposals.mean(1), atol=1e-6)  # float32
    best = load_policy(finished_run.path, select="argmax-q")
    _, values = best.agent.proposals(best.state, jnp.float32(rows))
    chosen = proposals[np.arange(20), np.asarray(values).argmax(-1)]
    np.testing.assert_array_equal(best(rows), chosen)


@pytest.mark.parametrize("shape", [(2,), (4,), (6, 2), (1, 6, 3), ()])
def test_a_wrong_observation_is_refused(policy, shape):
    text = r"an observation must be \[3\] or \[N, 3\], got \[" + ", ".join(map(str, shape))
    with pytest.raises(ValueError, match=text):
        policy(np.zeros(shape))
    with pytest.raises(ValueError, match=text):
        policy.proposals(np.zeros(shape))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_observation_that_is_not_finite_is_refused(policy, bad):
    """It would give an action that is not."""
    rows = observations(3)
    rows[1, 2] = bad
    for observation in (rows, rows[1]):
        with pytest.raises(ValueError, match="an observation must be finite"):
            policy(observation)
        with pytest.raises(ValueError, match="an observation must be finite"):
            policy.proposals(observation)


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_out_of_range_is_refused(policy, finished_run, seed):
    message = f"seed must be at least 0 and below 2147483648, got {seed}"
    with pytest.raises(ValueError, match=message):
        policy(observations(1)[0], seed=seed)
    with pytest.raises(ValueError, match=message):
        load_policy(finished_run.path, seed=seed)


def test_a_choice_that_the_algorithm_has_not_is_refused(finished_run):
    with pytest.raises(ValueError, match=r"select must be one of uniform, .*, got 'best'"):
        load_policy(finished_run.path, select="best")


def test_it_drops_into_a_gymnasium_loop(policy):
    env = gymnasium.make("Pendulum-v1")
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        action = policy(observation)
        assert env.action_space.contains(action)
        observation, *_ = env.step(action)
    vector = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync")
    observation, _ = vector.reset(seed=0)
    assert vector.action_space.contains(policy(observation))
    vector.close()


def test_the_global_random_state_is_not_touched(policy):
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    policy(observations(2))
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
