"""PPO with M Gaussians a state, one drawn a step (Schulman et al. 2017).

M = 1 is PPO. `stored` is the paper's idea: only the head that acted is updated, by the ratio of its
own densities; `marginal` is PPO of the mixture. All functions are pure.
"""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from mapg_jax.algorithms.base import Rollout
from mapg_jax.algorithms.descent import Params, minimize
from mapg_jax.algorithms.on_policy import Batch, LearnerState, OnPolicy, OnPolicyOptions
from mapg_jax.algorithms.options import option


@dataclasses.dataclass(frozen=True, kw_only=True)
class PpoOptions(OnPolicyOptions):
    """The numbers of PPO, as its code has them."""

    actor_learning_rate: float = option(3e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(3e-4, "Of Adam, for the critic.", above=0)
    max_gradient_norm: float | None = option(
        0.5, "The gradient of each network is scaled down to this norm.", above=0
    )
    epochs: int = option(10, "Passes over a rollout.", at_least=1)
    minibatches: int = option(32, "Parts of a rollout, an update each; they divide it.", at_least=1)
    clip: float = option(0.2, "ε; beyond 1 ± ε a ratio of densities gains nothing.", above=0)
    annealing_updates: int = option(
        0,
        "Updates, one a rollout, over which both learning rates fall to 0 in a straight line; "
        "0 keeps them as they are.",
        at_least=0,
    )

    def __post_init__(self):
        super().__post_init__()
        self._refuse_to_learn_at_zero()

    @property
    def batches(self) -> int:
        """A minibatch is one."""
        return self.minibatches

    def _refuse_to_learn_at_zero(self):
        """Raises ValueError if the learning rates are 0 before the run ends."""
        steps = getattr(self, "steps", 0)
        turn = self.rollout_steps * getattr(self, "environments", 1)
        updates = math.ceil(steps / turn)
        if 0 < self.annealing_updates < updates:
            raise ValueError(
                f"annealing_updates must be 0 or at least {updates}, the updates of {steps:,} "
                f"steps; got {self.annealing_updates}, after which the learning rates are 0 and a "
                "run cannot go on"
            )


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    trace: jax.Array  # [], λ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    clip: jax.Array  # [], ε


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update, the means over its minibatches; the next one never reads them."""

    critic_loss: jax.Array  # []
    actor_loss: jax.Array  # []
    value_mean: jax.Array  # []
    clipped: jax.Array  # [], share of the ratios
    mixture_kl: jax.Array  # [], from the mixture before to the one after, by samples
    critic_gradient_norm: jax.Array  # []
    actor_gradient_norm: jax.Array  # []


@dataclasses.dataclass(frozen=True)
class Ppo(OnPolicy):
    """PPO with M heads, of which the one that acted is updated."""

    Options: ClassVar = PpoOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    presets: ClassVar = {
        "reference": {
            "rollout_steps": 2048,
            "hidden": (64, 64),
            "normalize": True,
            "annealing_updates": 489,  # those of the preset's million steps
        },
        "parallel": {  # minibatches and epochs of Brax's PPO; rollouts as long, and steps as small,
            # as driving took to settle
            "rollout_steps": 64,
            "minibatches": 32,
            "epochs": 4,
            "actor_learning_rate": 2e-4,
        },
        "smoke": {"rollout_steps": 32, "minibatches": 4},
    }

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is PPO."""
        return "PPO" if heads == 1 else f"PPO, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "ppo"

    def actor_loss(
        self, actor: Params, batch: Batch, hyper: Hyperparameters
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        r"""$-\frac{1}{B} \sum_b \min(w_b A_b, \mathrm{clip}(w_b, 1 \pm \epsilon) A_b)$.

        (PPO, Eq. 7.) $w_b = \pi(a_b|s_b) / \pi_{\mathrm{old}}(a_b|s_b)$, of the head that acted or
        of the mixture; A has mean 0 and deviation 1. Beside the loss: the share beyond 1 ± ε.
        """
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
        density = self.log_density(actor, hyper, batch.observation, batch.choice)
        ratio = jnp.exp(density - batch.log_density)
        clipped = jnp.clip(ratio, 1 - hyper.clip, 1 + hyper.clip)
        gain = jnp.minimum(ratio * advantage, clipped * advantage)
        return -gain.mean(), (jnp.abs(ratio - 1) > hyper.clip).mean()

    def annealed(self, hyper: Hyperparameters, updates: Integer[Array, ""]) -> Hyperparameters:
        r"""Both learning rates times $\max(0, 1 - k / K)$, k updates after the start."""
        if not self.options.annealing_updates:
            return hyper
        left = jnp.maximum(1 - updates / self.options.annealing_updates, 0.0)
        return hyper.replace(
            actor_learning_rate=hyper.actor_learning_rate * left,
            critic_learning_rate=hyper.critic_learning_rate * left,
        )

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Rollout, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        """Some epochs of minibatches of a rollout (PPO, Algorithm 1).

        Args:
          learner: its state.
          hyper: its numbers.
          batch: collected by this actor, observations normalised.
          key: for the order of the steps.
        """
        before = learner.actor
        hyper = self.annealed(hyper, learner.updates)
        learner, steps = self.prepare(learner, hyper, batch)

        def one(learner: LearnerState, part: jax.Array):
            minibatch = jax.tree.map(lambda x: x[part], steps)
            actor = minimize(
                lambda params: self.actor_loss(params, minibatch, hyper),
                self.optimizer,
                learner.actor,
                learner.actor_optimizer,
                hyper.actor_learning_rate,
            )
            learner, critic = self.fit_critic(learner, hyper, minibatch)
            learner = learner.replace(actor=actor.params, actor_optimizer=actor.optimizer)
            found = critic.loss, actor.loss, actor.aux, critic.gradient_norm, actor.gradient_norm
            return learner, jnp.stack(found)

        def order(key: PRNGKeyArray):
            shuffled = jax.random.permutation(key, len(steps.advantage))
            return shuffled.reshape(self.options.minibatches, -1)

        keys = jax.random.split(key, self.options.epochs)
        parts = jax.vmap(order)(keys).reshape(len(keys) * self.options.minibatches, -1)
        learner, found = jax.lax.scan(one, learner, parts)
        critic_loss, actor_loss, clipped, critic_norm, actor_norm = found.mean(0)
        metrics = UpdateMetrics(
            critic_loss=critic_loss,
            actor_loss=actor_loss,
            value_mean=steps.returns.mean(),
            clipped=clipped,
            mixture_kl=self.mixture_kl(before, learner.actor, hyper, steps),
            critic_gradient_norm=critic_norm,
            actor_gradient_norm=actor_norm,
        )
        return learner.replace(updates=learner.updates + 1), metrics
