"""What acts and learns: the algorithm behind the normalisation of its observations."""

import dataclasses

import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from mapg_jax import normalization
from mapg_jax.config import Config
from mapg_jax.mapg import Hyperparameters, LearnerState, Mapg, Transition, UpdateMetrics
from mapg_jax.networks import Actor, Critic
from mapg_jax.normalization import NormalizerState


class AgentState(struct.PyTreeNode):
    """All that acting, evaluating and learning read."""

    learner: LearnerState
    normalizer: NormalizerState
    hyper: Hyperparameters


@dataclasses.dataclass(frozen=True)
class Agent:
    """The algorithm and how its observations are normalised; both networks see the same."""

    algorithm: Mapg
    observation_clip: float | None
    """None leaves observations as they are."""

    def init(self, key: PRNGKeyArray, hyper: Hyperparameters, observation_size: int) -> AgentState:
        """A fresh agent that has seen no observation."""
        learner = self.algorithm.init(key, observation_size)
        return AgentState(learner, normalization.init(observation_size), hyper)

    def see(self, state: AgentState, observation: Float[Array, "N D"]) -> AgentState:
        """The statistics of observations, with a batch added."""
        if self.observation_clip is None:
            return state
        return state.replace(normalizer=normalization.update(state.normalizer, observation))

    def normalize(
        self, state: AgentState, observation: Float[Array, "*B D"]
    ) -> Float[Array, "*B D"]:
        """Observations as the networks take them."""
        if self.observation_clip is None:
            return observation
        return normalization.normalize(state.normalizer, observation, self.observation_clip)

    def proposals(
        self, state: AgentState, observation: Float[Array, "*B D"]
    ) -> Float[Array, "*B M A"]:
        """The M actions proposed for raw observations."""
        return self.algorithm.proposals(state.learner.actor, self.normalize(state, observation))

    def proposal(
        self, state: AgentState, observation: Float[Array, "*B D"], head: Integer[Array, "*B"]
    ) -> Float[Array, "*B A"]:
        """The action that one head a state proposes for raw observations."""
        observation = self.normalize(state, observation)
        return self.algorithm.proposal(state.learner.actor, observation, head)

    def proposals_and_values(
        self, state: AgentState, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The M actions proposed for raw observations, and the critic's value of each."""
        observation = self.normalize(state, observation)
        proposals = self.algorithm.proposals(state.learner.actor, observation)
        return proposals, self.algorithm.values(state.learner.critic, observation, proposals)

    def prepare(self, state: AgentState, batch: Transition) -> Transition:
        """A batch of stored transitions as the learner takes it."""
        return batch._replace(
            observation=self.normalize(state, batch.observation),
            next_observation=self.normalize(state, batch.next_observation),
        )

    def learn(
        self, state: AgentState, batch: Transition, key: PRNGKeyArray
    ) -> tuple[AgentState, UpdateMetrics]:
        """One update on a prepared batch."""
        learner, metrics = self.algorithm.update(state.learner, state.hyper, batch, key)
        return state.replace(learner=learner), metrics


def make_agent(config: Config, action_size: int, padded_heads: int | None = None) -> Agent:
    """The agent of a run; `padded_heads` gives the actor more heads than it uses."""
    optimizer = optax.scale_by_adam()
    if config.max_gradient_norm is not None:
        optimizer = optax.chain(optax.clip_by_global_norm(config.max_gradient_norm), optimizer)
    networks = {"hidden": config.hidden, "layer_norm": config.layer_norm}
    algorithm = Mapg(
        actor=Actor(heads=padded_heads or config.heads, action_size=action_size, **networks),
        critic=Critic(**networks),
        optimizer=optimizer,
        gradient=config.gradient,
        target=config.target,
    )
    return Agent(algorithm, config.observation_clip if config.normalize else None)


def hyperparameters(config: Config) -> Hyperparameters:
    """The traced numbers of a run."""
    return Hyperparameters(
        heads=jnp.asarray(config.heads, jnp.int32),
        discount=jnp.asarray(config.discount, jnp.float32),
        tau=jnp.asarray(config.tau, jnp.float32),
        actor_learning_rate=jnp.asarray(config.actor_learning_rate, jnp.float32),
        critic_learning_rate=jnp.asarray(config.critic_learning_rate, jnp.float32),
        critic_l2=jnp.asarray(config.critic_l2, jnp.float32),
    )
