"""What PPO and TRPO share: a policy of M Gaussians, one drawn a step, and its advantages."""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms import normalization
from mapg_jax.algorithms.base import Experience, Explored, Rollout, traced
from mapg_jax.algorithms.descent import Descended, Params, adam, minimize
from mapg_jax.algorithms.mixture import log_density, log_gaussian
from mapg_jax.algorithms.networks import GaussianHeads, StateCritic
from mapg_jax.algorithms.normalization import NormalizerState
from mapg_jax.algorithms.options import Options, option
from mapg_jax.algorithms.returns import generalized_advantages

RETURNS_FLOOR = 1e-4  # of the variance of returns

GradientRule = Literal["stored", "marginal"]
"""Whose density an update weighs: that of the head that acted, or that of the mixture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnPolicyOptions(Options):
    """The numbers of both; each has its own beside them."""

    rollout_steps: int = option(
        128, "n, steps of every environment between updates; N · n make a batch.", at_least=1
    )
    max_gradient_norm: float | None = option(
        None, "The gradient of a network is scaled down to this norm; none by default.", above=0
    )
    trace: float = option(0.95, "λ of the generalised advantages.", at_least=0, at_most=1)
    gradient: GradientRule = option(
        "stored",
        "Whose density an update weighs: that of the head that acted, or that of the mixture.",
        of_heads=True,
    )
    head_spread: float = option(
        3e-3, "The biases of the heads' means start within ± this.", above=0, of_heads=True
    )

    @property
    def batches(self) -> int:
        """How many a rollout is cut into, with an update each."""
        return 1

    def __post_init__(self):
        super().__post_init__()
        environments = getattr(self, "environments", None)
        if environments is None:
            return  # of no run yet
        steps = self.rollout_steps * environments // getattr(self, "shards", 1)
        rollout = f"a rollout of {steps} steps, {self.rollout_steps} of each environment,"
        if steps % self.batches:
            raise ValueError(
                f"{rollout} cannot be cut into {self.batches} minibatches; "
                "their number must divide it"
            )
        if steps < 2 * self.batches:
            raise ValueError(
                f"{rollout} must have {2 * self.batches} or more, two for each update, because "
                "an advantage is scaled by the others of its batch"
            )


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    actor: Params
    critic: Params
    actor_optimizer: Any  # TRPO leaves it as it is
    critic_optimizer: optax.OptState
    returns: NormalizerState  # statistics of the returns; the critic's output is in their units
    updates: jax.Array  # [] i32


class Choice(NamedTuple):
    """What is stored beside the action that is executed."""

    head: jax.Array  # [N], in a byte where M fits one
    sample: jax.Array  # [N, A], before it is clipped


class Batch(NamedTuple):
    """The steps of a rollout, side by side."""

    observation: Float[Array, "B D"]
    choice: Choice
    advantage: Float[Array, "B"]
    returns: Float[Array, "B"]
    log_density: Float[Array, "B"]  # of the sample, by the policy that drew it


@dataclasses.dataclass(frozen=True)
class OnPolicy:
    """The static part: networks, optimiser and rule. A subclass says how the actor is updated."""

    Hyper: ClassVar[Any]
    experience: ClassVar[Experience] = "rollouts"
    selects: ClassVar[tuple[str, ...]] = ("uniform", "mean", "first", "sample")

    actor: GaussianHeads
    critic: StateCritic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""
    options: Any
    """Of them, only what is no traced number is read."""

    @classmethod
    def make(cls, options: Any, action_size: int) -> Any:
        """The algorithm with those options, for actions of A numbers."""
        shared = {"hidden": options.hidden, "layer_norm": options.layer_norm}
        actor = GaussianHeads(
            heads=options.heads,
            action_size=action_size,
            spread=options.head_spread,
            free=True,
            **shared,
        )
        return cls(actor, StateCritic(**shared), adam(options.max_gradient_norm), options)

    @classmethod
    def hyper(cls, options: Any) -> Any:
        """The traced numbers."""
        return traced(cls.Hyper, options)

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
            returns=normalization.init(1),
            updates=jnp.zeros((), jnp.int32),
        )

    def gaussians(
        self, actor: Params, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M A"]]:
        """Means and log σ of the heads; a sample may lie outside of [-1, 1]."""
        return cast(tuple[Array, Array], self.actor.apply(actor, observation))

    def explorer(self, environments: int) -> tuple[()]:
        """Nothing is carried from step to step."""
        return ()

    def explore(
        self,
        learner: LearnerState,
        hyper: Any,
        explorer: tuple[()],
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        """A head drawn uniformly, and a sample of it, clipped to be executed."""
        choice = self._sample(learner, hyper, observation, key)
        return Explored(jnp.clip(choice.sample, -1.0, 1.0), choice, explorer)

    def act(
        self,
        learner: LearnerState,
        hyper: Any,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: str,
    ) -> Float[Array, "*B A"]:
        """One action a state: `sample` as in training, else of the heads' means (`choose`)."""
        if select == "sample":
            sample = self._sample(learner, hyper, observation, key).sample
            return jnp.clip(sample, -1.0, 1.0)
        proposals, values = self.proposals(learner, hyper, observation)
        chosen = cast(heads_.Select, select)
        return heads_.choose(chosen, key, proposals, values, hyper.heads)

    def _sample(
        self, learner: LearnerState, hyper: Any, observation: Float[Array, "*B D"], key: Array
    ) -> Choice:
        head_key, sample_key = jax.random.split(key)
        head = heads_.draw(head_key, hyper.heads, observation.shape[:-1])
        mean, log_std = self.gaussians(learner.actor, observation)
        noise = jax.random.normal(sample_key, (*head.shape, mean.shape[-1]))
        sample = heads_.take(mean, head) + jnp.exp(heads_.take(log_std, head)) * noise
        return Choice(heads_.stored(head, self.actor.heads), sample)

    def proposals(
        self, learner: LearnerState, hyper: Any, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The means of all heads, clipped, and V for each: no critic knows them apart."""
        mean, _ = self.gaussians(learner.actor, observation)
        value = self.value(learner.critic, learner.returns, observation)[..., None]
        return jnp.clip(mean, -1.0, 1.0), jnp.broadcast_to(value, mean.shape[:-1])

    def q_values(
        self,
        learner: LearnerState,
        hyper: Any,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """V, whatever the action."""
        value = self.value(learner.critic, learner.returns, observation)[..., None]
        return jnp.broadcast_to(value, actions.shape[:-1])

    def value(
        self, critic: Params, returns: NormalizerState, observation: Float[Array, "*B D"]
    ) -> Float[Array, "*B"]:
        """V, in reward units."""
        mean, std = _moments(returns)
        return mean + std * cast(Array, self.critic.apply(critic, observation))

    def log_density(
        self, actor: Params, hyper: Any, observation: Float[Array, "B D"], choice: Choice
    ) -> Float[Array, "B"]:
        """Of the samples: by the head that drew them, or by the mixture."""
        mean, log_std = self.gaussians(actor, observation)
        if self.options.gradient == "marginal":
            return log_density(choice.sample[:, None], mean, log_std, hyper.heads)[:, 0]
        of_head = heads_.take(mean, choice.head), heads_.take(log_std, choice.head)
        return log_gaussian(choice.sample, *of_head)

    def prepare(
        self, learner: LearnerState, hyper: Any, rollout: Rollout
    ) -> tuple[LearnerState, Batch]:
        """Advantages and returns of a rollout, by the critic as it is; the returns are seen."""
        steps = rollout.steps
        value = self.value(learner.critic, learner.returns, steps.observation)
        following = self.value(learner.critic, learner.returns, steps.next_observation)
        discount = jnp.where(steps.terminal, 0.0, hyper.discount)
        advantage = generalized_advantages(
            steps.reward, discount, rollout.ended, value, following, hyper.trace
        )
        observation, choice, advantage, returns = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]),
            (steps.observation, steps.extra, advantage, advantage + value),
        )
        before = self.log_density(learner.actor, hyper, observation, choice)
        batch = Batch(observation, choice, advantage, returns, before)
        seen = normalization.update(learner.returns, returns[:, None])
        return learner.replace(returns=seen), batch

    def critic_loss(
        self, critic: Params, returns: NormalizerState, batch: Batch
    ) -> Float[Array, ""]:
        r"""$\frac{1}{B} \sum_b ((R_b - V(s_b)) / \sigma_R)^2$, σ the deviation of all returns."""
        error = batch.returns - self.value(critic, returns, batch.observation)
        return jnp.square(error / _moments(returns)[1]).mean()

    def mixture_kl(
        self, before: Params, after: Params, hyper: Any, batch: Batch
    ) -> Float[Array, ""]:
        r"""$\frac{1}{B} \sum_b \log (\pi(a_b|s_b) / \pi'(a_b|s_b))$ of the mixtures, by samples."""
        sample = batch.choice.sample[:, None]

        def of(actor):
            return log_density(sample, *self.gaussians(actor, batch.observation), hyper.heads)

        return (of(before) - of(after)).mean()

    def fit_critic(
        self, learner: LearnerState, hyper: Any, batch: Batch
    ) -> tuple[LearnerState, Descended]:
        """One step of the critic towards the returns of a batch."""
        step = minimize(
            lambda params: (self.critic_loss(params, learner.returns, batch), None),
            self.optimizer,
            learner.critic,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        return learner.replace(critic=step.params, critic_optimizer=step.optimizer), step


def _moments(returns: NormalizerState) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and standard deviation of all returns so far; 0 and 1 before the first."""
    variance = returns.deviations[0] / jnp.maximum(returns.count, 1.0)
    std = jnp.where(returns.count > 0, jnp.sqrt(jnp.maximum(variance, RETURNS_FLOOR)), 1.0)
    return returns.mean[0], std
