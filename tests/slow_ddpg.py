"""DDPG (Lillicrap et al. 2016), from its paper and eager: two ReLU layers, no layer norm."""

import collections

import jax
import jax.numpy as jnp
import oracles

from mapg_jax.training.config import Config


def actor(p, s):
    """μ(s), [B, A]."""
    h = jax.nn.relu(s @ p["W1"] + p["b1"][None])
    h = jax.nn.relu(h @ p["W2"] + p["b2"][None])
    return jnp.tanh(h @ p["W3"] + p["b3"][None])


def critic(p, s, a):
    """Q(s, a), [B]; the action joins at the second layer."""
    h = jax.nn.relu(s @ p["W1"] + p["b1"][None])
    h = jax.nn.relu(jnp.concatenate([h, a], 1) @ p["W2"] + p["b2"][None])
    return h @ p["W3"] + p["b3"]


def actor_parameters(actor):
    """Ours under the oracle's names."""
    p = actor["params"]
    kernel, bias = oracles.last_layer(actor, 1)
    return {
        "W1": p["Dense_0"]["kernel"],
        "b1": p["Dense_0"]["bias"],
        "W2": p["Dense_1"]["kernel"],
        "b2": p["Dense_1"]["bias"],
        "W3": kernel[:, 0],
        "b3": bias[0],
    }


def critic_parameters(critic):
    """Ours under the oracle's names."""
    p = critic["params"]
    return {
        "W1": p["Dense_0"]["kernel"],
        "b1": p["Dense_0"]["bias"],
        "W2": jnp.concatenate([p["features_kernel"], p["action_kernel"]]),
        "b2": p["joint_bias"],
        "W3": p["kernel"],
        "b3": p["bias"],
    }


class Adam:
    """Kingma and Ba (2015), Algorithm 1."""

    def __init__(self, rate):
        self.rate, self.t = rate, 0
        self.m, self.v = collections.defaultdict(float), collections.defaultdict(float)

    def __call__(self, parameters, gradient):
        self.t += 1
        after = {}
        for name, g in gradient.items():
            self.m[name] = 0.9 * self.m[name] + 0.1 * g
            self.v[name] = 0.999 * self.v[name] + 0.001 * g**2
            m = self.m[name] / (1 - 0.9**self.t)
            v = self.v[name] / (1 - 0.999**self.t)
            after[name] = parameters[name] - self.rate * m / (jnp.sqrt(v) + 1e-8)
        return after


class Ddpg:
    """Actor, critic, their targets and their optimisers."""

    def __init__(self, actor, critic, config: Config):
        self.actor = self.actor_target = actor
        self.critic = self.critic_target = critic
        self.config = config
        self.actor_adam = Adam(config.actor_learning_rate)
        self.critic_adam = Adam(config.critic_learning_rate)

    def update(self, s, a, r, terminal, s2) -> None:
        config = self.config
        next_q = critic(self.critic_target, s2, actor(self.actor_target, s2))
        y = r + config.discount * (1 - terminal) * next_q

        def critic_loss(p):
            penalty = sum((p[name] ** 2).sum() for name in ("W1", "W2", "W3"))
            return ((y - critic(p, s, a)) ** 2).mean() + config.critic_l2 / 2 * penalty

        def actor_loss(p):
            return -critic(self.critic, s, actor(p, s)).mean()

        self.critic = self.critic_adam(self.critic, jax.grad(critic_loss)(self.critic))
        self.actor = self.actor_adam(self.actor, jax.grad(actor_loss)(self.actor))
        for name in ("actor", "critic"):
            online, target = getattr(self, name), getattr(self, name + "_target")
            moved = {k: (1 - config.tau) * target[k] + config.tau * online[k] for k in online}
            setattr(self, name + "_target", moved)
