"""What acts and learns: an algorithm behind the normalisation of its observations."""

import dataclasses
from typing import Any

import jax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import normalization, registry, shards
from mapg_jax.algorithms.base import Algorithm, Explored, Rollout, Transition
from mapg_jax.algorithms.normalization import NormalizerState
from mapg_jax.training.config import Config


class AgentState(struct.PyTreeNode):
    """All that acting, evaluating and learning read."""

    learner: Any  # of the algorithm
    normalizer: NormalizerState
    hyper: Any  # the traced numbers of the algorithm


@dataclasses.dataclass(frozen=True)
class Agent:
    """An algorithm and how its observations are normalised; all networks see the same."""

    algorithm: Algorithm
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
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The M actions proposed for raw observations, and the critic's value of each."""
        return self.algorithm.proposals(
            state.learner, state.hyper, self.normalize(state, observation)
        )

    def q_values(
        self,
        state: AgentState,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """The critic's values of any K actions for raw observations."""
        observation = self.normalize(state, observation)
        return self.algorithm.q_values(state.learner, state.hyper, observation, actions)

    def act(
        self, state: AgentState, observation: Float[Array, "*B D"], key: PRNGKeyArray, select: str
    ) -> Float[Array, "*B A"]:
        """One action a state for raw observations, in one of the ways of `algorithm.selects`."""
        observation = self.normalize(state, observation)
        return self.algorithm.act(state.learner, state.hyper, observation, key, select)

    def key_of_step(self, state: AgentState, key: PRNGKeyArray, step: Any) -> PRNGKeyArray:
        """The key of `act` at a step of an episode: one for as long as a choice is held."""
        held = step if not hasattr(state.hyper, "hold") else step // state.hyper.hold
        return jax.random.fold_in(key, held)

    def explore(
        self, state: AgentState, explorer: Any, observation: Float[Array, "N D"], key: PRNGKeyArray
    ) -> Explored:
        """Acts in training on raw observations."""
        observation = self.normalize(state, observation)
        return self.algorithm.explore(state.learner, state.hyper, explorer, observation, key)

    def prepare(self, state: AgentState, steps: Transition) -> Transition:
        """Raw transitions as the algorithm takes them."""
        return steps._replace(
            observation=self.normalize(state, steps.observation),
            next_observation=self.normalize(state, steps.next_observation),
        )

    def learn(
        self, state: AgentState, batch: Transition | Rollout, key: PRNGKeyArray
    ) -> tuple[AgentState, Any]:
        """One update on prepared transitions; what it reports is averaged over shards."""
        learner, metrics = self.algorithm.update(state.learner, state.hyper, batch, key)
        return state.replace(learner=learner), shards.mean(metrics)


def make_agent(config: Config, action_size: int, padded_heads: int | None = None) -> Agent:
    """The agent of a run; `padded_heads` gives its networks more heads than it uses."""
    options = config if padded_heads is None else dataclasses.replace(config, heads=padded_heads)
    algorithm = registry.find(config.algorithm).make(options, action_size)
    return Agent(algorithm, config.observation_clip if config.normalize else None)


def hyperparameters(config: Config) -> Any:
    """The traced numbers of a run."""
    return registry.find(config.algorithm).hyper(config)
