"""Multiple Action Policy Gradients: losses and the update. DDPG is M = 1.

All functions are pure: what an update changes is the `LearnerState` it returns.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import Params, kernel_l2, minimize, towards
from mapg_jax.algorithms.deterministic import Deterministic, LearnerState, UpdateMetrics
from mapg_jax.algorithms.head_options import DIVERSE, HeadNumbers, HeadOptions
from mapg_jax.algorithms.options import option
from mapg_jax.algorithms.returns import td_target


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapgOptions(HeadOptions):
    """The numbers of MAPG; the defaults are those of the code the paper ran on."""

    actor_learning_rate: float = option(1e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(1e-3, "Of Adam, for the critic.", above=0)
    critic_l2: float = option(1e-2, "λ of the critic's weight penalty λ/2 Σ‖W‖².", at_least=0)


class Hyperparameters(HeadNumbers):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    critic_l2: jax.Array  # []


@dataclasses.dataclass(frozen=True)
class Mapg(Deterministic):
    """DDPG with M heads, of which the one that acted is updated."""

    Options: ClassVar = MapgOptions
    Hyper: ClassVar = Hyperparameters
    presets: ClassVar = {
        "diverse": DIVERSE,
        "reference": {  # CleanRL's DDPG
            "actor_learning_rate": 3e-4,
            "critic_learning_rate": 3e-4,
            "critic_l2": 0.0,
            "tau": 0.005,
            "noise": "gaussian",
            "noise_scale": 0.1,
            "learning_starts": 25_000,
            "random_start": True,
            "action_layer": 1,
        },
        "parallel": {  # the proportions of PQL's DDPG (Li et al. 2023): fast targets, a ladder.
            # Its rates, 5e-4 each, are not taken: small actors saturate before the critic is right.
            "critic_l2": 0.0,
            "tau": 0.05,
            "max_gradient_norm": 0.5,
            "noise": "gaussian",
            "noise_scale": 0.05,
            "noise_scale_last": 0.8,
        },
    }

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is DDPG."""
        return "DDPG" if heads == 1 else f"M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """M = 1 is DDPG."""
        return "ddpg" if heads == 1 else "mapg"

    def next_value(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "B D"],
        key: PRNGKeyArray,
    ) -> Float[Array, "B"]:
        r"""$V'(s')$ of the target networks, by the rule of the target."""
        actions = self.candidates(learner.actor_target, hyper, observation, key)
        values = self.values(learner.critic_target, observation, actions)
        return self.over_candidates(values, hyper)

    def critic_loss(
        self,
        critic: Params,
        batch: Transition,
        target: Float[Array, "B"],
        critic_l2: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Float[Array, "B"]]:
        r"""The critic's loss:

        $\frac{1}{B} \sum_b (y_b - Q(s_b, a_b))^2 + \frac{\lambda}{2} \sum_W \|W\|^2$, and Q.
        """
        q = self.value(critic, batch.observation, batch.action)
        return jnp.square(target - q).mean() + critic_l2 * kernel_l2(critic), q

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Transition, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        r"""One update of critic, actor and targets, in the order of Algorithm 1.

        Args:
          learner: its state.
          hyper: its numbers.
          batch: leaves [B, ...], observations normalised.
          key: for the rules that draw heads.
        """
        target_key, head_key = jax.random.split(key)
        discount = jnp.where(batch.terminal, 0.0, hyper.discount)
        next_value = self.next_value(learner, hyper, batch.next_observation, target_key)
        target = td_target(batch.reward, discount, next_value)

        critic = minimize(
            lambda params: self.critic_loss(params, batch, target, hyper.critic_l2),
            self.optimizer,
            learner.critic,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        strength = self.strength(learner, hyper, batch.observation)
        actor = minimize(
            lambda params: (
                self.actor_loss(params, critic.params, batch, hyper, strength, head_key),
                None,
            ),
            self.optimizer,
            learner.actor,
            learner.actor_optimizer,
            hyper.actor_learning_rate,
        )
        updated = LearnerState(
            actor=actor.params,
            critic=critic.params,
            actor_target=towards(learner.actor_target, actor.params, hyper.tau),
            critic_target=towards(learner.critic_target, critic.params, hyper.tau),
            actor_optimizer=actor.optimizer,
            critic_optimizer=critic.optimizer,
            updates=learner.updates + 1,
        )
        metrics = UpdateMetrics(
            critic_loss=critic.loss,
            actor_loss=actor.loss,
            q_mean=critic.aux.mean(),
            critic_gradient_norm=critic.gradient_norm,
            actor_gradient_norm=actor.gradient_norm,
        )
        return updated, metrics
