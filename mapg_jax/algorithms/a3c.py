"""A3C, batched and synchronous: n-step returns, losses and the update (Mnih et al. 2016).

What asynchronous workers did each with its own copy of the parameters, N environments do side by
side with one. All functions are pure.
"""

import dataclasses
from typing import ClassVar, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms.base import Experience, Explored, Rollout, Transition, traced
from mapg_jax.algorithms.descent import Params, adam, minimize
from mapg_jax.algorithms.networks import GaussianActor, StateCritic
from mapg_jax.algorithms.options import Options, option
from mapg_jax.algorithms.returns import n_step_returns


@dataclasses.dataclass(frozen=True, kw_only=True)
class A3cOptions(Options):
    """The numbers of A3C, chosen as docs/a3c.md says; it proposes one action a state."""

    heads: int = dataclasses.field(default=1, init=False)
    actor_learning_rate: float = option(1e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(1e-2, "Of Adam, for the critic.", above=0)
    max_gradient_norm: float | None = option(
        0.5, "The gradient of each network is scaled down to this norm.", above=0
    )
    entropy_weight: float = option(
        1e-4, "β, of the entropy of the action's distribution, as in the paper.", at_least=0
    )


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32: 1, the mean is the only proposal
    discount: jax.Array  # [], γ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    entropy_weight: jax.Array  # []


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    actor: Params
    critic: Params
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    updates: jax.Array  # [] i32


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # []
    actor_loss: jax.Array  # []
    value_mean: jax.Array  # []
    entropy: jax.Array  # []
    action_std: jax.Array  # []
    critic_gradient_norm: jax.Array  # []
    actor_gradient_norm: jax.Array  # []


def log_probability(
    action: Float[Array, "*B A"], mean: Float[Array, "*B A"], variance: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    r"""$-\frac{1}{2\sigma^2} \|a - \mu\|^2 - \frac{A}{2} \log 2\pi\sigma^2$."""
    squares = jnp.square(action - mean).sum(-1)
    return -0.5 * (squares / variance + action.shape[-1] * jnp.log(2 * jnp.pi * variance))


def entropy(variance: Float[Array, "*B"], action_size: int) -> Float[Array, "*B"]:
    r"""Differential entropy of the Gaussian, $\frac{A}{2} (\log 2\pi\sigma^2 + 1)$."""
    return 0.5 * action_size * (jnp.log(2 * jnp.pi * variance) + 1)


@dataclasses.dataclass(frozen=True)
class A3c:
    """The static part of the algorithm: networks and optimiser."""

    Options: ClassVar = A3cOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "rollouts"
    selects: ClassVar[tuple[str, ...]] = ("uniform", "mean")
    presets: ClassVar = {}

    actor: GaussianActor
    critic: StateCritic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""

    @classmethod
    def make(cls, options: A3cOptions, action_size: int) -> "A3c":
        """The algorithm with those options, for actions of A numbers."""
        networks = {"hidden": options.hidden, "layer_norm": options.layer_norm}
        return cls(
            actor=GaussianActor(action_size=action_size, **networks),
            critic=StateCritic(**networks),
            optimizer=adam(options.max_gradient_norm),
        )

    @classmethod
    def hyper(cls, options: A3cOptions) -> Hyperparameters:
        """The traced numbers."""
        return traced(Hyperparameters, options)

    @staticmethod
    def label(heads: int) -> str:
        """Its name for people."""
        return "A3C"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "a3c"

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """Fresh networks."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, observation_size))
        actor = self.actor.init(actor_key, observation)
        critic = self.critic.init(critic_key, observation)
        return LearnerState(
            actor=actor,
            critic=critic,
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def gaussian(
        self, actor: Params, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B A"], Float[Array, "*B"]]:
        """Mean and variance of the action."""
        return cast(tuple[Array, Array], self.actor.apply(actor, observation))

    def sample(
        self, actor: Params, observation: Float[Array, "*B D"], key: PRNGKeyArray
    ) -> Float[Array, "*B A"]:
        """One draw of the Gaussian a state, which may lie outside of [-1, 1]."""
        mean, variance = self.gaussian(actor, observation)
        return mean + jnp.sqrt(variance)[..., None] * jax.random.normal(key, mean.shape)

    def explorer(self, environments: int) -> tuple[()]:
        """Nothing is carried from step to step."""
        return ()

    def explore(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        explorer: tuple[()],
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        """Samples; what is stored beside the clipped action is the sample itself."""
        sample = self.sample(learner.actor, observation, key)
        return Explored(jnp.clip(sample, -1.0, 1.0), sample, explorer)

    def act(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: Literal["uniform", "mean"],
    ) -> Float[Array, "*B A"]:
        """One action a state: `uniform` draws it as in training, `mean` takes the mean."""
        if select == "mean":
            return self.gaussian(learner.actor, observation)[0]
        return jnp.clip(self.sample(learner.actor, observation, key), -1.0, 1.0)

    def proposals(
        self, learner: LearnerState, hyper: Hyperparameters, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B 1 A"], Float[Array, "*B 1"]]:
        """The mean, as the one action that is proposed, and V as its value."""
        action = self.gaussian(learner.actor, observation)[0]
        return action[..., None, :], self.value(learner.critic, observation)[..., None]

    def q_values(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """V of the state, whatever the action."""
        return jnp.broadcast_to(
            self.value(learner.critic, observation)[..., None], actions.shape[:-1]
        )

    def value(self, critic: Params, observation: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        """V."""
        return cast(Array, self.critic.apply(critic, observation))

    def actor_loss(
        self,
        actor: Params,
        steps: Transition,
        advantage: Float[Array, "T N"],
        entropy_weight: Float[Array, ""],
    ) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""]]]:
        r"""$-\frac{1}{TN} \sum_{t,i} (A_{ti} \log \pi(a_{ti}|s_{ti}) + \beta H_{ti})$.

        $A = R - V$ is the advantage and H the entropy; $\pi$ is the density of the sample, not of
        the clipped action that is executed. Beside the loss: the means of the entropy and of σ.
        """
        mean, variance = self.gaussian(actor, steps.observation)
        gain = (advantage * log_probability(steps.extra, mean, variance)).mean()
        entropy_mean = entropy(variance, self.actor.action_size).mean()
        loss = -(gain + entropy_weight * entropy_mean)
        return loss, (entropy_mean, jnp.sqrt(variance).mean())

    def critic_loss(
        self, critic: Params, steps: Transition, returns: Float[Array, "T N"]
    ) -> Float[Array, ""]:
        r"""$\frac{1}{TN} \sum_{t,i} (R_{ti} - V(s_{ti}))^2$."""
        return jnp.square(returns - self.value(critic, steps.observation)).mean()

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Rollout, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        """One update of actor and critic, both on the advantages of the critic before it.

        Args:
          learner: its state.
          hyper: its numbers.
          batch: collected by this actor, observations normalised.
          key: nothing is drawn.
        """
        steps = batch.steps
        discount = jnp.where(steps.terminal, 0.0, hyper.discount)
        next_value = self.value(learner.critic, steps.next_observation)
        returns = n_step_returns(steps.reward, discount, batch.ended, next_value)
        value = self.value(learner.critic, steps.observation)

        actor = minimize(
            lambda params: self.actor_loss(params, steps, returns - value, hyper.entropy_weight),
            self.optimizer,
            learner.actor,
            learner.actor_optimizer,
            hyper.actor_learning_rate,
        )
        critic = minimize(
            lambda params: (self.critic_loss(params, steps, returns), None),
            self.optimizer,
            learner.critic,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        updated = LearnerState(
            actor.params, critic.params, actor.optimizer, critic.optimizer, learner.updates + 1
        )
        entropy_mean, action_std = actor.aux
        metrics = UpdateMetrics(
            critic_loss=critic.loss,
            actor_loss=actor.loss,
            value_mean=value.mean(),
            entropy=entropy_mean,
            action_std=action_std,
            critic_gradient_norm=critic.gradient_norm,
            actor_gradient_norm=actor.gradient_norm,
        )
        return updated, metrics
