"""NAF's peaks: the maximum of Q is at the highest; one peak is NAF, step by step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slow_ddpg

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.naf import Landscape, Naf, NafOptions, q_value

M, PADDED, A = 3, 5, 2


def landscape(seed=0, states=4) -> Landscape:
    rng = np.random.default_rng(seed)
    cholesky = np.tril(rng.normal(size=(states, PADDED, A, A))) + 2 * np.eye(A)
    height = rng.normal(size=(states, PADDED))
    parts = (
        rng.normal(size=states),
        rng.uniform(-0.8, 0.8, (states, PADDED, A)),
        cholesky,
        height - height[:, :M].max(1, keepdims=True),
    )
    return Landscape(*(jnp.asarray(x, jnp.float32) for x in parts))


def test_the_maximum_of_q_is_at_the_highest_peak():
    """No action of a fine grid is worth more than V, and the highest peak is worth as much."""
    given = landscape()
    line = jnp.linspace(-1, 1, 81)
    grid = jnp.stack(jnp.meshgrid(line, line), -1).reshape(-1, 1, A)
    heads = jnp.int32(M)
    values = jax.vmap(lambda a: q_value(given, jnp.broadcast_to(a, (4, A)), heads))(grid)
    best = given.value
    assert (np.asarray(values).max(0) <= np.asarray(best) + 1e-5).all()
    peak = np.asarray(given.peaks)[np.arange(4), np.asarray(given.height)[:, :M].argmax(1)]
    np.testing.assert_allclose(q_value(given, jnp.asarray(peak), heads), best, rtol=1e-5)


def test_peaks_start_equally_high_and_apart():
    for heads in (1, 8):
        algorithm = Naf.make(NafOptions(heads=heads, hidden=(8, 8)), A)
        learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3)
        found = algorithm.landscape(learner.critic, jnp.zeros((2, 3)), jnp.int32(heads))  # biases
        assert not np.asarray(found.height).any()
        peaks = np.asarray(found.peaks)
        assert 0 < np.abs(peaks[:, 0]).max() < 0.003
        assert heads == 1 or peaks.std(1).max() >= 0.2
        diagonal = np.diagonal(np.asarray(found.cholesky), axis1=-2, axis2=-1)
        assert (diagonal > 0).all()
        assert not np.triu(np.asarray(found.cholesky), 1).any()


def make_batch(seed, size=12) -> Transition:
    rng = np.random.default_rng(seed)
    return Transition(
        observation=jnp.asarray(rng.normal(size=(size, 3)), jnp.float32),
        extra=(),
        action=jnp.asarray(rng.uniform(-1, 1, (size, A)), jnp.float32),
        reward=jnp.asarray(rng.normal(size=size), jnp.float32),
        terminal=jnp.asarray(rng.random(size) < 0.3),
        next_observation=jnp.asarray(rng.normal(size=(size, 3)), jnp.float32),
    )


@pytest.mark.parametrize(("heads", "padded"), [(1, 1), (3, 5)])
def test_an_update_is_nafs_of_the_highest_peak(heads, padded):
    """Three updates against Q = V + max_m (b_m - ½ (a - μ_m)ᵀ L_m L_mᵀ (a - μ_m)), and Adam.

    With one peak that is NAF, where there is no b.
    """
    options = NafOptions(heads=padded, hidden=(8, 8), learning_rate=1e-2, tau=0.1, discount=0.9)
    algorithm = Naf.make(options, A)
    hyper = Naf.hyper(dataclasses.replace(options, heads=heads))
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3)
    leaves, tree = jax.tree.flatten(learner.critic)
    plain = target = dict(enumerate(leaves))
    adam, update = slow_ddpg.Adam(1e-2), jax.jit(algorithm.update)

    def network(p, s):
        v, mean, cholesky, height = algorithm.critic.apply(jax.tree.unflatten(tree, p.values()), s)
        if heads == 1:
            return v, mean, cholesky, jnp.zeros((len(s), 1))
        b = height[:, :heads] - height[:, :heads].max(1, keepdims=True)
        return v, mean[:, :heads], cholesky[:, :heads], b

    @jax.jit
    def values(p, batch):
        v, mean, cholesky, b = network(p, batch.observation)
        each = []
        for m in range(heads):
            precision = cholesky[:, m] @ jnp.swapaxes(cholesky[:, m], 1, 2)
            away = batch.action - mean[:, m]
            each.append(v + b[:, m] - 0.5 * jnp.einsum("bi,bij,bj->b", away, precision, away))
        return jnp.stack(each, 1)

    @jax.jit
    def gradient(p, target, batch):
        y = batch.reward + 0.9 * (1 - batch.terminal) * network(target, batch.next_observation)[0]
        return jax.grad(lambda p: ((y - values(p, batch).max(1)) ** 2).mean())(p)

    for i in range(3):
        batch = make_batch(i)
        reached = len(set(np.asarray(values(plain, batch)).argmax(1))) / heads
        learner, metrics = update(learner, hyper, batch, jax.random.key(i))
        plain = adam(plain, gradient(plain, target, batch))
        target = {k: 0.9 * target[k] + 0.1 * plain[k] for k in plain}
        assert float(metrics.heads_reached) == pytest.approx(reached)
    for found, expected in ((learner.critic, plain), (learner.critic_target, target)):
        for x, y in zip(jax.tree.leaves(found), expected.values(), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=2e-5)


def test_a_unit_of_value_is_as_rewards_divided_by_it():
    """Parameters move alike, and Q is larger by the unit, to what Adam's ε makes of gradients."""
    found = []
    for unit in (1.0, 4.0):
        options = NafOptions(heads=M, hidden=(8, 8), learning_rate=1e-2, tau=0.1, value_unit=unit)
        algorithm, hyper = Naf.make(options, A), Naf.hyper(options)
        learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3)
        update = jax.jit(algorithm.update)
        for i in range(3):
            batch = make_batch(i)
            batch = batch._replace(reward=unit * batch.reward)
            learner, _ = update(learner, hyper, batch, jax.random.key(i))
        batch = make_batch(9)
        q = algorithm.q_values(learner, hyper, batch.observation, batch.action[:, None])
        found.append((learner.critic, q / unit))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3)
    jax.tree.map(close, *found)  # three steps of up to 1e-2


def test_a_large_number_beside_the_diagonal_stays_one():
    """Its exponential overflows; L and its gradient are finite, whichever triangle it is in."""
    algorithm = Naf.make(NafOptions(heads=1, hidden=(8, 8)), A)
    critic = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3).critic
    bias = critic["params"]["cholesky_bias"]

    def given(x):
        parameters = {**critic["params"], "cholesky_bias": jnp.reshape(x, bias.shape)}
        return algorithm.landscape(
            {"params": parameters}, jnp.zeros((1, 3)), jnp.int32(1)
        ).cholesky[0, 0]

    x = jnp.asarray([0.5, 95.0, 90.0, -1.0])
    expected = [[np.exp(0.5), 0.0], [90.0, np.exp(-1.0)]]
    np.testing.assert_allclose(given(x), expected, rtol=1e-5)
    slope = jax.grad(lambda x: given(x).sum())(x)
    np.testing.assert_allclose(slope, [np.exp(0.5), 0.0, 1.0, np.exp(-1.0)], rtol=1e-5)
