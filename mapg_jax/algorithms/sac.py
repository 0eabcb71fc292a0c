"""SAC whose policy is a uniform mixture of M tanh-Gaussians (Haarnoja et al. 2018, 1812.05905).

M = 1 is SAC. The density of the mixture is exact, so that the entropy term itself keeps the heads
apart where several actions are good. All functions are pure.
"""

import dataclasses
from typing import ClassVar, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import exploration, twin_critics
from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Experience, Explored, Transition, traced
from mapg_jax.algorithms.descent import Params, adam, minimize, towards
from mapg_jax.algorithms.mixture import log_density
from mapg_jax.algorithms.networks import Critic, GaussianHeads
from mapg_jax.algorithms.options import CriticOptions, option
from mapg_jax.algorithms.returns import td_target

GradientRule = Literal["all", "stored"]
"""Which components an actor update samples: every one, or the one that acted."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SacOptions(CriticOptions):
    """The numbers of SAC, as CleanRL has them."""

    actor_learning_rate: float = option(3e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(1e-3, "Of Adam, for the critics.", above=0)
    temperature_learning_rate: float = option(1e-3, "Of Adam, for log α.", above=0)
    tau: float = option(
        0.005, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
    )
    entropy_target: float = option(
        -1.0, "The entropy that α is steered to, for each dimension of the action."
    )
    random_start: bool = option(
        False, "Before the first update, act by uniformly random actions instead of the heads."
    )
    gradient: GradientRule = option(
        "all",
        "Components an actor update samples: every one, or the one that acted.",
        of_heads=True,
    )
    head_spread: float = option(
        3e-3, "The biases of the means start within ± this, before the tanh.", above=0,
        of_heads=True,
    )  # fmt: skip


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    tau: jax.Array  # [], τ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    temperature_learning_rate: jax.Array  # []
    entropy_target: jax.Array  # [], nats per dimension


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    actor: Params
    critic: Params  # leaves [2, ...]
    critic_target: Params
    log_temperature: jax.Array  # [], log α
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    temperature_optimizer: optax.OptState
    updates: jax.Array  # [] i32


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # []
    actor_loss: jax.Array  # []
    q_mean: jax.Array  # [], of the first critic
    entropy: jax.Array  # [], of the mixture after the tanh, by samples
    temperature: jax.Array  # [], α
    critic_gradient_norm: jax.Array  # []
    actor_gradient_norm: jax.Array  # []


class Sample(NamedTuple):
    """One draw of every component."""

    actions: Float[Array, "*B M A"]
    log_density: Float[Array, "*B M"]  # of the mixture, at each


@dataclasses.dataclass(frozen=True)
class Sac:
    """The static part of the algorithm: networks, optimiser and rules."""

    Options: ClassVar = SacOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "replay"
    selects: ClassVar[tuple[str, ...]] = ("uniform", "argmax-q", "mean", "first", "sample")
    presets: ClassVar = {
        "reference": {"learning_starts": 5_000, "random_start": True, "action_layer": 1},
        # After PQL's DDPG (Li et al. 2023).
        "parallel": {"actor_learning_rate": 5e-4, "critic_learning_rate": 5e-4, "tau": 0.05},
    }

    actor: GaussianHeads
    critic: Critic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""
    gradient: GradientRule
    random_start: bool

    @classmethod
    def make(cls, options: SacOptions, action_size: int) -> "Sac":
        """The algorithm with those options, for actions of A numbers."""
        shared = {"hidden": options.hidden, "layer_norm": options.layer_norm}
        actor = GaussianHeads(
            heads=options.heads, action_size=action_size, spread=options.head_spread, **shared
        )
        critic = Critic(action_layer=options.action_layer, **shared)
        optimizer = adam(options.max_gradient_norm)
        return cls(actor, critic, optimizer, options.gradient, options.random_start)

    @classmethod
    def hyper(cls, options: SacOptions) -> Hyperparameters:
        """The traced numbers."""
        return traced(Hyperparameters, options)

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is SAC."""
        return "SAC" if heads == 1 else f"SAC, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "sac"

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """Fresh networks, targets equal to the critics, and α = 1."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, observation_size))
        actor = self.actor.init(actor_key, observation)
        actions = jnp.zeros((1, 1, self.actor.action_size))
        critic = twin_critics.init(self.critic, critic_key, observation, actions)
        log_temperature = jnp.zeros(())
        return LearnerState(
            actor=actor,
            critic=critic,
            critic_target=critic,
            log_temperature=log_temperature,
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critic),
            temperature_optimizer=self.optimizer.init(log_temperature),
            updates=jnp.zeros((), jnp.int32),
        )

    def gaussians(
        self, actor: Params, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M A"]]:
        """Means and log σ of the components, before the tanh."""
        return cast(tuple[Array, Array], self.actor.apply(actor, observation))

    def sample(
        self, actor: Params, hyper: Hyperparameters, observation: Float[Array, "*B D"], key: Array
    ) -> Sample:
        r"""One action of every component, and the mixture's density there.

        $a_m = \tanh(\mu_m + \sigma_m \epsilon_m)$; with $u = \mathrm{artanh}\, a$,
        $\log \pi(a) = \log \frac{1}{M} \sum_j N(u; \mu_j, \sigma_j^2) - \sum_i \log(1 - a_i^2)$
        (SAC, Appendix C, for each component).
        """
        mean, log_std = self.gaussians(actor, observation)
        raw = mean + jnp.exp(log_std) * heads_.normal(key, mean.shape)
        density = log_density(raw, mean, log_std, hyper.heads) - _log_slope(raw).sum(-1)
        return Sample(jnp.tanh(raw), density)

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
        """A sample of the mixture; what is stored beside it is the component that acted."""
        head_key, sample_key = jax.random.split(key)
        head = heads_.draw(head_key, hyper.heads, (len(observation),))
        mean, log_std = self.gaussians(learner.actor, observation)
        raw = mean + jnp.exp(log_std) * heads_.normal(sample_key, mean.shape)
        action = jnp.tanh(heads_.take(raw, head))
        if self.random_start:
            action = exploration.random_start(key, learner.updates, action)
        return Explored(action, heads_.stored(head, self.actor.heads), explorer)

    def act(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: str,
    ) -> Float[Array, "*B A"]:
        """One action a state: `sample` as in training, else of the components' means.

        See `heads.choose` for how one of the M means is chosen.
        """
        if select == "sample":
            head_key, sample_key = jax.random.split(key)
            drawn = self.sample(learner.actor, hyper, observation, sample_key)
            head = heads_.draw(head_key, hyper.heads, observation.shape[:-1])
            return heads_.take(drawn.actions, head)
        proposals, values = self.proposals(learner, hyper, observation)
        chosen = cast(heads_.Select, select)
        return heads_.choose(chosen, key, proposals, values, hyper.heads)

    def proposals(
        self, learner: LearnerState, hyper: Hyperparameters, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The means of all components after the tanh, and the smaller Q of each."""
        actions = jnp.tanh(self.gaussians(learner.actor, observation)[0])
        return actions, self.q_values(learner, hyper, observation, actions)

    def q_values(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """The smaller Q of any K actions a state."""
        return twin_critics.values(self.critic, learner.critic, observation, actions).min(0)

    def next_value(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "B D"],
        key: PRNGKeyArray,
    ) -> Float[Array, "B"]:
        r"""$V'(s') = \frac{1}{M} \sum_m (\min_i Q'_i(s', a_m) - \alpha \log \pi(a_m|s'))$.

        One sample a component: the expectation over the mixture, stratified (SAC, Eq. 3).
        """
        drawn = self.sample(learner.actor, hyper, observation, key)
        values = twin_critics.values(
            self.critic, learner.critic_target, observation, drawn.actions
        ).min(0)
        soft = values - jnp.exp(learner.log_temperature) * drawn.log_density
        return heads_.mean(soft, hyper.heads)

    def actor_loss(
        self,
        actor: Params,
        learner: LearnerState,
        critic: Params,
        batch: Transition,
        hyper: Hyperparameters,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        r"""$\frac{1}{BM} \sum_{b,m} (\alpha \log \pi(a_{bm}|s_b) - \min_i Q_i(s_b, a_{bm}))$.

        (SAC, Eq. 7.) `stored` takes of the M samples that of the component that acted alone; the
        density is the whole mixture's. Beside the loss: the mean of $\log \pi$.
        """
        drawn = self.sample(actor, hyper, batch.observation, key)
        values = twin_critics.values(self.critic, critic, batch.observation, drawn.actions).min(0)
        each = jnp.exp(learner.log_temperature) * drawn.log_density - values
        if self.gradient == "stored":
            loss = heads_.take(each[..., None], batch.extra)[..., 0].mean()
        else:
            loss = heads_.mean(each, hyper.heads).mean()
        return loss, heads_.mean(drawn.log_density, hyper.heads).mean()

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Transition, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        r"""One update of critics, actor, temperature and targets.

        $\log \alpha$ steps down $-\log \alpha\, (\overline{\log \pi} + \bar H)$ (SAC, Eq. 18, as
        the authors' code has it).

        Args:
          learner: its state.
          hyper: its numbers.
          batch: leaves [B, ...], observations normalised.
          key: for the samples.
        """
        target_key, actor_key = jax.random.split(key)
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
        actor = minimize(
            lambda params: self.actor_loss(params, learner, critic.params, batch, hyper, actor_key),
            self.optimizer,
            learner.actor,
            learner.actor_optimizer,
            hyper.actor_learning_rate,
        )
        excess = actor.aux + hyper.entropy_target * self.actor.action_size
        temperature = minimize(
            lambda log_temperature: (-log_temperature * excess, None),
            self.optimizer,
            learner.log_temperature,
            learner.temperature_optimizer,
            hyper.temperature_learning_rate,
        )
        updated = LearnerState(
            actor=actor.params,
            critic=critic.params,
            critic_target=towards(learner.critic_target, critic.params, hyper.tau),
            log_temperature=temperature.params,
            actor_optimizer=actor.optimizer,
            critic_optimizer=critic.optimizer,
            temperature_optimizer=temperature.optimizer,
            updates=learner.updates + 1,
        )
        metrics = UpdateMetrics(
            critic_loss=critic.loss,
            actor_loss=actor.loss,
            q_mean=critic.aux.mean(),
            entropy=-actor.aux,
            temperature=jnp.exp(learner.log_temperature),
            critic_gradient_norm=critic.gradient_norm,
            actor_gradient_norm=actor.gradient_norm,
        )
        return updated, metrics


def _log_slope(raw: Float[Array, "*B"]) -> Float[Array, "*B"]:
    r"""$\log(1 - \tanh^2 u) = 2 (\log 2 - u - \mathrm{softplus}(-2u))$, which never cancels."""
    return 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
