"""The mixture's density against SciPy and numerical integration, and its samples against it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from mapg_jax.algorithms.mixture import log_density
from mapg_jax.algorithms.on_policy import Choice
from mapg_jax.algorithms.ppo import Ppo, PpoOptions
from mapg_jax.algorithms.sac import Sac, SacOptions

M, PADDED = 3, 5


def test_it_is_the_mean_of_the_densities_and_padding_counts_nothing():
    rng = np.random.default_rng(0)
    mean, log_std = rng.normal(size=(PADDED, 2)), rng.normal(size=(PADDED, 2))
    x = rng.normal(size=(7, 2))
    found = log_density(*map(jnp.asarray, (x, mean, log_std)), jnp.int32(M))
    each = [stats.norm.pdf(x, mean[m], np.exp(log_std[m])).prod(-1) for m in range(M)]
    np.testing.assert_allclose(found, np.log(np.mean(each, 0)), rtol=1e-4, atol=1e-5)


@pytest.fixture(scope="module")
def sac():
    """A SAC of M heads that start apart, its learner and its numbers; an action is one number."""
    options = SacOptions(heads=M, hidden=(8, 8), head_spread=2.0)
    algorithm = Sac.make(options, 1)
    return (
        algorithm,
        jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 2),
        Sac.hyper(options),
    )


def squashed_density(mean, log_std, action):
    """Of one state's mixture after the tanh, by the change of variables, [len(action)]."""
    raw, slope = np.arctanh(action), 1 - action**2
    each = stats.norm.pdf(raw[:, None], mean[None], np.exp(log_std)[None])
    return each.mean(1) / slope


def test_sacs_density_is_one_over_all_actions_and_what_its_samples_follow(sac):
    """The integral over (-1, 1) is 1; 30,000 samples pass a Kolmogorov-Smirnov test."""
    algorithm, learner, hyper = sac
    observation = jnp.ones((30_000, 2))
    keys = jax.random.split(jax.random.key(1))
    drawn = jax.jit(algorithm.sample)(learner.actor, hyper, observation, keys[0])
    mean, log_std = (
        np.asarray(x)[0, :, 0] for x in algorithm.gaussians(learner.actor, observation[:1])
    )

    grid = np.tanh(np.linspace(-12, 12, 20_001))[1:-1]
    density = squashed_density(mean, log_std, grid)
    cdf = np.concatenate([[0], np.cumsum(np.diff(grid) * (density[1:] + density[:-1]) / 2)])
    assert cdf[-1] == pytest.approx(1, abs=1e-3)

    action = np.asarray(drawn.actions)[:2000, :, 0]
    expected = [np.log(squashed_density(mean, log_std, a)) for a in action.T.astype(np.float64)]
    np.testing.assert_allclose(
        np.asarray(drawn.log_density)[:2000].T, expected, rtol=1e-2, atol=1e-2
    )
    explored = jax.jit(algorithm.explore)(learner, hyper, (), observation, keys[1])
    sampled = np.asarray(explored.action)[:, 0]
    assert stats.kstest(sampled, lambda x: np.interp(x, grid, cdf)).pvalue > 1e-3


def test_what_ppo_stores_is_the_sample_of_the_head_that_acted():
    """By head, samples have that head's mean and deviation, within 6 standard errors."""
    options = PpoOptions(heads=M, hidden=(8, 8), head_spread=0.5)
    algorithm, hyper = Ppo.make(options, 1), Ppo.hyper(options)
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 2)
    observation = jnp.ones((30_000, 2))
    explored = jax.jit(algorithm.explore)(learner, hyper, (), observation, jax.random.key(1))
    mean = np.asarray(algorithm.gaussians(learner.actor, observation[:1])[0])[0, :, 0]
    choice = explored.extra
    assert isinstance(choice, Choice)
    np.testing.assert_array_equal(explored.action, np.clip(choice.sample, -1, 1))
    for m in range(M):
        sample = np.asarray(choice.sample)[np.asarray(choice.head) == m, 0]
        error = 1 / np.sqrt(len(sample))  # σ is 1
        assert abs(len(sample) - 10_000) < 6 * np.sqrt(30_000 * 2 / 9)
        assert abs(sample.mean() - mean[m]) < 6 * error
        assert abs(sample.std() - 1) < 6 * error


def test_padding_that_towers_over_the_mixture_leaves_its_gradient_finite():
    """A padded component whose density at x is e^200 times the others'."""
    mean, log_std = jnp.asarray([[1.0], [0.0]]), jnp.asarray([[-3.0], [-3.0]])
    slope = jax.grad(lambda x: log_density(x, mean, log_std, jnp.int32(1))[0])(jnp.zeros((1, 1)))
    np.testing.assert_allclose(slope, [[np.exp(6.0)]], rtol=1e-5)
