"""Multiple Action Policy Gradients: losses and the update. DDPG is M = 1.

All functions are pure: what an update changes is the `LearnerState` it returns.
"""

import dataclasses
from typing import ClassVar, Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from mapg_jax.algorithms import exploration
from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Experience, Explored, Transition, traced
from mapg_jax.algorithms.descent import Params, adam, descend, kernel_l2
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.networks import Actor, Critic
from mapg_jax.algorithms.options import Options, option

GradientRule = Literal["stored", "resampled", "all"]
"""Which heads an actor update reaches: the one that acted, a fresh one a sample, or all."""
TargetRule = Literal["mean", "sampled"]
"""What the target bootstraps from: the mean over the heads (Eq. 6), or one head drawn a sample."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapgOptions(Options):
    """The numbers of MAPG; the defaults are those of the code the paper ran on."""

    actor_learning_rate: float = option(1e-4, "Of Adam, for the actor.", above=0)
    critic_learning_rate: float = option(1e-3, "Of Adam, for the critic.", above=0)
    critic_l2: float = option(1e-2, "λ of the critic's weight penalty λ/2 Σ‖W‖².", at_least=0)
    tau: float = option(
        0.01, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
    )
    gradient: GradientRule = option(
        "stored",
        "Heads an actor update reaches: the one that acted, a fresh one per sample, or all.",
        of_heads=True,
    )
    target: TargetRule = option(
        "mean",
        "The target bootstraps from the mean over heads (Eq. 6) or from one head per sample.",
        of_heads=True,
    )
    noise: Noise = option(
        "ou",
        "Exploration noise added to the action: Ornstein-Uhlenbeck, Gaussian or none.",
    )
    noise_scale: float = option(0.2, "σ of the noise, in units of [-1, 1].", at_least=0)
    noise_scale_last: float | None = option(
        None,
        "σ in the last environment; those between take even steps. By default all have one σ.",
        at_least=0,
    )


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    tau: jax.Array  # [], τ
    actor_learning_rate: jax.Array  # []
    critic_learning_rate: jax.Array  # []
    critic_l2: jax.Array  # []
    noise_scale: jax.Array  # [], σ in the first environment
    noise_scale_last: jax.Array  # [], σ in the last one


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    actor: Params
    critic: Params
    actor_target: Params
    critic_target: Params
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    updates: jax.Array  # [] i32


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # []
    actor_loss: jax.Array  # []
    q_mean: jax.Array  # []
    critic_gradient_norm: jax.Array  # []
    actor_gradient_norm: jax.Array  # []


def td_target(
    reward: Float[Array, "B"], discount: Float[Array, "B"], next_value: Float[Array, "B"]
) -> Float[Array, "B"]:
    r"""One-step return.

    $y_b = r_b + \gamma_b\, V'(s'_b)$ with $V' = \frac{1}{M} \sum_m Q'(s', \rho'_m(s'))$ (MAPG,
    Eq. 6; DDPG where M = 1).

    Args:
      reward: $r$, reward units per step.
      discount: $\gamma_b$, 0 where the episode terminated (truncation keeps it).
      next_value: $V'$ of the target networks.
    """
    return reward + discount * next_value


@dataclasses.dataclass(frozen=True)
class Mapg:
    """The static part of the algorithm: networks, optimiser and rules."""

    Options: ClassVar = MapgOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "replay"
    selects: ClassVar[tuple[str, ...]] = get_args(heads_.Select)
    presets: ClassVar = {
        "parallel": {  # the proportions of PQL's DDPG (Li et al. 2023): fast targets, a ladder
            "actor_learning_rate": 5e-4,
            "critic_learning_rate": 5e-4,
            "critic_l2": 0.0,
            "tau": 0.05,
            "max_gradient_norm": 0.5,
            "noise": "gaussian",
            "noise_scale": 0.05,
            "noise_scale_last": 0.8,
        }
    }

    actor: Actor
    critic: Critic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""
    gradient: GradientRule = "stored"
    target: TargetRule = "mean"
    noise: Noise = "ou"

    @classmethod
    def make(cls, options: MapgOptions, action_size: int) -> "Mapg":
        """The algorithm with those options, for actions of A numbers."""
        networks = {"hidden": options.hidden, "layer_norm": options.layer_norm}
        return cls(
            actor=Actor(heads=options.heads, action_size=action_size, **networks),
            critic=Critic(**networks),
            optimizer=adam(options.max_gradient_norm),
            gradient=options.gradient,
            target=options.target,
            noise=options.noise,
        )

    @classmethod
    def hyper(cls, options: MapgOptions) -> Hyperparameters:
        """The traced numbers; without a last σ all environments have the first."""
        last = options.noise_scale_last
        return traced(
            Hyperparameters, options, noise_scale_last=options.noise_scale if last is None else last
        )

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is DDPG."""
        return "DDPG" if heads == 1 else f"M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """M = 1 is DDPG."""
        return "ddpg" if heads == 1 else "mapg"

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """Fresh networks, their targets equal to them."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, observation_size))
        actor = self.actor.init(actor_key, observation)
        actions = jnp.zeros((1, 1, self.actor.action_size))
        critic = self.critic.init(critic_key, observation, actions)
        return LearnerState(
            actor=actor,
            critic=critic,
            actor_target=actor,
            critic_target=critic,
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def explorer(self, environments: int) -> Float[Array, "N A"]:
        """The noise, which starts at 0 with every episode."""
        return jnp.zeros((environments, self.actor.action_size))

    def explore(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        explorer: Float[Array, "N A"],
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        r"""$a = \mathrm{clip}(\rho_j(s) + x, \pm 1)$, j drawn uniformly, x the noise.

        (MAPG, Algorithm 1.) What is stored beside the action is j, in a byte where M fits one.
        """
        head_key, noise_key = jax.random.split(key)
        n = len(observation)
        head = heads_.draw(head_key, hyper.heads, (n,))
        scales = exploration.scales(hyper.noise_scale, hyper.noise_scale_last, n)
        noise = exploration.advance(self.noise, noise_key, explorer, scales)
        action = jnp.clip(self.action(learner.actor, observation, head) + noise, -1.0, 1.0)
        stored = head.astype(jnp.uint8 if self.actor.heads <= 256 else jnp.int32)
        return Explored(action, stored, noise)

    def actions(self, actor: Params, observation: Float[Array, "*B D"]) -> Float[Array, "*B M A"]:
        """All M actions, padding included."""
        return cast(Array, self.actor.apply(actor, observation))

    def action(
        self, actor: Params, observation: Float[Array, "*B D"], head: Integer[Array, "*B"]
    ) -> Float[Array, "*B A"]:
        """The action of one head a state; the gradient reaches that head alone."""
        return cast(Array, self.actor.apply(actor, observation, head))

    def values(
        self, critic: Params, observation: Float[Array, "*B D"], actions: Float[Array, "*B K A"]
    ) -> Float[Array, "*B K"]:
        """Q of K actions a state."""
        return cast(Array, self.critic.apply(critic, observation, actions))

    def value(
        self, critic: Params, observation: Float[Array, "*B D"], action: Float[Array, "*B A"]
    ) -> Float[Array, "*B"]:
        """Q of one action a state."""
        return self.values(critic, observation, action[..., None, :])[..., 0]

    def act(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: heads_.Select,
    ) -> Float[Array, "*B A"]:
        """One action a state; see `heads.choose`."""
        proposals, values = self.proposals(learner, observation)
        return heads_.choose(select, key, proposals, values, hyper.heads)

    def proposals(
        self, learner: LearnerState, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The actions of all heads, and Q of each."""
        actions = self.actions(learner.actor, observation)
        return actions, self.values(learner.critic, observation, actions)

    def q_values(
        self,
        learner: LearnerState,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """Q of any K actions a state."""
        return self.values(learner.critic, observation, actions)

    def next_value(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "B D"],
        key: PRNGKeyArray,
    ) -> Float[Array, "B"]:
        r"""$V'(s')$ of the target networks: the mean over heads, or that of one head drawn."""
        if self.target == "sampled":
            head = heads_.draw(key, hyper.heads, observation.shape[:1])
            action = self.action(learner.actor_target, observation, head)
            return self.value(learner.critic_target, observation, action)
        actions = self.actions(learner.actor_target, observation)
        values = self.values(learner.critic_target, observation, actions)
        return heads_.mean(values, hyper.heads)

    def critic_loss(
        self,
        critic: Params,
        batch: Transition,
        target: Float[Array, "B"],
        critic_l2: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        r"""The critic's loss:

        $\frac{1}{B} \sum_b (y_b - Q(s_b, a_b))^2 + \frac{\lambda}{2} \sum_W \|W\|^2$, and mean Q.
        """
        q = self.value(critic, batch.observation, batch.action)
        loss = jnp.square(target - q).mean() + critic_l2 * kernel_l2(critic)
        return loss, q.mean()

    def actor_loss(
        self,
        actor: Params,
        critic: Params,
        batch: Transition,
        hyper: Hyperparameters,
        key: PRNGKeyArray,
    ) -> Float[Array, ""]:
        r"""$-\frac{1}{B} \sum_b Q(s_b, \rho_{j_b}(s_b))$ (MAPG, Algorithm 1).

        $j_b$ is the head that acted (`stored`) or a fresh one (`resampled`); `all` takes the mean
        over the heads instead, the full gradient of Eq. 6's objective.
        """
        if self.gradient == "all":
            actions = self.actions(actor, batch.observation)
            values = self.values(critic, batch.observation, actions)
            return -heads_.mean(values, hyper.heads).mean()
        head = batch.extra
        if self.gradient == "resampled":
            head = heads_.draw(key, hyper.heads, head.shape)
        action = self.action(actor, batch.observation, head)
        return -self.value(critic, batch.observation, action).mean()

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

        (critic_loss, q_mean), critic_gradient = jax.value_and_grad(self.critic_loss, has_aux=True)(
            learner.critic, batch, target, hyper.critic_l2
        )
        critic, critic_optimizer = descend(
            self.optimizer,
            learner.critic,
            critic_gradient,
            learner.critic_optimizer,
            hyper.critic_learning_rate,
        )
        actor_loss, actor_gradient = jax.value_and_grad(self.actor_loss)(
            learner.actor, critic, batch, hyper, head_key
        )
        actor, actor_optimizer = descend(
            self.optimizer,
            learner.actor,
            actor_gradient,
            learner.actor_optimizer,
            hyper.actor_learning_rate,
        )
        updated = LearnerState(
            actor=actor,
            critic=critic,
            actor_target=_towards(learner.actor_target, actor, hyper.tau),
            critic_target=_towards(learner.critic_target, critic, hyper.tau),
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
            updates=learner.updates + 1,
        )
        metrics = UpdateMetrics(
            critic_loss=critic_loss,
            actor_loss=actor_loss,
            q_mean=q_mean,
            critic_gradient_norm=optax.tree.norm(critic_gradient),
            actor_gradient_norm=optax.tree.norm(actor_gradient),
        )
        return updated, metrics


def _towards(target: Params, params: Params, tau: Float[Array, ""]) -> Params:
    r"""$\theta' \leftarrow \theta' + \tau (\theta - \theta')$."""
    return jax.tree.map(lambda x, y: x + tau * (y - x), target, params)
