"""What algorithms with deterministic heads share: the heads, how one acts, and what they climb."""

import dataclasses
from typing import Any, ClassVar, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, Integer, PRNGKeyArray

from mapg_jax.algorithms import exploration, repulsion
from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms.base import Experience, Explored, Transition, traced
from mapg_jax.algorithms.descent import Params, adam
from mapg_jax.algorithms.head_options import HeadNumbers, meant
from mapg_jax.algorithms.networks import Actor, Critic

PROBES = 16  # actions of a state at which the scatter of Q is taken


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

    Hyper: ClassVar[Any] = HeadNumbers
    Metrics: ClassVar = UpdateMetrics
    experience: ClassVar[Experience] = "replay"
    selects: ClassVar[tuple[str, ...]] = get_args(heads_.Select)

    actor: Actor
    critic: Critic
    optimizer: optax.GradientTransformation
    """Scales gradients; the learning rates are applied after it."""
    options: Any
    """Of them, only what is no traced number is read."""

    @classmethod
    def make(cls, options: Any, action_size: int) -> Any:
        """The algorithm with those options, for actions of A numbers."""
        shared = {"hidden": options.hidden, "layer_norm": options.layer_norm}
        actor = Actor(
            heads=options.heads, action_size=action_size, spread=options.head_spread, **shared
        )
        critic = Critic(action_layer=options.action_layer, **shared)
        return cls(actor, critic, adam(options.max_gradient_norm), options)

    @classmethod
    def hyper(cls, options: Any) -> Any:
        """The traced numbers; without a last σ all environments have the first."""
        return traced(cls.Hyper, options, **meant(options))

    def init(self, key: PRNGKeyArray, observation_size: int) -> LearnerState:
        """Fresh networks, their targets equal to them."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, observation_size))
        actor = self.actor.init(actor_key, observation)
        actions = jnp.zeros((1, 1, self.actor.action_size))
        critic = self.init_critic(critic_key, observation, actions)
        return LearnerState(
            actor=actor,
            critic=critic,
            actor_target=actor,
            critic_target=critic,
            actor_optimizer=self.optimizer.init(actor),
            critic_optimizer=self.optimizer.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def init_critic(
        self, key: PRNGKeyArray, observation: Float[Array, "1 D"], actions: Float[Array, "1 1 A"]
    ) -> Params:
        """What the critic learns, fresh."""
        return self.critic.init(key, observation, actions)

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
            action = exploration.random_start(key, learner.updates, action)
        return Explored(action, heads_.stored(head, self.actor.heads), Explorer(noise, head, left))

    def behave(
        self, learner: Any, hyper: Any, observation: Float[Array, "N D"], key: PRNGKeyArray
    ) -> Int[Array, "N"]:
        """The heads that would act next."""
        if self.options.behaviour == "uniform":
            return heads_.draw(key, hyper.heads, (len(observation),))
        _, values = self.proposals(learner, hyper, observation)
        if self.options.behaviour == "argmax-q":
            return heads_.best(values, hyper.heads)
        temperature = hyper.temperature * self.scatter(learner, observation)
        return heads_.draw_by_value(key, values, temperature, hyper.heads)

    def act(
        self,
        learner: Any,
        hyper: Any,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: heads_.Select,
    ) -> Float[Array, "*B A"]:
        """One action a state; see `heads.choose`."""
        proposals, values = self.proposals(learner, hyper, observation)
        return heads_.choose(select, key, proposals, values, hyper.heads)

    def proposals(
        self, learner: Any, hyper: Any, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The actions of all heads, and Q of each."""
        actions = self.actions(learner.actor, observation)
        return actions, self.values(learner.critic, observation, actions)

    def q_values(
        self,
        learner: Any,
        hyper: Any,
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

    def scatter(self, learner: Any, observation: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        r"""$\sigma(s)$, how much it matters at a state what is done there: the unit of the rules.

        The standard deviation of $Q(s, a)$ over a uniform in [-1, 1], at the same few a always.
        The scatter of Q over states would be another thing: where states differ in value more than
        actions do, as in locomotion, a rule in its unit drowns what the critic says of actions.
        """
        shape = (PROBES, self.actor.action_size)
        with jax.ensure_compile_time_eval():  # a constant of the program, not drawn at every update
            probes = jax.random.uniform(jax.random.key(0), shape, minval=-1.0, maxval=1.0)
        actions = jnp.broadcast_to(probes, (*observation.shape[:-1], *shape))
        return self.values(learner.critic, observation, actions).std(-1)

    def strength(self, learner: Any, hyper: Any, observation: Float[Array, "B D"]) -> Strength:
        """How strong the rules are that keep heads apart, by the mean scatter of a batch."""
        if self.options.repulsion == "none" and self.options.floor is None:
            return Strength(jnp.zeros(()), jnp.zeros(()))  # the critic need not be asked
        scatter = self.scatter(learner, observation).mean()
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
