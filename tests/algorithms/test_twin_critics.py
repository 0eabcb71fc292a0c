"""TD3 and SAC with one head, step by step against plain versions of their papers; and padding."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slow_ddpg

from mapg_jax.algorithms import heads
from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.sac import Sac, SacOptions
from mapg_jax.algorithms.td3 import Td3, Td3Options

B, D, A = 12, 3, 2
SHARED = {
    "heads": 1, "hidden": (8, 8), "tau": 0.1, "discount": 0.9, "actor_learning_rate": 1e-2,
    "critic_learning_rate": 1e-2,
}  # fmt: skip
CLOSE = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=2e-5)


def make_batch(seed: int, acting: int = 1) -> Transition:
    rng = np.random.default_rng(seed)
    return Transition(
        observation=jnp.asarray(rng.normal(size=(B, D)), jnp.float32),
        extra=jnp.asarray(rng.integers(0, acting, B), jnp.uint8),
        action=jnp.asarray(rng.uniform(-1, 1, (B, A)), jnp.float32),
        reward=jnp.asarray(rng.normal(size=B), jnp.float32),
        terminal=jnp.asarray(rng.random(B) < 0.3),
        next_observation=jnp.asarray(rng.normal(size=(B, D)), jnp.float32),
    )


def begun(kind, options):
    algorithm = kind.make(options, A)
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), D)
    return algorithm, learner, kind.hyper(options)


class Descent:
    """Adam on a tree of parameters."""

    def __init__(self, rate):
        self.adam = slow_ddpg.Adam(rate)

    def __call__(self, params, gradient):
        leaves, tree = jax.tree.flatten(params)
        moved = self.adam(dict(enumerate(leaves)), dict(enumerate(jax.tree.leaves(gradient))))
        return jax.tree.unflatten(tree, [moved[i] for i in range(len(leaves))])


def blend(target, online):
    return jax.tree.map(lambda x, y: 0.9 * x + 0.1 * y, target, online)


def twin(algorithm, critic, s, a):
    """Both values of an action a state, one critic at a time."""
    each = [jax.tree.map(lambda x, i=i: x[i], critic) for i in range(2)]
    return [algorithm.critic.apply(p, s, a[:, None])[:, 0] for p in each]


def test_one_head_is_td3():
    """Four updates, of which the second and the fourth move actor and targets."""
    algorithm, learner, hyper = begun(Td3, Td3Options(**SHARED))
    actor, critic = learner.actor, learner.critic
    actor_target, critic_target = actor, critic
    actor_adam, critic_adam = Descent(1e-2), Descent(1e-2)

    @jax.jit
    def critic_gradient(critic, actor_target, critic_target, batch, key):
        noise = 0.2 * heads.normal(jax.random.split(key)[1], (B, 1, A))[:, 0]
        a = algorithm.actor.apply(actor_target, batch.next_observation)[:, 0]
        a = jnp.clip(a + jnp.clip(noise, -0.5, 0.5), -1, 1)
        q = jnp.minimum(*twin(algorithm, critic_target, batch.next_observation, a))
        y = batch.reward + 0.9 * (1 - batch.terminal) * q

        def loss(p):
            one, two = twin(algorithm, p, batch.observation, batch.action)
            return ((y - one) ** 2).mean() + ((y - two) ** 2).mean()

        return jax.grad(loss)(critic)

    @jax.jit
    def actor_gradient(actor, critic, s):
        def loss(p):
            return -twin(algorithm, critic, s, algorithm.actor.apply(p, s)[:, 0])[0].mean()

        return jax.grad(loss)(actor)

    update = jax.jit(algorithm.update)
    for i in range(4):
        batch, key = make_batch(i), jax.random.key(i)
        learner, _ = update(learner, hyper, batch, key)
        target_key, _ = jax.random.split(key)
        critic = critic_adam(
            critic, critic_gradient(critic, actor_target, critic_target, batch, target_key)
        )
        if i % 2 == 1:
            actor = actor_adam(actor, actor_gradient(actor, critic, batch.observation))
            actor_target, critic_target = (
                blend(actor_target, actor),
                blend(critic_target, critic),
            )
    expected = actor, critic, actor_target, critic_target
    found = learner.actor, learner.critic, learner.actor_target, learner.critic_target
    jax.tree.map(CLOSE, found, expected)


def test_one_component_is_sac():
    """Three updates; the density of the tanh-Gaussian is written out."""
    options = SacOptions(**SHARED, temperature_learning_rate=1e-2)
    algorithm, learner, hyper = begun(Sac, options)
    actor, critic, log_alpha = learner.actor, learner.critic, jnp.zeros(())
    target = critic
    adams = Descent(1e-2), Descent(1e-2), Descent(1e-2)

    def sampled(actor, s, key):
        mean, log_std = (x[:, 0] for x in algorithm.actor.apply(actor, s))
        u = mean + jnp.exp(log_std) * heads.normal(key, (B, 1, A))[:, 0]
        density = -0.5 * ((u - mean) / jnp.exp(log_std)) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
        return jnp.tanh(u), (density - jnp.log(1 - jnp.tanh(u) ** 2)).sum(1)

    @jax.jit
    def critic_gradient(critic, actor, target, log_alpha, batch, key):
        a, density = sampled(actor, batch.next_observation, key)
        q = jnp.minimum(*twin(algorithm, target, batch.next_observation, a))
        y = batch.reward + 0.9 * (1 - batch.terminal) * (q - jnp.exp(log_alpha) * density)

        def loss(p):
            one, two = twin(algorithm, p, batch.observation, batch.action)
            return ((y - one) ** 2).mean() + ((y - two) ** 2).mean()

        return jax.grad(loss)(critic)

    @jax.jit
    def actor_gradient(actor, critic, log_alpha, s, key):
        def loss(p):
            a, density = sampled(p, s, key)
            q = jnp.minimum(*twin(algorithm, critic, s, a))
            return (jnp.exp(log_alpha) * density - q).mean(), density.mean()

        return jax.grad(loss, has_aux=True)(actor)

    update = jax.jit(algorithm.update)
    for i in range(3):
        batch, key = make_batch(i), jax.random.key(i)
        learner, _ = update(learner, hyper, batch, key)
        target_key, actor_key = jax.random.split(key)
        gradient = critic_gradient(critic, actor, target, log_alpha, batch, target_key)
        critic = adams[1](critic, gradient)
        gradient, density = actor_gradient(actor, critic, log_alpha, batch.observation, actor_key)
        actor = adams[0](actor, gradient)
        log_alpha = adams[2](log_alpha, -(density - A))
        target = blend(target, critic)
    found = learner.actor, learner.critic, learner.critic_target, learner.log_temperature
    jax.tree.map(CLOSE, found, (actor, critic, target, log_alpha))


APART = {**SHARED, "heads": 3, "head_spread": 1.0}


def steeper(critic):
    """Its values are some hundred times as large as at the start, where all are near 0."""
    return jax.tree.map(lambda x: 5.0 * x, critic)


def of_each_head(algorithm, critic, s, actions):
    """The smaller of both values of every proposal, one at a time, [B, M]."""
    each = [jnp.minimum(*twin(algorithm, critic, s, actions[:, m])) for m in range(3)]
    return jnp.stack(each, 1)


@pytest.mark.parametrize("target", ["mean", "max", "sampled"])
def test_td3s_target_is_the_smaller_value_of_a_head_and_then_over_heads(target):
    """Noise for each proposal; the critics are other networks, so that the order matters."""
    options = Td3Options(**APART, target=target)
    algorithm, learner, hyper = begun(Td3, options)
    learner = learner.replace(critic_target=steeper(learner.critic_target))
    s, key = make_batch(0).next_observation, jax.random.key(1)
    found = np.asarray(jax.jit(algorithm.next_value)(learner, hyper, s, key))
    proposals = algorithm.actor.apply(learner.actor_target, s)
    if target == "sampled":  # one noise for the one that is drawn; which it was is not told
        noise = 0.2 * heads.normal(jax.random.split(key)[1], (B, 1, A))
    else:
        noise = 0.2 * heads.normal(jax.random.split(key)[1], (B, 3, A))
    actions = jnp.clip(proposals + jnp.clip(noise, -0.5, 0.5), -1, 1)
    values = np.asarray(of_each_head(algorithm, learner.critic_target, s, actions))
    if target == "sampled":
        nearest = np.abs(values - found[:, None]).argmin(1)
        CLOSE(found, values[np.arange(B), nearest])
        assert len(set(nearest)) == 3
        return
    over = {"mean": np.mean, "max": np.max}[target]
    CLOSE(found, over(values, axis=1))
    one, two = (
        np.stack([twin(algorithm, learner.critic_target, s, actions[:, m])[i] for m in range(3)])
        for i in range(2)
    )
    other = np.minimum(over(one, axis=0), over(two, axis=0))  # over heads first
    assert np.abs(other - found).max() > 1e-3


@pytest.mark.parametrize("gradient", ["all", "stored"])
def test_sacs_losses_are_means_over_samples_of_every_component(gradient):
    """Target, loss and gradient against the mixture's density written out."""
    algorithm, learner, hyper = begun(Sac, SacOptions(**APART, gradient=gradient))
    critic, critic_target = steeper(learner.critic), steeper(learner.critic_target)
    learner = learner.replace(
        critic=critic, critic_target=critic_target, log_temperature=jnp.float32(-1.0)
    )
    batch, key = make_batch(0, acting=3), jax.random.key(1)

    def soft(actor, critic, s):
        mean, log_std = algorithm.actor.apply(actor, s)
        raw = mean + jnp.exp(log_std) * heads.normal(key, (B, 3, A))
        each = []
        for m in range(3):
            far = (raw[:, m, None] - mean) / jnp.exp(log_std)  # of sample m, from every component
            normal = jnp.exp(-0.5 * far**2) / jnp.exp(log_std) / jnp.sqrt(2 * jnp.pi)
            slope = (1 - jnp.tanh(raw[:, m]) ** 2).prod(1)
            each.append(jnp.log(normal.prod(2).mean(1) / slope))
        values = of_each_head(algorithm, critic, s, jnp.tanh(raw))
        return jnp.exp(-1.0) * jnp.stack(each, 1) - values

    found = jax.jit(algorithm.next_value)(learner, hyper, batch.next_observation, key)
    CLOSE(found, -soft(learner.actor, learner.critic_target, batch.next_observation).mean(1))

    def slow(actor):
        each = soft(actor, learner.critic, batch.observation)
        return (each[jnp.arange(B), batch.extra] if gradient == "stored" else each).mean()

    def ours(actor):
        return algorithm.actor_loss(actor, learner, learner.critic, batch, hyper, key)[0]

    found, expected = (jax.jit(jax.value_and_grad(f))(learner.actor) for f in (ours, slow))
    jax.tree.map(CLOSE, found, expected)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (Td3, {"target": "max"}),
        (Td3, {"gradient": "all"}),
        (Sac, {}),
        (Sac, {"gradient": "stored"}),
    ],
)
def test_padding_heads_learns_the_same(kind, options):
    """M = 3 padded to 5: two updates agree in the critics and in the heads in use."""
    made = (SacOptions if kind is Sac else Td3Options)(**{**SHARED, "heads": 3}, **options)
    found = []
    for size in (3, 5):
        algorithm, learner, _ = begun(kind, dataclasses.replace(made, heads=size))
        update = jax.jit(algorithm.update)
        for i in range(2):
            learner, _ = update(learner, kind.hyper(made), make_batch(i, 3), jax.random.key(i))
        found.append(learner)
    plain, padded = found

    def same(x, y):
        CLOSE(y[tuple(map(slice, x.shape))], x)

    jax.tree.map(same, (plain.actor, plain.critic), (padded.actor, padded.critic))
