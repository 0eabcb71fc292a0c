"""Normalised advantage functions with M peaks a state (Gu et al. 2016, 1603.00748).

M = 1 is NAF. Several peaks are ours: the advantage is the highest of M quadratics, and V stays the
maximum of Q. All functions are pure.
"""

import dataclasses
import functools
from typing import ClassVar, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mapg_jax.algorithms import exploration
from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Experience, Explored, Transition, traced
from mapg_jax.algorithms.descent import Params, adam, minimize, towards
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.networks import Peaks
from mapg_jax.algorithms.options import Options, option
from mapg_jax.algorithms.returns import td_target


@dataclasses.dataclass(frozen=True, kw_only=True)
class NafOptions(Options):
    """The numbers of NAF."""

    learning_rate: float = option(1e-3, "Of Adam.", above=0)
    tau: float = option(
        1e-3, "τ, the step of the target network: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
    )
    value_unit: float = option(
        1.0,
        "The reward that counts as 1 in the network's Q: as if rewards were divided by it.",
        above=0,
    )
    noise: Noise = option(
        "ou",
        "Exploration noise added to the action: Ornstein-Uhlenbeck, Gaussian or none.",
    )
    noise_scale: float = option(0.2, "σ of the noise, in units of [-1, 1].", at_least=0)
    head_spread: float = option(
        1.0,
        "The biases of the peaks start within ± this, before the tanh; those of the first within "
        "± 0.003, as in NAF.",
        above=0,
        of_heads=True,
    )


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    tau: jax.Array  # [], τ
    learning_rate: jax.Array  # []
    noise_scale: jax.Array  # []


class LearnerState(struct.PyTreeNode):
    """All that an update changes."""

    critic: Params
    critic_target: Params
    optimizer: optax.OptState
    updates: jax.Array  # [] i32


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # []
    q_mean: jax.Array  # []
    value_mean: jax.Array  # []
    heads_reached: jax.Array  # [], the share of the peaks that got gradient from the batch
    critic_gradient_norm: jax.Array  # []


class Landscape(NamedTuple):
    """Q over the actions of a state."""

    value: Float[Array, "*B"]  # V, the maximum
    peaks: Float[Array, "*B M A"]  # μ, in [-1, 1]
    cholesky: Float[Array, "*B M A A"]  # L, lower triangular, its diagonal positive
    height: Float[Array, "*B M"]  # b, above V: 0 at the highest peak


def quadratics(landscape: Landscape, action: Float[Array, "*B A"]) -> Float[Array, "*B M"]:
    r"""$V + b_m - \frac{1}{2} \|L_m^\top (a - \mu_m)\|^2$ (NAF, Eq. 6 and 7, a peak each)."""
    away = action[..., None, :] - landscape.peaks
    along = (landscape.cholesky * away[..., :, None]).sum(-2)
    return landscape.value[..., None] + landscape.height - 0.5 * jnp.square(along).sum(-1)


def q_value(
    landscape: Landscape, action: Float[Array, "*B A"], heads: Int[Array, ""]
) -> Float[Array, "*B"]:
    r"""$Q(s, a) = V + \max_m (b_m - \frac{1}{2} \|L_m^\top (a - \mu_m)\|^2)$."""
    return _highest(quadratics(landscape, action), heads)


def _highest(values: Float[Array, "*B M"], heads: Int[Array, ""]) -> Float[Array, "*B"]:
    return jnp.where(heads_.in_use(heads, values.shape), values, -jnp.inf).max(-1)


@dataclasses.dataclass(frozen=True)
class Naf:
    """The static part of the algorithm: network and optimiser."""

    Options: ClassVar = NafOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "replay"
    selects: ClassVar[tuple[str, ...]] = get_args(heads_.Select)
    presets: ClassVar = {
        "reference": {
            "hidden": (200, 200),
            "batch_size": 100,
            "updates_per_step": 5.0,
            "value_unit": 100.0,  # as keras-rl divides Pendulum's rewards
        }
    }

    critic: Peaks
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rate is applied after it."""
    noise: Noise
    value_unit: float

    @classmethod
    def make(cls, options: NafOptions, action_size: int) -> "Naf":
        """The algorithm with those options, for actions of A numbers."""
        critic = Peaks(
            heads=options.heads,
            action_size=action_size,
            hidden=options.hidden,
            layer_norm=options.layer_norm,
            spread=options.head_spread,
        )
        optimizer = adam(options.max_gradient_norm)
        return cls(critic, optimizer, options.noise, options.value_unit)

    @classmethod
    def hyper(cls, options: NafOptions) -> Hyperparameters:
        """The traced numbers."""
        return traced(Hyperparameters, options)

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is NAF."""
        return "NAF" if heads == 1 else f"NAF, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "naf"

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """A fresh network, its target equal to it."""
        critic = self.critic.init(key, jnp.zeros((1, observation_size)))
        return LearnerState(
            critic=critic,
            critic_target=critic,
            optimizer=self.optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def landscape(
        self, critic: Params, observation: Float[Array, "*B D"], heads: Int[Array, ""]
    ) -> Landscape:
        r"""Q over the actions of each state: $b_m = \beta_m - \max_j \beta_j$.

        V alone moves the level, so that with one peak, whose b is 0, nothing beside NAF learns.
        The network tells all in `value_unit`. Where that is small beside the returns, V lags, and
        the peaks flee to the bounds to make up for it.
        """
        value, peaks, cholesky, height = cast(tuple, self.critic.apply(critic, observation))
        height = height - _highest(height, heads)[..., None]
        unit = self.value_unit
        return Landscape(unit * value, peaks, unit**0.5 * cholesky, unit * height)

    def explorer(self, environments: int) -> Float[Array, "N A"]:
        """The noise, which starts at 0 with every episode."""
        return jnp.zeros((environments, self.critic.action_size))

    def explore(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        explorer: Float[Array, "N A"],
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        r"""$a = \mathrm{clip}(\mu_j(s) + x, \pm 1)$, j drawn uniformly, x the noise."""
        head_key, noise_key = jax.random.split(key)
        head = heads_.draw(head_key, hyper.heads, (len(observation),))
        scale = jnp.reshape(hyper.noise_scale, (1, 1))
        noise = exploration.advance(self.noise, noise_key, explorer, scale)
        peak = heads_.take(self.landscape(learner.critic, observation, hyper.heads).peaks, head)
        return Explored(jnp.clip(peak + noise, -1.0, 1.0), (), noise)

    def act(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: heads_.Select,
    ) -> Float[Array, "*B A"]:
        """One action a state: a peak drawn uniformly, or the highest (`argmax-q`); see `choose`."""
        proposals, values = self.proposals(learner, hyper, observation)
        return heads_.choose(select, key, proposals, values, hyper.heads)

    def proposals(
        self, learner: LearnerState, hyper: Hyperparameters, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The peaks, and Q at each: its height, unless another peak towers over it there."""
        peaks = self.landscape(learner.critic, observation, hyper.heads).peaks
        return peaks, self.q_values(learner, hyper, observation, peaks)

    def q_values(
        self,
        learner: LearnerState,
        hyper: Hyperparameters,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """Q of any K actions a state."""
        landscape = self.landscape(learner.critic, observation, hyper.heads)
        one = functools.partial(q_value, landscape, heads=hyper.heads)
        return jax.vmap(one, in_axes=-2, out_axes=-1)(actions)

    def critic_loss(
        self,
        critic: Params,
        batch: Transition,
        target: Float[Array, "B"],
        hyper: Hyperparameters,
    ) -> tuple[Float[Array, ""], tuple[Float[Array, "B"], Landscape]]:
        r"""$\frac{1}{B} \sum_b (y_b - Q(s_b, a_b))^2$; beside it Q and its landscape."""
        landscape = self.landscape(critic, batch.observation, hyper.heads)
        q = q_value(landscape, batch.action, hyper.heads)
        return jnp.square(target - q).mean(), (q, landscape)

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Transition, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        r"""One update towards $y = r + \gamma V'(s')$, and of the target (NAF, Algorithm 1).

        Args:
          learner: its state.
          hyper: its numbers.
          batch: leaves [B, ...], observations normalised.
          key: nothing is drawn.
        """
        discount = jnp.where(batch.terminal, 0.0, hyper.discount)
        following = self.landscape(learner.critic_target, batch.next_observation, hyper.heads)
        target = td_target(batch.reward, discount, following.value)
        critic = minimize(
            lambda params: self.critic_loss(params, batch, target, hyper),
            self.optimizer,
            learner.critic,
            learner.optimizer,
            hyper.learning_rate,
        )
        q, landscape = critic.aux
        updated = LearnerState(
            critic=critic.params,
            critic_target=towards(learner.critic_target, critic.params, hyper.tau),
            optimizer=critic.optimizer,
            updates=learner.updates + 1,
        )
        metrics = UpdateMetrics(
            critic_loss=critic.loss,
            q_mean=q.mean(),
            value_mean=landscape.value.mean(),
            heads_reached=_reached(landscape, batch.action, hyper.heads),
            critic_gradient_norm=critic.gradient_norm,
        )
        return updated, metrics


def _reached(
    landscape: Landscape, action: Float[Array, "B A"], heads: Int[Array, ""]
) -> Float[Array, ""]:
    """The share of the peaks that are the highest somewhere: a maximum hands gradient to one."""
    each = quadratics(landscape, action)
    number = jnp.arange(each.shape[-1])[None]
    return (heads_.best(each, heads)[:, None] == number).any(0).sum() / heads
