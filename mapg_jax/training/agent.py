"""What acts and learns: the algorithm behind the normalisation of its observations."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from mapg_jax.algorithms import a3c, heads, mapg, normalization
from mapg_jax.algorithms.a3c import A3c
from mapg_jax.algorithms.descent import adam
from mapg_jax.algorithms.mapg import Mapg
from mapg_jax.algorithms.networks import Actor, Critic, GaussianActor, StateCritic
from mapg_jax.algorithms.normalization import NormalizerState
from mapg_jax.training.config import Config


class AgentState(struct.PyTreeNode):
    """All that acting, evaluating and learning read."""

    learner: Any  # the LearnerState of the algorithm
    normalizer: NormalizerState
    hyper: Any  # the Hyperparameters of the algorithm


@dataclasses.dataclass(frozen=True)
class Agent:
    """The algorithm and how its observations are normalised; both networks see the same.

    What acting and evaluating need of any algorithm; `MapgAgent` and `A3cAgent` also learn.
    """

    algorithm: Any
    """`Mapg` or `A3c`."""
    observation_clip: float | None
    """None leaves observations as they are."""

    def init(self, key: PRNGKeyArray, hyper: Any, observation_size: int) -> AgentState:
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

    def proposals_and_values(
        self, state: AgentState, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The M actions proposed for raw observations, and the critic's value of each."""
        observation = self.normalize(state, observation)
        proposals = self.algorithm.proposals(state.learner.actor, observation)
        return proposals, self.algorithm.values(state.learner.critic, observation, proposals)

    def act(
        self,
        state: AgentState,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: heads.Select,
    ) -> Float[Array, "*B A"]:
        """One action a state for raw observations, in one of the ways of `algorithm.selects`."""
        observation = self.normalize(state, observation)
        return self.algorithm.act(state.learner, state.hyper, observation, key, select)

    def prepare(self, state: AgentState, batch: Any) -> Any:
        """A batch of raw transitions, or a rollout, as the learner takes it."""
        return batch._replace(
            observation=self.normalize(state, batch.observation),
            next_observation=self.normalize(state, batch.next_observation),
        )


class MapgAgent(Agent):
    """MAPG: acts by the head it is told, and learns from stored transitions."""

    algorithm: Mapg

    def proposal(
        self, state: AgentState, observation: Float[Array, "*B D"], head: Integer[Array, "*B"]
    ) -> Float[Array, "*B A"]:
        """The action that one head a state proposes for raw observations."""
        observation = self.normalize(state, observation)
        return self.algorithm.proposal(state.learner.actor, observation, head)

    def learn(
        self, state: AgentState, batch: mapg.Transition, key: PRNGKeyArray
    ) -> tuple[AgentState, mapg.UpdateMetrics]:
        """One update on a prepared batch."""
        learner, metrics = self.algorithm.update(state.learner, state.hyper, batch, key)
        return state.replace(learner=learner), metrics


class A3cAgent(Agent):
    """A3C: acts by sampling, and learns from the rollout it has just collected."""

    algorithm: A3c

    def sample(
        self, state: AgentState, observation: Float[Array, "*B D"], key: PRNGKeyArray
    ) -> Float[Array, "*B A"]:
        """One draw of the Gaussian a state for raw observations, not clipped."""
        observation = self.normalize(state, observation)
        return self.algorithm.sample(state.learner.actor, observation, key)

    def learn(
        self, state: AgentState, rollout: a3c.Rollout
    ) -> tuple[AgentState, a3c.UpdateMetrics]:
        """One update on a prepared rollout."""
        learner, metrics = self.algorithm.update(state.learner, state.hyper, rollout)
        return state.replace(learner=learner), metrics


def make_agent(config: Config, action_size: int, padded_heads: int | None = None) -> Agent:
    """The agent of a run; `padded_heads` gives MAPG's actor more heads than it uses."""
    networks = {"hidden": config.hidden, "layer_norm": config.layer_norm}
    clip = config.observation_clip if config.normalize else None
    if config.algorithm == "a3c":
        algorithm = A3c(
            actor=GaussianActor(action_size=action_size, **networks),
            critic=StateCritic(**networks),
            optimizer=adam(config.a3c_max_gradient_norm),
        )
        return A3cAgent(algorithm, clip)
    algorithm = Mapg(
        actor=Actor(heads=padded_heads or config.heads, action_size=action_size, **networks),
        critic=Critic(**networks),
        optimizer=adam(config.max_gradient_norm),
        gradient=config.gradient,
        target=config.target,
    )
    return MapgAgent(algorithm, clip)


def hyperparameters(config: Config) -> mapg.Hyperparameters | a3c.Hyperparameters:
    """The traced numbers of a run."""
    if config.algorithm == "a3c":
        return a3c.Hyperparameters(
            heads=jnp.asarray(config.heads, jnp.int32),
            discount=jnp.asarray(config.discount, jnp.float32),
            actor_learning_rate=jnp.asarray(config.a3c_actor_learning_rate, jnp.float32),
            critic_learning_rate=jnp.asarray(config.a3c_critic_learning_rate, jnp.float32),
            entropy_weight=jnp.asarray(config.a3c_entropy_weight, jnp.float32),
        )
    return mapg.Hyperparameters(
        heads=jnp.asarray(config.heads, jnp.int32),
        discount=jnp.asarray(config.discount, jnp.float32),
        tau=jnp.asarray(config.tau, jnp.float32),
        actor_learning_rate=jnp.asarray(config.actor_learning_rate, jnp.float32),
        critic_learning_rate=jnp.asarray(config.critic_learning_rate, jnp.float32),
        critic_l2=jnp.asarray(config.critic_l2, jnp.float32),
        noise_scale=jnp.asarray(config.noise_scale, jnp.float32),
        noise_scale_last=jnp.asarray(
            config.noise_scale if config.noise_scale_last is None else config.noise_scale_last,
            jnp.float32,
        ),
    )
