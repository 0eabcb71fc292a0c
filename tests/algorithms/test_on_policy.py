"""Advantages against their double sum; PPO and TRPO against slow versions of their own."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import slow_ddpg
from jax.flatten_util import ravel_pytree

from mapg_jax.algorithms import normalization
from mapg_jax.algorithms.base import Rollout, Transition
from mapg_jax.algorithms.ppo import Ppo, PpoOptions
from mapg_jax.algorithms.returns import generalized_advantages
from mapg_jax.algorithms.trpo import Trpo, TrpoOptions
from mapg_jax.runs import contract
from mapg_jax.training.config import Config, preset

T, N, D, A = 6, 4, 3, 2


def slow_advantages(reward, discount, ended, value, next_value, trace):
    """Σ_k (Π γλ) δ_{t+k}, each product written out, up to the end of the episode."""
    found = np.zeros((T, N))
    for t in range(T):
        for i in range(N):
            factor = 1.0
            for k in range(t, T):
                delta = reward[k, i] + discount[k, i] * next_value[k, i] - value[k, i]
                found[t, i] += factor * delta
                factor *= discount[k, i] * trace
                if ended[k, i]:
                    break
    return found


@pytest.mark.parametrize("trace", [0.0, 0.9, 1.0])
def test_generalised_advantages_are_the_double_sum(trace):
    rng = np.random.default_rng(0)
    reward, value, next_value = rng.normal(size=(3, T, N))
    ended = rng.random((T, N)) < 0.3
    discount = np.where(ended & (rng.random((T, N)) < 0.5), 0.0, 0.9)
    given = reward, discount, ended, value, next_value
    found = generalized_advantages(*map(jnp.asarray, given), jnp.float32(trace))
    np.testing.assert_allclose(found, slow_advantages(*given, trace), rtol=1e-4, atol=1e-5)


def rollout(algorithm, learner, hyper, heads) -> Rollout:
    """Steps whose choices are this policy's own."""
    rng = np.random.default_rng(1)
    seen = jnp.asarray(rng.normal(size=(T, N, D)), jnp.float32)
    explored = algorithm.explore(learner, hyper, (), seen.reshape(-1, D), jax.random.key(2))
    choice = jax.tree.map(lambda x: x.reshape(T, N, *x.shape[1:]), explored.extra)
    ended = jnp.asarray(rng.random((T, N)) < 0.2)
    reward = jnp.asarray(rng.normal(size=(T, N)), jnp.float32)
    following = jnp.asarray(rng.normal(size=(T, N, D)), jnp.float32)
    action = jnp.clip(choice.sample, -1, 1)
    steps = Transition(seen, choice, action, reward, ended, following)
    return Rollout(steps, ended)


PPO = PpoOptions(heads=1, hidden=(8, 8), rollout_steps=T, minibatches=3, epochs=2, head_spread=0.5)
TRPO = TrpoOptions(heads=3, hidden=(8, 8), rollout_steps=T, critic_steps=3, head_spread=0.5)


@functools.cache
def setup(kind, options):
    """The algorithm, a learner that has seen returns, its numbers and a rollout of its own."""
    algorithm, hyper = kind.make(options, A), kind.hyper(options)
    learner = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(0), D)
    seen = normalization.update(learner.returns, jnp.asarray([[1.0], [-1.0], [3.0]]))
    learner = learner.replace(returns=seen)
    return algorithm, learner, hyper, rollout(algorithm, learner, hyper, options.heads)


ANNEALED = dataclasses.replace(PPO, annealing_updates=4)


@functools.cache
def annealed_update():
    return jax.jit(setup(Ppo, ANNEALED)[0].update)


@pytest.mark.parametrize(("heads", "gradient"), [(1, "stored"), (3, "stored"), (3, "marginal")])
def test_an_update_is_ppos(heads, gradient):
    """The second of four updates against PPO written plainly: epochs, minibatches, clip, two Adams
    whose rates have fallen by a quarter. Ratios are of the head that acted, or of the mixture."""
    options = dataclasses.replace(ANNEALED, heads=heads, gradient=gradient)
    algorithm, learner, hyper, given = setup(Ppo, options)
    assert set(np.asarray(given.steps.extra.head).ravel()) == set(range(heads))
    key, update = jax.random.key(5), jax.jit(algorithm.update) if heads > 1 else annealed_update()
    after, _ = update(learner.replace(updates=jnp.int32(1)), hyper, given, key)

    steps = given.steps
    value = algorithm.value(learner.critic, learner.returns, steps.observation)
    following = algorithm.value(learner.critic, learner.returns, steps.next_observation)
    discount = np.where(steps.terminal, 0.0, PPO.discount)
    advantage = slow_advantages(
        *(np.asarray(x) for x in (steps.reward, discount, given.ended, value, following)), PPO.trace
    )
    flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), steps)
    returns = (advantage + np.asarray(value)).ravel()
    every = np.concatenate([[1.0, -1.0, 3.0], returns])
    scale = every.mean(), every.std()

    def density(params, s, a, head):
        mean, log_std = algorithm.actor.apply(params, s)
        z = (a[:, None] - mean) / jnp.exp(log_std)
        each = jnp.exp(-0.5 * z**2 - log_std).prod(2) / (2 * jnp.pi)
        if gradient == "marginal":
            return each.mean(1)
        return each[jnp.arange(len(a)), head]

    def clipped(gradient):
        norm = jnp.sqrt(sum((g**2).sum() for g in jax.tree.leaves(gradient)))
        return jax.tree.map(lambda g: g * jnp.minimum(1, 0.5 / norm), gradient)

    def step(adam, params, gradient):
        leaves, tree = jax.tree.flatten(params)
        moved = adam(dict(enumerate(leaves)), dict(enumerate(jax.tree.leaves(gradient))))
        return jax.tree.unflatten(tree, [moved[i] for i in range(len(leaves))])

    @jax.jit
    def gradients(actor, critic, part):
        s, a, r = flat.observation[part], flat.extra.sample[part], jnp.asarray(returns)[part]
        old = density(learner.actor, s, a, flat.extra.head[part])
        gain = jnp.asarray(advantage.ravel())[part]
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)

        def actor_loss(params):
            w = density(params, s, a, flat.extra.head[part]) / old
            return -jnp.minimum(w * gain, jnp.clip(w, 0.8, 1.2) * gain).mean()

        def critic_loss(params):
            target = (r - scale[0]) / scale[1]
            return ((algorithm.critic.apply(params, s) - target) ** 2).mean()

        return clipped(jax.grad(actor_loss)(actor)), clipped(jax.grad(critic_loss)(critic))

    flat = jax.tree.map(jnp.asarray, flat)
    actor, critic = learner.actor, learner.critic
    actor_adam, critic_adam = slow_ddpg.Adam(0.75 * 3e-4), slow_ddpg.Adam(0.75 * 3e-4)
    for epoch in jax.random.split(key, PPO.epochs):
        for part in jax.random.permutation(epoch, T * N).reshape(PPO.minibatches, -1):
            for_actor, for_critic = gradients(actor, critic, part)
            actor = step(actor_adam, actor, for_actor)
            critic = step(critic_adam, critic, for_critic)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=2e-6)
    jax.tree.map(close, after.actor, actor)
    jax.tree.map(close, after.critic, critic)


def test_annealed_ppo_stands_still_where_its_rates_are_0_and_by_default_they_stay():
    def at(update, updates):
        _, learner, hyper, given = setup(Ppo, ANNEALED)
        begun = learner.replace(updates=jnp.int32(updates))
        after, _ = update(begun, hyper, given, jax.random.key(5))
        return after.actor, after.critic

    _, learner, *_ = setup(Ppo, ANNEALED)
    for updates in (4, 5):
        oracles.assert_equal(at(annealed_update(), updates), (learner.actor, learner.critic))
    plain = jax.jit(setup(Ppo, PPO)[0].update)
    oracles.assert_equal(at(plain, 5), at(plain, 0))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-8)
    jax.tree.map(close, at(annealed_update(), 0), at(plain, 0))  # two programs, up to rounding
    with pytest.raises(ValueError, match="at least 489, the updates of 1,000,000 steps; got 488"):
        preset("reference", "ppo", annealing_updates=488)


def test_trpos_direction_is_the_dense_solve():
    """(F + damping) x = g with F the Hessian written out; scaled to the trust region."""
    algorithm, learner, hyper, given = setup(Trpo, dataclasses.replace(TRPO, conjugate_steps=300))
    learner, batch = algorithm.prepare(learner, hyper, given)
    flat, unravel = ravel_pytree(learner.actor)
    gradient = jax.grad(algorithm.surrogate)(learner.actor, batch, hyper)
    direction = jax.jit(algorithm.direction)
    found, _ = ravel_pytree(direction(learner.actor, gradient, hyper, batch))

    def kl(x):
        return algorithm.kl(learner.actor, unravel(x), hyper, batch)

    fisher = np.asarray(jax.jit(jax.hessian(kl))(flat), np.float64)
    fisher += 0.1 * np.eye(len(flat))
    x = np.linalg.solve(fisher, np.asarray(ravel_pytree(gradient)[0], np.float64))
    expected = np.sqrt(2 * 0.01 / (x @ fisher @ x)) * x
    np.testing.assert_allclose(found, expected, rtol=2e-2, atol=1e-3 * np.abs(expected).max())


def test_a_trpo_step_gains_within_the_trust_region():
    algorithm, learner, hyper, given = setup(Trpo, TRPO)
    after, metrics = jax.jit(algorithm.update)(learner, hyper, given, jax.random.key(0))
    _, batch = algorithm.prepare(learner, hyper, given)
    assert metrics.gain > 0
    assert 0 < metrics.kl <= 0.01
    gain = algorithm.surrogate(after.actor, batch, hyper) - algorithm.surrogate(
        learner.actor, batch, hyper
    )
    assert float(gain) == pytest.approx(float(metrics.gain), rel=1e-3)


def test_one_head_is_trpo():
    """One update: the dense solve, the first shrinking step that gains in the region, then V."""
    options = dataclasses.replace(TRPO, heads=1, conjugate_steps=300)
    algorithm, learner, hyper, given = setup(Trpo, options)
    after, metrics = jax.jit(algorithm.update)(learner, hyper, given, jax.random.key(0))

    seen, batch = algorithm.prepare(learner, hyper, given)
    s, a = batch.observation, batch.choice.sample
    gain = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
    flat, unravel = ravel_pytree(learner.actor)
    old_mean, old_log_std = (x[:, 0] for x in algorithm.actor.apply(learner.actor, s))

    @jax.jit
    def surrogate(x):
        mean, log_std = (y[:, 0] for y in algorithm.actor.apply(unravel(x), s))
        of = [
            (-0.5 * ((a - m) / jnp.exp(log)) ** 2 - log).sum(1)
            for m, log in ((mean, log_std), (old_mean, old_log_std))
        ]
        return (jnp.exp(of[0] - of[1]) * gain).mean()

    @jax.jit
    def kl(x):
        mean, log_std = (y[:, 0] for y in algorithm.actor.apply(unravel(x), s))
        ratio = jnp.exp(2 * (old_log_std - log_std))
        gap = ((old_mean - mean) / jnp.exp(log_std)) ** 2
        return (0.5 * (ratio + gap - 1 - jnp.log(ratio))).sum(1).mean()

    fisher = np.asarray(jax.jit(jax.hessian(kl))(flat), np.float64) + 0.1 * np.eye(len(flat))
    x = np.linalg.solve(fisher, np.asarray(jax.grad(surrogate)(flat), np.float64))
    step = np.sqrt(2 * 0.01 / (x @ fisher @ x)) * x
    share = next(
        share
        for share in 0.8 ** np.arange(11)
        if surrogate(flat + share * step) > surrogate(flat) and kl(flat + share * step) <= 0.01
    )
    assert float(metrics.step) == pytest.approx(share)
    moved, _ = ravel_pytree(after.actor)
    np.testing.assert_allclose(
        moved - flat, share * step, rtol=2e-2, atol=1e-3 * np.abs(step).max()
    )

    every = np.concatenate([[1.0, -1.0, 3.0], batch.returns])
    target = (batch.returns - every.mean()) / every.std()
    leaves, tree = jax.tree.flatten(learner.critic)
    critic, adam = dict(enumerate(leaves)), slow_ddpg.Adam(1e-3)

    @jax.jit
    def slope(p):
        def loss(p):
            found = algorithm.critic.apply(jax.tree.unflatten(tree, p.values()), s)
            return ((found - target) ** 2).mean()

        return jax.grad(loss)(p)

    for _ in range(TRPO.critic_steps):
        critic = adam(critic, slope(critic))
    for found, expected in zip(jax.tree.leaves(after.critic), critic.values(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-6)
    oracles.assert_equal(after.returns, seen.returns)


@pytest.mark.parametrize("gradient", ["stored", pytest.param("marginal", marks=pytest.mark.slow)])
def test_trpo_improves_every_head_where_the_best_action_is_known(gradient):
    """A state s = ±1 and a reward of s · a: after 20 turns every mean is on the side of s."""
    config = contract.tiny(
        "trpo", environments=16, rollout_steps=32, critic_steps=10, gradient=gradient
    )
    trainer = oracles.make_trainer(oracles.Side(), 1, config)
    begun = trainer.jitted_init(0)
    returns = []
    for state in (begun, trainer.jitted_run(trainer.jitted_init(0), 20)):
        proposals, _ = trainer.agent.proposals(state.agent, jnp.asarray([[1.0], [-1.0]]))
        returns.append(proposals[:, :, 0] * jnp.asarray([[1.0], [-1.0]]))
    assert np.abs(returns[0]).max() < 0.2
    assert np.min(returns[1]) > 0.5


def test_the_heads_divergence_is_the_closed_form_and_bounds_the_mixtures():
    """KL of Gaussians by SciPy-free algebra; the mixture's by a sum over 96,000 samples."""
    algorithm, learner, hyper, given = setup(Trpo, TRPO)
    other = jax.tree.map(lambda x: x + 0.1, learner.actor)
    _, batch = algorithm.prepare(learner, hyper, given)
    old, new = (algorithm.gaussians(p, batch.observation) for p in (learner.actor, other))
    each = 0.0
    for (m0, l0), (m1, l1) in [
        ((old[0][:, m], old[1][:, m]), (new[0][:, m], new[1][:, m])) for m in range(3)
    ]:
        v0, v1 = np.exp(2 * np.asarray(l0)), np.exp(2 * np.asarray(l1))
        gap = np.square(np.asarray(m1 - m0))
        each += np.mean(0.5 * (np.log(v1 / v0) + (v0 + gap) / v1 - 1).sum(1)) / 3
    found = float(algorithm.kl(learner.actor, other, hyper, batch))
    assert found == pytest.approx(each, rel=1e-4)

    many = jnp.repeat(batch.observation, 4000, axis=0)
    choice = jax.jit(algorithm.explore)(learner, hyper, (), many, jax.random.key(3)).extra
    sampled = batch._replace(observation=many, choice=choice)
    mixture = float(algorithm.mixture_kl(learner.actor, other, hyper, sampled))
    assert 0 < mixture < found


@pytest.mark.parametrize(
    ("kind", "options", "gradient"),
    [(Ppo, PPO, "marginal"), (Trpo, TRPO, "stored")],
)
def test_padding_heads_learns_the_same(kind, options, gradient):
    """M = 3 padded to 5: the heads in use and the critic agree after an update."""
    made = dataclasses.replace(options, heads=3, gradient=gradient)
    _, _, hyper, given = setup(kind, made)
    found = []
    for size in (3, 5):
        algorithm, learner, *_ = setup(kind, dataclasses.replace(made, heads=size))
        found.append(jax.jit(algorithm.update)(learner, hyper, given, jax.random.key(5))[0])
    plain, padded = found

    def same(x, y):
        y = y[tuple(map(slice, x.shape))]
        np.testing.assert_allclose(y, x, rtol=1e-3, atol=2e-6)

    jax.tree.map(same, (plain.actor, plain.critic), (padded.actor, padded.critic))


def test_no_step_is_taken_where_none_is_good():
    """A direction downhill: the search gives up, and the actor stays to the last bit."""
    algorithm, learner, hyper, given = setup(Trpo, TRPO)
    _, batch = algorithm.prepare(learner, hyper, given)
    downhill = jax.tree.map(
        lambda g: -0.1 * g, jax.grad(algorithm.surrogate)(learner.actor, batch, hyper)
    )
    step = jax.jit(algorithm.search)(learner.actor, downhill, hyper, batch)
    assert step.share == 0
    oracles.assert_equal(step.actor, learner.actor)


def test_a_rollout_that_its_minibatches_do_not_divide_is_refused():
    with pytest.raises(ValueError, match=r"640 steps.*cannot be cut into 48 minibatches"):
        Config(algorithm="ppo", environments=16, rollout_steps=40, minibatches=48)


@pytest.mark.parametrize(
    "options",
    [
        {"algorithm": "ppo", "environments": 4, "rollout_steps": 8, "minibatches": 32},
        {"algorithm": "trpo", "environments": 1, "rollout_steps": 1},
    ],
)
def test_a_batch_of_one_step_is_refused(options):
    """Its advantage, scaled by itself, is 0: the actor would stand still."""
    least = 2 * options.get("minibatches", 1)
    with pytest.raises(ValueError, match=f"must have {least} or more, two for each update"):
        Config(**options)
    Config(**{**options, "rollout_steps": 2 * options["rollout_steps"]})
