"""What algorithms with deterministic heads share: the heads, how one acts, and what they climb.

The rules by which heads are kept apart are options here, and functions in `heads` and `repulsion`;
docs/heads.md says what each is good for.
"""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Integer, PRNGKeyArray

from mapg_jax.algorithms import exploration, repulsion
from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Explored, Transition
from mapg_jax.algorithms.descent import Params
from mapg_jax.algorithms.exploration import Noise
from mapg_jax.algorithms.networks import LAST_LAYER_SCALE, Actor, Critic
from mapg_jax.algorithms.options import Options, option
from mapg_jax.algorithms.repulsion import Repulsion

GradientRule = Literal["stored", "resampled", "all"]
"""Which heads an actor update reaches: the one that acted, a fresh one a sample, or all."""
TargetRule = Literal["mean", "sampled", "max"]
"""What the target bootstraps from: the mean over the heads (Eq. 6), one drawn, or the best."""

WHOLE_EPISODE = 2**31 - 1  # steps; no episode is as long


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeterministicOptions(Options):
    """The numbers of an actor with deterministic heads, and of the critic that they climb."""

    tau: float = option(
        0.01, "τ, the step of the target networks: θ' ← θ' + τ(θ - θ').", above=0, at_most=1
    )
    max_gradient_norm: float | None = option(
        None, "Gradients are scaled down to this norm; none by default.", above=0
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
    random_start: bool = option(
        False, "Before the first update, act by uniformly random actions instead of the heads."
    )
    gradient: GradientRule = option(
        "stored",
        "Heads an actor update reaches: the one that acted, a fresh one per sample, or all.",
        of_heads=True,
    )
    target: TargetRule = option(
        "mean",
        "The target bootstraps from the mean over heads (Eq. 6), from one head per sample, or from "
        "the one that the target critic values most.",
        of_heads=True,
    )
    behaviour: heads_.Behaviour = option(
        "uniform",
        "The head that acts in training: drawn uniformly, the best by the critic, or drawn by a "
        "softmax of its values.",
        of_heads=True,
    )
    temperature: float = option(
        1.0,
        "Of that softmax, in units of the standard deviation of Q over a state's heads.",
        above=0,
        of_heads=True,
    )
    hold: int | Literal["episode"] = option(
        1, "Steps for which a head keeps acting, or episode.", at_least=1, of_heads=True
    )
    head_spread: float = option(
        LAST_LAYER_SCALE,
        "The heads' biases start within ± this, before the tanh.",
        above=0,
        of_heads=True,
    )
    repulsion: Repulsion = option(
        "none",
        "What keeps a state's proposals apart: nothing, Stein's direction, or inverse distance.",
        of_heads=True,
    )
    repulsion_weight: float = option(
        0.3,
        "α of the repulsion, in units of the standard deviation of Q over a batch.",
        at_least=0,
        of_heads=True,
    )
    repulsion_updates: int = option(
        0,
        "Updates over which that weight falls to 0 in a straight line; 0 keeps it as it is.",
        at_least=0,
        of_heads=True,
    )
    floor: float | None = option(
        None,
        "A head is credited for what it adds to the heads before it, smoothed by this, in units of "
        "the standard deviation of Q over a batch; none by default.",
        above=0,
        of_heads=True,
    )


def numbers(options: DeterministicOptions) -> dict[str, Any]:
    """The traced numbers that are not written as they are meant."""
    last = options.noise_scale_last
    return {
        "noise_scale_last": options.noise_scale if last is None else last,
        "hold": WHOLE_EPISODE if options.hold == "episode" else options.hold,
    }


def make_networks(options: DeterministicOptions, action_size: int) -> tuple[Actor, Critic]:
    """Actor and critic with those options, for actions of A numbers."""
    shared = {"hidden": options.hidden, "layer_norm": options.layer_norm}
    actor = Actor(
        heads=options.heads, action_size=action_size, spread=options.head_spread, **shared
    )
    return actor, Critic(**shared)


class Explorer(NamedTuple):
    """What is carried from step to step; zeros where an episode starts."""

    noise: jax.Array  # [N, A]
    head: jax.Array  # [N] i32, the one that acts
    left: jax.Array  # [N] i32, steps for which it still will


class Strength(NamedTuple):
    """Of the rules that keep heads apart, in units of Q."""

    repulsion: jax.Array  # [], its weight
    floor: jax.Array  # [], its temperature


@dataclasses.dataclass(frozen=True)
class Deterministic:
    """The static part: networks, optimiser and rules. A subclass says how the critic learns."""

    selects: ClassVar[tuple[str, ...]] = get_args(heads_.Select)

    actor: Actor
    critic: Critic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""
    options: Any
    """Of them, only what is no traced number is read."""

    def explorer(self, environments: int) -> Explorer:
        """No noise, and a head to be drawn."""
        none = jnp.zeros(environments, jnp.int32)
        return Explorer(jnp.zeros((environments, self.actor.action_size)), none, none)

    def explore(
        self,
        learner: Any,
        hyper: Any,
        explorer: Explorer,
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        r"""$a = \mathrm{clip}(\rho_j(s) + x, \pm 1)$, x the noise.

        j is drawn uniformly (MAPG, Algorithm 1), or as `behaviour` says, and held. What is stored
        beside the action is j, in a byte where M fits one.
        """
        head_key, noise_key = jax.random.split(key)
        n = len(observation)
        drawn = self.behave(learner, hyper, observation, head_key)
        fresh = explorer.left == 0
        head = jnp.where(fresh, drawn, explorer.head)
        left = jnp.where(fresh, hyper.hold, explorer.left) - 1

        scales = exploration.scales(hyper.noise_scale, hyper.noise_scale_last, n)
        noise = exploration.advance(self.options.noise, noise_key, explorer.noise, scales)
        action = jnp.clip(self.action(learner.actor, observation, head) + noise, -1.0, 1.0)
        if self.options.random_start:
            anything = jax.random.uniform(noise_key, action.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(learner.updates == 0, anything, action)
        stored = head.astype(jnp.uint8 if self.actor.heads <= 256 else jnp.int32)
        return Explored(action, stored, Explorer(noise, head, left))

    def behave(
        self, learner: Any, hyper: Any, observation: Float[Array, "N D"], key: PRNGKeyArray
    ) -> Int[Array, "N"]:
        """The heads that would act next."""
        if self.options.behaviour == "uniform":
            return heads_.draw(key, hyper.heads, (len(observation),))
        _, values = self.proposals(learner, observation)
        if self.options.behaviour == "argmax-q":
            return heads_.best(values, hyper.heads)
        return heads_.draw_by_value(key, values, hyper.temperature, hyper.heads)

    def act(
        self,
        learner: Any,
        hyper: Any,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: heads_.Select,
    ) -> Float[Array, "*B A"]:
        """One action a state; see `heads.choose`."""
        proposals, values = self.proposals(learner, observation)
        return heads_.choose(select, key, proposals, values, hyper.heads)

    def proposals(
        self, learner: Any, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The actions of all heads, and Q of each."""
        actions = self.actions(learner.actor, observation)
        return actions, self.values(learner.critic, observation, actions)

    def q_values(
        self,
        learner: Any,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """Q of any K actions a state."""
        return self.values(learner.critic, observation, actions)

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

    def candidates(
        self, actor: Params, hyper: Any, observation: Float[Array, "B D"], key: PRNGKeyArray
    ) -> Float[Array, "B K A"]:
        """The actions that a target looks at: those of all heads, or that of one drawn."""
        if self.options.target == "sampled":
            head = heads_.draw(key, hyper.heads, observation.shape[:1])
            return self.action(actor, observation, head)[:, None]
        return self.actions(actor, observation)

    def over_candidates(self, values: Float[Array, "B K"], hyper: Any) -> Float[Array, "B"]:
        r"""$V'(s')$ of the values of the candidates."""
        if self.options.target == "sampled":
            return values[:, 0]
        if self.options.target == "max":
            return jnp.where(heads_.in_use(hyper.heads, values.shape), values, -jnp.inf).max(-1)
        return heads_.mean(values, hyper.heads)

    def strength(self, learner: Any, hyper: Any, q: Float[Array, "B"]) -> Strength:
        """How strong the rules are that keep heads apart, by the scatter of Q over a batch."""
        scatter = q.std()
        total = jnp.where(hyper.repulsion_updates > 0, hyper.repulsion_updates, jnp.inf)
        left = jnp.maximum(1 - learner.updates / total, 0.0)
        floor = self.options.floor or 0.0
        return Strength(hyper.repulsion_weight * left * scatter, floor * scatter)

    def actor_loss(
        self,
        actor: Params,
        critic: Params,
        batch: Transition,
        hyper: Any,
        strength: Strength,
        key: PRNGKeyArray,
    ) -> Float[Array, ""]:
        r"""$-\frac{1}{B} \sum_b Q(s_b, \rho_{j_b}(s_b))$ (MAPG, Algorithm 1).

        $j_b$ is the head that acted (`stored`) or a fresh one (`resampled`); `all` takes the mean
        over the heads instead, the full gradient of Eq. 6's objective. A floor credits Q in turn;
        a repulsion adds its direction to the slope of Q.
        """
        head = None
        if self.options.gradient != "all":
            head = batch.extra
        if self.options.gradient == "resampled":
            head = heads_.draw(key, hyper.heads, batch.extra.shape)
        if head is None or self.options.floor is not None:
            actions = self.actions(actor, batch.observation)
            values = self.values(critic, batch.observation, actions)
            if self.options.floor is not None:
                values = repulsion.credit(values, strength.floor)
            gain = _reached(values, head, hyper)
        else:
            gain = self.value(
                critic, batch.observation, self.action(actor, batch.observation, head)
            )
        loss = -gain.mean()
        if self.options.repulsion == "none":
            return loss
        gain = self.repelled(actor, critic, batch.observation, hyper, strength.repulsion)
        return loss - _reached(gain, head, hyper).mean()

    def repelled(
        self,
        actor: Params,
        critic: Params,
        observation: Float[Array, "B D"],
        hyper: Any,
        weight: Float[Array, ""],
    ) -> Float[Array, "B M"]:
        """What has the repulsion's direction as its gradient in the proposals."""
        actions = self.actions(actor, observation)
        fixed = jax.lax.stop_gradient(actions)
        if self.options.repulsion == "stein":
            slopes = jax.grad(lambda a: self.values(critic, observation, a).sum())(fixed)
            direction = repulsion.stein(fixed, slopes, weight, hyper.heads)
        else:
            direction = repulsion.inverse_distance(fixed, weight, hyper.heads)
        return (jax.lax.stop_gradient(direction) * actions).sum(-1)


def _reached(
    gain: Float[Array, "B M"], head: Integer[Array, "B"] | None, hyper: Any
) -> Float[Array, "B"]:
    """Of the head that an update reaches, or the mean over all."""
    if head is None:
        return heads_.mean(gain, hyper.heads)
    return heads_.take(gain[..., None], head)[..., 0]
