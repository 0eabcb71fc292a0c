"""DDPG with the settings that CleanRL publishes for JAX, written anew, on HalfCheetah-v5.

Adam at 3e-4 for both networks, τ = 0.005, Gaussian noise of 0.1, the actor and the targets updated
at every second update of the critic, the action beside the observation at the critic's first layer,
one Gymnasium environment, and a replay in NumPy; widths and batch are ours. As there, the loop is
Python's and each network has a jitted update of its own.

python -m benchmarks.peers.cleanrl STEPS
"""

import sys
import time
from typing import NamedTuple

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import peers, products

DISCOUNT, TAU, NOISE, ACTOR_EVERY = 0.99, 0.005, 0.1, 2
LEARNING_STARTS, SLOTS = 100, 1_000_000
ADAM = optax.adam(3e-4)


class Mlp(nn.Module):
    """Hidden layers with ReLU, and a linear one."""

    outputs: int

    @nn.compact
    def __call__(self, x):
        for width in products.HIDDEN:
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(self.outputs)(x)


class Learner(NamedTuple):
    """Parameters, the targets and the optimiser of one network."""

    params: dict
    target: dict
    optimizer: optax.OptState


ACTOR, CRITIC = Mlp(products.HALFCHEETAH[1]), Mlp(1)


@jax.jit
def act(params, observation):
    return jnp.tanh(ACTOR.apply(params, observation))


def value(params, observation, action):
    return CRITIC.apply(params, jnp.concatenate([observation, action], -1))[:, 0]


@jax.jit
def update_critic(actor, critic, batch):
    observation, action, reward, terminal, following = batch
    next_value = value(critic.target, following, act(actor.target, following))
    wanted = reward + DISCOUNT * (1 - terminal) * next_value

    def loss(params):
        return jnp.square(value(params, observation, action) - wanted).mean()

    error, gradient = jax.value_and_grad(loss)(critic.params)
    return descend(critic, gradient), error


@jax.jit
def update_actor(actor, critic, observation):
    def loss(params):
        return -value(critic.params, observation, act(params, observation)).mean()

    actor = descend(actor, jax.grad(loss)(actor.params))
    return towards_target(actor), towards_target(critic)


def descend(learner, gradient):
    step, optimizer = ADAM.update(gradient, learner.optimizer)
    return learner._replace(params=optax.apply_updates(learner.params, step), optimizer=optimizer)


def towards_target(learner):
    return learner._replace(target=optax.incremental_update(learner.params, learner.target, TAU))


def learner(network, key, size):
    params = network.init(key, jnp.zeros((1, size)))
    return Learner(params, params, ADAM.init(params))


class Replay:
    """A ring in NumPy."""

    def __init__(self, observation: int, action: int):
        sizes = [(observation,), (action,), (), (), (observation,)]
        self.columns = [np.zeros((SLOTS, *size), np.float32) for size in sizes]
        self.stored = 0

    def add(self, *transition) -> None:
        for column, x in zip(self.columns, transition, strict=True):
            column[self.stored % SLOTS] = x
        self.stored += 1

    def sample(self, random):
        index = random.integers(0, min(self.stored, SLOTS), products.BATCH)
        return [column[index] for column in self.columns]


def main(steps: int) -> None:
    env, random = gymnasium.make("HalfCheetah-v5"), np.random.default_rng(0)
    sizes = products.HALFCHEETAH
    actor_key, critic_key = jax.random.split(jax.random.key(0))
    actor, critic = learner(ACTOR, actor_key, sizes[0]), learner(CRITIC, critic_key, sum(sizes))
    replay, began = Replay(*sizes), 0.0

    observation, _ = env.reset(seed=0)
    for step in range(peers.WARM_UP + steps):
        if step == peers.WARM_UP:
            began = time.perf_counter()
        if step < LEARNING_STARTS:
            action = random.uniform(-1, 1, sizes[1]).astype(np.float32)
        else:
            noise = random.normal(0, NOISE, sizes[1])
            action = np.clip(np.asarray(act(actor.params, observation)) + noise, -1, 1)
        following, reward, terminated, truncated, _ = env.step(action)
        replay.add(observation, action, reward, terminated, following)
        observation = env.reset()[0] if terminated or truncated else following
        if step >= LEARNING_STARTS:
            batch = replay.sample(random)
            critic, _ = update_critic(actor, critic, batch)
            if step % ACTOR_EVERY == 0:
                actor, critic = update_actor(actor, critic, batch[0])
    jax.block_until_ready((actor, critic))
    rate = steps / (time.perf_counter() - began)
    pair = products.of_ddpg(sizes, actor_every=ACTOR_EVERY)
    peers.tell(rate, products.jax_microseconds(pair) / ACTOR_EVERY)


if __name__ == "__main__":
    main(int(sys.argv[1]))
