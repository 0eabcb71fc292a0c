"""TD3 with M heads: two critics, smoothed targets, a delayed actor (Fujimoto et al. 2018).

M = 1 is TD3. All functions are pure.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms import twin_critics
from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import Params, minimize, towards
from mapg_jax.algorithms.deterministic import Deterministic, LearnerState, Strength, UpdateMetrics
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.head_options import DIVERSE, HeadNumbers, HeadOptions
from mapg_jax.algorithms.options import option
from mapg_jax.algorithms.returns import td_target


@dataclasses.dataclass(frozen=True, kw_only=True)
class Td3Options(HeadOptions):
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


class Hyperparameters(HeadNumbers):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    target_noise: jax.Array  # []
    target_noise_clip: jax.Array  # []
    policy_delay: jax.Array  # [] i32


class Networks(NamedTuple):
    """What a policy update moves, targets included."""

    actor: Params
    actor_target: Params
    critic_target: Params  # leaves [2, ...]
    actor_optimizer: optax.OptState


@dataclasses.dataclass(frozen=True)
class Td3(Deterministic):
    """TD3 with M heads, of which the one that acted is updated."""

    Options: ClassVar = Td3Options
    Hyper: ClassVar = Hyperparameters
    presets: ClassVar = {
        "diverse": DIVERSE,
        "reference": {  # sfujim/TD3
            "learning_starts": 25_000,
            "random_start": True,
            "action_layer": 1,
        },
        # After PQL's DDPG (Li et al. 2023).
        "parallel": {"actor_learning_rate": 5e-4, "critic_learning_rate": 5e-4, "tau": 0.05,
                     "noise_scale": 0.05, "noise_scale_last": 0.8},
    }  # fmt: skip

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is TD3."""
        return "TD3" if heads == 1 else f"TD3, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "td3"

    def init_critic(
        self, key: PRNGKeyArray, observation: Float[Array, "1 D"], actions: Float[Array, "1 1 A"]
    ) -> Params:
        """What both critics learn, fresh."""
        return twin_critics.init(self.critic, key, observation, actions)

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
        values = twin_critics.values(self.critic, learner.critic_target, observation, actions)
        return self.over_candidates(values.min(0), hyper)

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
            lambda params: twin_critics.loss(self.critic, params, batch, target),
            self.optimizer,
            learner.critic,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        strength = self.strength(learner, hyper, batch.observation)
        updates = learner.updates + 1
        networks, actor_loss, actor_gradient_norm = jax.lax.cond(
            updates % hyper.policy_delay == 0,
            lambda networks: self._climb(networks, critic.params, batch, hyper, strength, head_key),
            lambda networks: (networks, jnp.zeros(()), jnp.zeros(())),
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

    def _climb(
        self,
        networks: Networks,
        critic: Params,
        batch: Transition,
        hyper: Hyperparameters,
        strength: Strength,
        key: PRNGKeyArray,
    ) -> tuple[Networks, Float[Array, ""], Float[Array, ""]]:
        """The actor and the targets, moved; the actor's loss, and the norm of its gradient."""
        actor = minimize(
            lambda params: (
                self.actor_loss(params, critic, batch, hyper, strength, key),
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
            critic_target=towards(networks.critic_target, critic, hyper.tau),
            actor_optimizer=actor.optimizer,
        )
        # Metrics are averaged over all updates: those that move the actor count for the others.
        return moved, hyper.policy_delay * actor.loss, hyper.policy_delay * actor.gradient_norm
