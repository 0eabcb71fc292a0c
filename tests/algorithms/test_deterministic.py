"""How heads are chosen and held, and where they end on a value with two humps."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import minimize
from mapg_jax.algorithms.mapg import Mapg
from mapg_jax.training.config import Config

N, STEPS = 6, 40


def acted(kind=Mapg, **options) -> np.ndarray:
    """The heads that acted in N environments, [STEPS, N]; no episode ends."""
    config = dataclasses.replace(oracles.TINY, heads=5, **options)
    algorithm, hyper = kind.make(config, 1), kind.hyper(config)

    def step(explorer, key):
        explored = algorithm.explore(learner, hyper, explorer, jnp.ones((N, 2)), key)
        return explored.explorer, explored.extra

    learner = algorithm.init(jax.random.key(0), 2)
    keys = jax.random.split(jax.random.key(1), STEPS)
    return np.asarray(jax.jit(lambda: jax.lax.scan(step, algorithm.explorer(N), keys)[1])())


def test_a_head_is_held_for_so_many_steps():
    free, held, whole = acted(), acted(hold=8), acted(hold="episode")
    np.testing.assert_array_equal(held, np.repeat(free[::8], 8, axis=0))
    np.testing.assert_array_equal(whole, np.repeat(free[:1], STEPS, axis=0))
    assert (free[1:] != free[:-1]).any(0).all()


def test_an_episode_that_ends_lets_its_head_go():
    """One-step episodes: each draws anew, though a head is held for eight steps."""
    config = dataclasses.replace(oracles.TINY, hold=8, environments=16)
    trainer = oracles.make_trainer(oracles.OneStep(), 10, config)
    state = trainer.jitted_run(trainer.jitted_init(0), 12)
    heads = oracles.stored(state).extra.reshape(12, 16)
    assert (heads[1:] != heads[:-1]).any(0).all()


def test_the_best_head_acts_where_it_is_asked_for():
    config = dataclasses.replace(oracles.TINY, heads=5, behaviour="argmax-q", head_spread=1.0)
    algorithm = Mapg.make(config, 1)
    learner = algorithm.init(jax.random.key(0), 2)
    _, values = algorithm.proposals(learner, Mapg.hyper(config), jnp.ones((N, 2)))
    best = int(values[0].argmax())
    assert (acted(behaviour="argmax-q", head_spread=1.0) == best).all()


def test_heads_start_apart_by_their_biases_alone():
    near, far = (
        Mapg.make(dataclasses.replace(oracles.TINY, heads=200, head_spread=spread), 1).init(
            jax.random.key(0), 2
        )
        for spread in (3e-3, 1.5)
    )
    bias = np.asarray(far.actor["params"]["bias"])[0]
    assert np.abs(bias).max() <= 1.5
    assert abs(bias.std() / (1.5 / np.sqrt(3)) - 1) < 0.2  # 4 standard errors of 200 uniforms
    oracles.assert_equal(far.actor["params"]["kernel"], near.actor["params"]["kernel"])


class Known(Mapg):
    """The critic is known: 3 a_0, and what the state is worth whatever is done."""

    def values(self, critic, observation, actions):
        return 100 * observation[..., :1] + 3 * actions[..., 0]


class Tenfold(Known):
    """The same in another unit of reward."""

    def values(self, critic, observation, actions):
        return 10 * super().values(critic, observation, actions)


def test_the_unit_of_the_rules_is_how_much_actions_matter():
    """Of 3a the deviation over U(-1, 1) is 3 / √3; what a state is worth by itself has no part."""
    algorithm = Known.make(oracles.TINY, 2)
    observation = jnp.arange(10.0).reshape(5, 2)
    scatter = np.asarray(algorithm.scatter(algorithm.init(jax.random.key(0), 2), observation))
    np.testing.assert_allclose(scatter, scatter[0], rtol=1e-4)
    # A deviation of 16 uniforms has a standard error of 11 %.
    assert scatter[0] == pytest.approx(np.sqrt(3), rel=0.33)


@pytest.mark.parametrize("spread", [1.0, 1e-4])
def test_heads_act_by_their_values_in_any_unit_of_reward(spread):
    """Chi-square against p ∝ exp(Q / Tσ); where heads agree, that is as good as uniform."""
    soft = {"behaviour": "softmax-q", "temperature": 0.3, "head_spread": spread}
    drawn = acted(Known, **soft)
    np.testing.assert_array_equal(drawn, acted(Tenfold, **soft))

    config = dataclasses.replace(oracles.TINY, heads=5, **soft)
    algorithm, state = Known.make(config, 1), jnp.ones((1, 2))
    learner = algorithm.init(jax.random.key(0), 2)
    _, values = algorithm.proposals(learner, Known.hyper(config), state)
    weight = np.exp((values - values.mean())[0] / (0.3 * algorithm.scatter(learner, state)))
    expected = drawn.size * weight / weight.sum()
    assert (expected.max() / expected.min() < 1.1) == (spread < 1)
    counts = np.bincount(drawn.ravel(), minlength=5)
    assert ((counts - expected) ** 2 / expected).sum() < oracles.chi_square_limit(5)


class TwoHumps(Mapg):
    """The critic is known: humps of height 1 at -0.6 and 0.6, equal at 0 but for a slight slope."""

    def values(self, critic, observation, actions):
        a = actions[..., 0]
        return jnp.exp(-jnp.square(a - 0.6) / 0.1) + jnp.exp(-jnp.square(a + 0.6) / 0.1) + 0.01 * a


@functools.cache
def ends(steps: int = 600, **options) -> tuple[float, float]:
    """Where two heads end that climb the humps, the lower one first."""
    config = Config(**{"heads": 2, "hidden": (8, 8), "actor_learning_rate": 1e-2, **options})
    algorithm, hyper = TwoHumps.make(config, 1), TwoHumps.hyper(config)
    learner, observation = algorithm.init(jax.random.key(3), 2), jnp.ones((32, 2))
    none = jnp.zeros(32)
    batch = Transition(observation, None, none[:, None], none, none > 0, observation)

    def step(carry, key):
        learner = carry
        head_key, loss_key = jax.random.split(key)
        acted = batch._replace(extra=jax.random.randint(head_key, (32,), 0, 2))
        strength = algorithm.strength(learner, hyper, observation)
        actor = minimize(
            lambda p: (algorithm.actor_loss(p, None, acted, hyper, strength, loss_key), None),
            algorithm.optimizer,
            learner.actor,
            learner.actor_optimizer,
            hyper.actor_learning_rate,
        )
        after = learner.replace(
            actor=actor.params, actor_optimizer=actor.optimizer, updates=learner.updates + 1
        )
        return after, None

    keys = jax.random.split(jax.random.key(4), steps)
    learner = jax.jit(lambda: jax.lax.scan(step, learner, keys)[0])()
    return tuple(sorted(np.asarray(algorithm.actions(learner.actor, observation))[0, :, 0]))


@pytest.mark.parametrize("gradient", ["stored", "resampled", "all"])
def test_heads_that_start_together_end_on_one_hump(gradient):
    lower, upper = ends(gradient=gradient)
    assert lower == pytest.approx(upper, abs=0.02)
    assert abs(lower) == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize(
    "rule",
    [
        {"repulsion": "stein", "repulsion_weight": 1.5, "repulsion_updates": 500},
        {
            "repulsion": "stein",
            "repulsion_weight": 1.5,
            "repulsion_updates": 500,
            "gradient": "all",
        },
        {"repulsion": "inverse", "repulsion_weight": 1.5, "repulsion_updates": 500},
    ],
)
def test_heads_that_repel_end_on_both_humps(rule):
    """The repulsion falls to nothing, and each head stays where it climbed."""
    lower, upper = ends(**rule)
    assert (lower, upper) == pytest.approx((-0.6, 0.6), abs=0.02)
