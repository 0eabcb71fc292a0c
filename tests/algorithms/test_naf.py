"""NAF's peaks: the maximum of Q is at the highest; one peak is NAF, step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import slow_ddpg

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.naf import Landscape, Naf, NafOptions, maximum, q_value

M, PADDED, A = 3, 5, 2


def landscape(seed=0, states=4) -> Landscape:
    rng = np.random.default_rng(seed)
    cholesky = np.tril(rng.normal(size=(states, PADDED, A, A))) + 2 * np.eye(A)
    parts = (
        rng.normal(size=states),
        rng.uniform(-0.8, 0.8, (states, PADDED, A)),
        cholesky,
        rng.normal(size=(states, PADDED)),
    )
    return Landscape(*(jnp.asarray(x, jnp.float32) for x in parts))


def test_the_maximum_of_q_is_at_the_highest_peak():
    """No action of a fine grid is worth more than V, and the highest peak is worth as much."""
    given = landscape()
    line = jnp.linspace(-1, 1, 81)
    grid = jnp.stack(jnp.meshgrid(line, line), -1).reshape(-1, 1, A)
    heads = jnp.int32(M)
    values = jax.vmap(lambda a: q_value(given, jnp.broadcast_to(a, (4, A)), heads))(grid)
    best = maximum(given, heads)
    assert (np.asarray(values).max(0) <= np.asarray(best) + 1e-5).all()
    peak = np.asarray(given.peaks)[np.arange(4), np.asarray(given.height)[:, :M].argmax(1)]
    np.testing.assert_allclose(q_value(given, jnp.asarray(peak), heads), best, rtol=1e-5)
    expected = np.asarray(given.level) + np.asarray(given.height)[:, :M].max(1)
    np.testing.assert_allclose(best, expected, rtol=1e-6)


def test_peaks_start_equally_high_and_apart():
    for heads, apart in ((1, 0.0), (8, 0.2)):
        algorithm = Naf.make(NafOptions(heads=heads, hidden=(8, 8)), A)
        learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3)
        found = algorithm.landscape(learner.critic, jnp.ones((2, 3)))
        assert not np.asarray(found.height).any()
        assert np.asarray(found.peaks).std(1).max() >= apart
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


def test_one_peak_is_naf():
    """Three updates against Q = V - ½ (a - μ)ᵀ L Lᵀ (a - μ) and Adam, written plainly."""
    options = NafOptions(heads=1, hidden=(8, 8), learning_rate=1e-2, tau=0.1, discount=0.9)
    algorithm, hyper = Naf.make(options, A), Naf.hyper(options)
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), 3)
    leaves, tree = jax.tree.flatten(learner.critic)
    plain = target = dict(enumerate(leaves))
    adam, update = slow_ddpg.Adam(1e-2), jax.jit(algorithm.update)

    def network(p, s):
        v, mean, cholesky, height = algorithm.critic.apply(jax.tree.unflatten(tree, p.values()), s)
        return v + height[:, 0], mean[:, 0], cholesky[:, 0]

    @jax.jit
    def gradient(p, target, batch):
        y = batch.reward + 0.9 * (1 - batch.terminal) * network(target, batch.next_observation)[0]

        def loss(p):
            v, mean, cholesky = network(p, batch.observation)
            precision = cholesky @ jnp.swapaxes(cholesky, 1, 2)
            away = batch.action - mean
            q = v - 0.5 * jnp.einsum("bi,bij,bj->b", away, precision, away)
            return ((y - q) ** 2).mean()

        return jax.grad(loss)(p)

    for i in range(3):
        batch = make_batch(i)
        learner, metrics = update(learner, hyper, batch, jax.random.key(i))
        plain = adam(plain, gradient(plain, target, batch))
        target = {k: 0.9 * target[k] + 0.1 * plain[k] for k in plain}
        assert metrics.heads_reached == 1
    for found, expected in ((learner.critic, plain), (learner.critic_target, target)):
        for x, y in zip(jax.tree.leaves(found), expected.values(), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=2e-5)
