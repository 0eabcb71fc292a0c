"""How algorithms act in training and in evaluation: heads are drawn, best ones are the best."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import norm

from mapg_jax.algorithms import registry

M, PADDED, A, N = 3, 5, 2, 20_000
SEEN = jnp.broadcast_to(jnp.asarray([0.3, -0.5, 0.9]), (N, 3))  # one state, N times


@functools.cache
def begun(name, **options):
    """An algorithm whose heads lie apart, a fresh learner of it, and its numbers."""
    kind = registry.find(name)
    options = {"hidden": (8, 8), "head_spread": 1.0, **options}
    algorithm = kind.make(kind.Options(heads=PADDED, **options), A)
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), SEEN.shape[1])
    return algorithm, learner, kind.hyper(kind.Options(heads=M, **options))


def explored(name, **options):
    """What it does in training, N times in one state."""
    algorithm, learner, hyper = begun(name, **options)
    carried = algorithm.explorer(N)
    return jax.jit(algorithm.explore)(learner, hyper, carried, SEEN, jax.random.key(1))


def distance(sample, distribution):
    """Kolmogorov's, of a sample from a distribution function, at points of (-1, 1)."""
    points = np.linspace(-0.99, 0.99, 67)
    found = (np.asarray(sample)[:, None] <= points).mean(0)
    return np.abs(found - distribution(points)).max()


def bound(n):
    """What it exceeds with a probability of a billionth at most (Dvoretzky, Kiefer, Wolfowitz)."""
    return np.sqrt(np.log(2 / 1e-9) / (2 * n))


@pytest.mark.parametrize("name", ["mapg", "td3", "naf"])
def test_without_noise_a_proposal_acts_and_each_as_often(name):
    algorithm, learner, hyper = begun(name, noise="none")
    acted = explored(name, noise="none").action
    proposals, _ = algorithm.proposals(learner, hyper, SEEN[:1])
    far = np.abs(np.asarray(acted)[:, None] - np.asarray(proposals)).max(-1)
    assert far.min(1).max() < 1e-6
    counts = np.bincount(far.argmin(1), minlength=PADDED)
    assert not counts[M:].any()
    assert np.abs(counts[:M] - N / M).max() < 5 * np.sqrt(N * (1 / M) * (1 - 1 / M))


@pytest.mark.parametrize("name", ["sac", "ppo", "trpo"])
def test_samples_are_of_the_mixture(name):
    """In training and by `sample`: their distribution function, coordinate by coordinate."""
    algorithm, learner, hyper = begun(name)
    mean, log_std = algorithm.gaussians(learner.actor, SEEN[:1])
    mean, scale = np.asarray(mean[0, :M]), np.exp(np.asarray(log_std[0, :M]))

    def of_components(points, axis):
        raw = np.arctanh(points) if name == "sac" else points
        return norm.cdf(raw[None], mean[:, axis, None], scale[:, axis, None])

    act = jax.jit(functools.partial(algorithm.act, select="sample"))
    for actions in (explored(name).action, act(learner, hyper, SEEN, jax.random.key(2))):
        alone = np.zeros(M)
        for axis in range(A):
            far = functools.partial(distance, actions[:, axis])
            assert far(lambda x, i=axis: of_components(x, i).mean(0)) < bound(N)
            of_each = [far(lambda x, i=axis, m=m: of_components(x, i)[m]) for m in range(M)]
            alone = np.maximum(alone, of_each)
        assert alone.min() > bound(N)  # no component alone would pass


@pytest.mark.parametrize("name", ["mapg", "td3", "sac", "naf"])
def test_argmax_q_is_the_proposal_that_the_critic_values_most(name):
    """Of parameters pushed about, since NAF's peaks start equally high."""
    algorithm, learner, hyper = begun(name)
    flat, unravel = ravel_pytree(learner)
    learner = unravel(flat + 0.3 * jax.random.normal(jax.random.key(5), flat.shape))
    seen = jax.random.normal(jax.random.key(3), (64, SEEN.shape[1]))
    proposals, _ = algorithm.proposals(learner, hyper, seen)
    proposals = proposals[:, :M]
    values = np.asarray(algorithm.q_values(learner, hyper, seen, proposals))
    acted = algorithm.act(learner, hyper, seen, jax.random.key(4), "argmax-q")
    best = np.take_along_axis(np.asarray(proposals), values.argmax(1)[:, None, None], 1)[:, 0]
    np.testing.assert_allclose(acted, best, rtol=0, atol=1e-6)
    assert np.ptp(values, axis=1).min() > 1e-3


@pytest.mark.parametrize("name", ["mapg", "td3", "sac"])
def test_a_random_start_is_uniform_until_the_first_update(name):
    algorithm, learner, hyper = begun(name, random_start=True)
    act = jax.jit(algorithm.explore)

    def acted(updates):
        begun_at = learner.replace(updates=jnp.int32(updates))
        carried = algorithm.explorer(N)
        return act(begun_at, hyper, carried, SEEN, jax.random.key(1)).action

    assert max(distance(acted(0)[:, i], lambda x: (x + 1) / 2) for i in range(A)) < bound(N)
    np.testing.assert_array_equal(acted(1), explored(name).action)
