"""TD3 with M heads: two critics, smoothed targets, a delayed actor (Fujimoto et al. 2018).

M = 1 is TD3. All functions are pure.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Experience, Transition, traced
from mapg_jax.algorithms.descent import Params, adam, minimize, towards
from mapg_jax.algorithms.deterministic import (
    Deterministic,
    DeterministicOptions,
    make_networks,
    numbers,
)
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.mapg import td_target
from mapg_jax.algorithms.options import option

CRITICS = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Td3Options(DeterministicOptions):
    """The numbers of TD3, as its paper and its code have them."""

    actor_learning_rate: float = option(3e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(3e-4, "Of Adam, for the critics.", above=0)
    tau: float = option(
        0.005, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    noise: Noise = option(
        "gaussian",
        "Exploration noise added to the action: Ornstein-Uhlenbeck, Gaussian or none.",
    )
    noise_scale: float = option(0.1, "σ of the noise, in units of [-1, 1].", at_least=0)
    target_noise: float = option(
        0.2, "σ of the noise added to the actions of the target, in units of [-1, 1].", at_least=0
    )
    target_noise_clip: float = option(0.5, "That noise is cut off at ± this.", at_least=0)
    policy_delay: int = option(
        2, "Updates of the critics for one of the actor and of the targets.", at_least=1
    )


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    tau: jax.Array  # [], τ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    noise_scale: jax.Array  # [], σ in the first environment
    noise_scale_last: jax.Array  # [], σ in the last one
    target_noise: jax.Array  # []
    target_noise_clip: jax.Array  # []
    policy_delay: jax.Array  # [] i32
    temperature: jax.Array  # [], in standard deviations of Q over a state's heads
    hold: jax.Array  # [] i32 steps
    repulsion_weight: jax.Array  # [], in standard deviations of Q over a batch
    repulsion_updates: jax.Array  # [] i32, until it is 0; 0 for never


class Networks(NamedTuple):
    """What a policy update moves, targets included."""

    actor: Params
    actor_target: Params
    critic_target: Params  # leaves [2, ...]
    actor_optimizer: optax.OptState


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    actor: Params
    critic: Params  # leaves [2, ...]
    actor_target: Params
    critic_target: Params
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    updates: jax.Array  # [] i32


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # []
    actor_loss: jax.Array  # [], over the updates that move the actor
    q_mean: jax.Array  # [], of the first critic
    critic_gradient_norm: jax.Array  # []
    actor_gradient_norm: jax.Array  # [], over the updates that move the actor


@dataclasses.dataclass(frozen=True)
class Td3(Deterministic):
    """TD3 with M heads, of which the one that acted is updated."""

    Options: ClassVar = Td3Options
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "replay"
    presets: ClassVar = {
        "reference": {"learning_starts": 25_000, "random_start": True},  # sfujim/TD3
        "parallel": {"actor_learning_rate": 5e-4, "critic_learning_rate": 5e-4, "tau": 0.05,
                     "noise_scale": 0.05, "noise_scale_last": 0.8},
    }  # fmt: skip

    @classmethod
    def make(cls, options: Td3Options, action_size: int) -> "Td3":
        """The algorithm with those options, for actions of A numbers."""
        actor, critic = make_networks(options, action_size)
        return cls(actor, critic, adam(options.max_gradient_norm), options)

    @classmethod
    def hyper(cls, options: Td3Options) -> Hyperparameters:
        """The traced numbers; without a last σ all environments have the first."""
        return traced(Hyperparameters, options, **numbers(options))

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is TD3."""
        return "TD3" if heads == 1 else f"TD3, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "td3"

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """Fresh networks, their targets equal to them."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, observation_size))
        actor = self.actor.init(actor_key, observation)
        actions = jnp.zeros((1, 1, self.actor.action_size))
        keys = jax.random.split(critic_key, CRITICS)
        critic = jax.vmap(self.critic.init, in_axes=(0, None, None))(keys, observation, actions)
        return LearnerState(
            actor=actor,
            critic=critic,
            actor_target=actor,
            critic_target=critic,
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def both(
        self, critic: Params, observation: Float[Array, "B D"], actions: Float[Array, "B K A"]
    ) -> Float[Array, "2 B K"]:
        """Q of K actions a state, by either critic."""
        values = super().values
        return jax.vmap(values, in_axes=(0, None, None))(critic, observation, actions)

    def values(
        self, critic: Params, observation: Float[Array, "*B D"], actions: Float[Array, "*B K A"]
    ) -> Float[Array, "*B K"]:
        """Q of K actions a state by the first critic, which is the one that the actor climbs."""
        return super().values(jax.tree.map(lambda x: x[0], critic), observation, actions)

    def next_value(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "B D"],
        key: PRNGKeyArray,
    ) -> Float[Array, "B"]:
        r"""$V'(s')$: over heads, $\min_i Q'_i(s', \mathrm{clip}(\rho'_m + \epsilon_m, \pm 1))$.

        $\epsilon_m \sim \mathrm{clip}(N(0, \tilde\sigma^2), \pm c)$ (TD3, Eq. 14), one a proposal;
        then the mean over heads, one drawn, or the largest.
        """
        head_key, noise_key = jax.random.split(key)
        actions = self.candidates(learner.actor_target, hyper, observation, head_key)
        noise = hyper.target_noise * heads_.normal(noise_key, actions.shape)
        noise = jnp.clip(noise, -hyper.target_noise_clip, hyper.target_noise_clip)
        actions = jnp.clip(actions + noise, -1.0, 1.0)
        values = self.both(learner.critic_target, observation, actions).min(0)
        return self.over_candidates(values, hyper)

    def critic_loss(
        self, critic: Params, batch: Transition, target: Float[Array, "B"]
    ) -> tuple[Float[Array, ""], Float[Array, "B"]]:
        r"""$\sum_i \frac{1}{B} \sum_b (y_b - Q_i(s_b, a_b))^2$, and Q of the first critic."""
        q = self.both(critic, batch.observation, batch.action[:, None])[..., 0]
        return jnp.square(target[None] - q).mean(1).sum(), q[0]

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Transition, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        """One update of the critics; every `policy_delay` updates, of actor and targets too.

        Args:
          learner: its state.
          hyper: its numbers.
          batch: leaves [B, ...], observations normalised.
          key: for the noise of the target, and for the rules that draw heads.
        """
        target_key, head_key = jax.random.split(key)
        discount = jnp.where(batch.terminal, 0.0, hyper.discount)
        next_value = self.next_value(learner, hyper, batch.next_observation, target_key)
        target = td_target(batch.reward, discount, next_value)
        critic = minimize(
            lambda params: self.critic_loss(params, batch, target),
            self.optimizer,
            learner.critic,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        strength = self.strength(learner, hyper, critic.aux)

        def climb(networks: Networks):
            actor = minimize(
                lambda params: (
                    self.actor_loss(params, critic.params, batch, hyper, strength, head_key),
                    None,
                ),
                self.optimizer,
                networks.actor,
                networks.actor_optimizer,
                hyper.actor_learning_rate,
            )
            moved = Networks(
                actor=actor.params,
                actor_target=towards(networks.actor_target, actor.params, hyper.tau),
                critic_target=towards(networks.critic_target, critic.params, hyper.tau),
                actor_optimizer=actor.optimizer,
            )
            # Metrics are averaged over all updates: those that move the actor count for the others.
            return moved, hyper.policy_delay * actor.loss, hyper.policy_delay * actor.gradient_norm

        def wait(networks: Networks):
            return networks, jnp.zeros(()), jnp.zeros(())

        updates = learner.updates + 1
        networks, actor_loss, actor_gradient_norm = jax.lax.cond(
            updates % hyper.policy_delay == 0,
            climb,
            wait,
            Networks(*(getattr(learner, name) for name in Networks._fields)),
        )
        updated = LearnerState(
            critic=critic.params,
            critic_optimizer=critic.optimizer,
            updates=updates,
            **networks._asdict(),
        )
        metrics = UpdateMetrics(
            critic_loss=critic.loss,
            actor_loss=actor_loss,
            q_mean=critic.aux.mean(),
            critic_gradient_norm=critic.gradient_norm,
            actor_gradient_norm=actor_gradient_norm,
        )
        return updated, metrics
