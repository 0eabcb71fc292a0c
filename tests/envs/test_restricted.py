"""Restricted tasks: the plain task inside of the balls, no torque outside."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.mujoco_tasks.restriction import Balls

NAMES = [name for name in envs.names() if "native" in envs.spec(name).engines]
PUBLISHED = {"hopper": 1.25, "halfcheetah": 0.25, "walker2d": 0.25, "inverted_pendulum": 3.0}

make = functools.cache(envs.make)


def valid(place, k):
    """Of one place in [0, 1]^A, from the definition."""
    n = len(place)
    unit_ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
    radius = (0.6 * k / 33 / unit_ball) ** (1 / n)
    centres = np.random.RandomState(123).random(size=[33 * n, n])
    distance = np.sqrt(((place - centres) ** 2).sum(-1)).min()
    assert abs(distance - radius) > 1e-6, "the test's places keep off the balls' edges"
    return distance < radius


@pytest.mark.parametrize(
    ("size", "k", "volume"),
    [
        (1, 3.0, lambda r: 2 * r),
        (2, 1.0, lambda r: math.pi * r**2),
        (3, 1.25, lambda r: 4 / 3 * math.pi * r**3),
        (6, 0.25, lambda r: math.pi**3 / 6 * r**6),
        (8, 0.5, lambda r: math.pi**4 / 24 * r**8),
    ],
)
def test_a_ball_has_the_published_volume(size, k, volume):
    assert volume(Balls(k, size).radius) == pytest.approx(0.6 * k / 33, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_the_valid_actions_are_the_published_ones(name):
    k = PUBLISHED.get(name, 0.5)
    env = make(name, "native", restricted=name in PUBLISHED or k)
    places = np.random.default_rng(0).uniform(0, 1, (200, env.action_size)).astype(np.float32)
    got = env.task.balls.hold(np, places)
    np.testing.assert_array_equal(got, [valid(place, k) for place in places.astype(float)])
    assert 0 < got.mean() < 1


@pytest.mark.usefixtures("their_code")
@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("inverted_pendulum", "native"),
        ("hopper", "native"),
        pytest.param("inverted_pendulum", "mjx", marks=pytest.mark.mjx),
    ],
)
def test_a_step_is_the_plain_tasks_inside_and_has_no_torque_outside(name, engine):
    """To the last bit, of states, observations, rewards and metrics."""
    plain, restricted = make(name, engine), make(name, engine, restricted=0.5)
    starts = jax.jit(jax.vmap(plain.reset))(jax.random.split(jax.random.key(0), 32))
    states = jax.jit(jax.vmap(restricted.reset))(jax.random.split(jax.random.key(0), 32))
    actions = np.random.default_rng(1).uniform(-1, 1, (32, plain.action_size)).astype(np.float32)
    inside = restricted.task.balls.hold(np, (actions + 1) / 2)
    assert 0 < inside.sum() < 32
    got = jax.jit(jax.vmap(restricted.step))(states, actions)
    taken = np.where(inside[:, None], actions, np.float32(0))
    expected = jax.jit(jax.vmap(plain.step))(starts, taken)
    np.testing.assert_array_equal(got.metrics.pop("valid"), inside)
    states.metrics.pop("valid")
    jax.tree.map(np.testing.assert_array_equal, states, starts)
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def test_a_task_that_is_not_restricted_counts_nothing():
    state = jax.eval_shape(make("hopper", "native").reset, jax.random.key(0))
    assert "valid" not in state.metrics
    assert (
        "valid"
        in jax.eval_shape(
            make("hopper", "native", restricted=True).reset, jax.random.key(0)
        ).metrics
    )


def test_actions_are_clipped_before_they_are_judged():
    env = make("inverted_pendulum", "native", restricted=True)
    state = env.reset(jax.random.key(0))
    wild, edge = (env.step(state, jnp.asarray([x])) for x in (7.0, 1.0))
    jax.tree.map(np.testing.assert_array_equal, wild, edge)
