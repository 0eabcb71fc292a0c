"""The two kinds of turn: one step of every environment and replay, or n steps and one update."""

import dataclasses
import fractions
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from mapg_jax.algorithms import shards
from mapg_jax.algorithms.base import Experience, Rollout, Transition
from mapg_jax.training import replay
from mapg_jax.training.agent import Agent
from mapg_jax.training.state import TrainState, tree_bytes

Step = Callable[[TrainState, PRNGKeyArray], tuple[TrainState, Transition, Bool[Array, "N"]]]
"""One step of every environment; see `Trainer.step`."""


@runtime_checkable
class Turn(Protocol):
    """(state) → the state after one more turn."""

    @property
    def steps(self) -> int:
        """Environment steps, all environments together."""
        ...

    @property
    def updates_ratio(self) -> fractions.Fraction:
        """Updates per environment step."""
        ...

    def begin(self, state: TrainState) -> TrainState:
        """The state before the first turn, with what the turns keep in it."""
        ...

    def bytes(self, state: TrainState) -> int:
        """Memory that a turn takes beside a state of those shapes, at least."""
        ...

    def __call__(self, state: TrainState) -> TrainState: ...


@dataclasses.dataclass(frozen=True)
class ReplayTurn:
    """One step of every environment, stored; then the updates that are due.

    p / q is the number of updates per environment step; a turn of N environment steps earns N·p
    credits, and each update costs q, so that any ratio is met exactly.
    """

    config: Any  # a ReplayConfig
    agent: Agent
    step: Step

    @property
    def steps(self) -> int:
        return self.config.environments

    @property
    def updates_ratio(self) -> fractions.Fraction:
        return fractions.Fraction(self.config.updates_per_step).limit_denominator(100_000)

    @property
    def most_updates(self) -> int:
        """The most that a turn can make."""
        return math.ceil(self.config.environments * self.updates_ratio)

    def begin(self, state: TrainState) -> TrainState:
        """An empty replay, and no credit."""
        observation = jnp.asarray(state.env.obs)
        explored = jax.eval_shape(
            self.agent.explore, state.agent, state.explorer, observation, state.key
        )
        transition = Transition(
            observation=observation,
            extra=explored.extra,
            action=explored.action,
            reward=state.env.reward,
            terminal=state.env.done > 0.5,
            next_observation=observation,
        )
        slots = self.config.replay_size // self.config.shards
        return state.replace(
            replay=replay.init(transition, slots, self.config.episode_steps()),
            update_credit=jnp.zeros((), jnp.int32),
        )

    def __call__(self, state: TrainState) -> TrainState:
        key, *keys = jax.random.split(state.key, 4)
        collect_key, sample_key, update_key = map(shards.own, keys)
        state = self.collect(state.replace(key=key), collect_key)
        return self.learn(state, sample_key, update_key)

    def bytes(self, state: TrainState) -> int:
        """Of the batches of its updates."""
        steps = self.most_updates * self.config.batch_size
        return steps * replay.bytes_of_a_step(state.replay)

    def collect(self, state: TrainState, key: PRNGKeyArray) -> TrainState:
        """One step of every environment, stored where it is finite."""
        state = state.replace(agent=self.agent.see(state.agent, jnp.asarray(state.env.obs)))
        state, transition, ended = self.step(state, key)
        upcoming, whole = jnp.asarray(state.env.obs), ~state.env.info["broken"]
        return state.replace(replay=replay.add(state.replay, transition, ended, upcoming, whole))

    def _has_enough(self, state: TrainState) -> Bool[Array, ""]:
        """Whether there is enough to begin, also after a run that was saved without its replay."""
        starts = self.config.learning_starts
        stored = shards.total(replay.added(state.replay))
        return (state.env_steps >= starts) & (stored >= min(starts, self.config.replay_size))

    def learn(
        self, state: TrainState, sample_key: PRNGKeyArray, update_key: PRNGKeyArray
    ) -> TrainState:
        """The updates that the steps so far have earned; their batches are drawn at once."""
        earned, cost = self.updates_ratio.as_integer_ratio()
        learning = self._has_enough(state)
        credit = state.update_credit + learning * self.config.environments * earned
        updates = credit // cost

        size = self.config.batch_size // self.config.shards
        batches = replay.sample(state.replay, sample_key, self.most_updates * size)
        batches = self.agent.prepare(state.agent, batches)
        batches = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), batches)

        def update(i, carry):
            agent, totals, diverged = carry
            batch = jax.tree.map(lambda x: x[i], batches)
            agent, metrics = self.agent.learn(agent, batch, jax.random.fold_in(update_key, i))
            return agent, _added(totals, metrics), diverged | ~_finite(metrics)

        agent, metrics, diverged = jax.lax.fori_loop(
            0, updates, update, (state.agent, state.totals.update_metrics, jnp.zeros((), bool))
        )
        state = state.replace(agent=agent, update_credit=credit - updates * cost)
        return _learnt(state, updates, metrics, diverged)


@dataclasses.dataclass(frozen=True)
class RolloutTurn:
    """n steps of every environment, one update on them, and they are forgotten.

    All N environments act by the parameters that the last update made.
    """

    config: Any  # a RolloutConfig
    agent: Agent
    step: Step

    @property
    def steps(self) -> int:
        return self.config.rollout_steps * self.config.environments

    @property
    def updates_ratio(self) -> fractions.Fraction:
        return fractions.Fraction(1, self.steps)

    def begin(self, state: TrainState) -> TrainState:
        """The first observations are seen: the first update normalises by them."""
        return state.replace(agent=self.agent.see(state.agent, jnp.asarray(state.env.obs)))

    def __call__(self, state: TrainState) -> TrainState:
        key, *keys = jax.random.split(state.key, 3)
        collect_key, update_key = map(shards.own, keys)
        state, rollout = self.collect(state.replace(key=key), collect_key)
        return self.learn(state, rollout, update_key)

    def bytes(self, state: TrainState) -> int:
        """Of the observations of its steps, before and after each."""
        return 2 * self.config.rollout_steps * tree_bytes(state.env.obs)

    def collect(self, state: TrainState, key: PRNGKeyArray) -> tuple[TrainState, Rollout]:
        """n steps of every environment."""

        def step(state: TrainState, key: PRNGKeyArray):
            state, transition, ended = self.step(state, key)
            return state, Rollout(transition, ended)

        return jax.lax.scan(step, state, jax.random.split(key, self.config.rollout_steps))

    def learn(self, state: TrainState, rollout: Rollout, key: PRNGKeyArray) -> TrainState:
        """One update; the statistics of observations move after it, so that it is on-policy."""
        prepared = rollout._replace(steps=self.agent.prepare(state.agent, rollout.steps))
        agent, metrics = self.agent.learn(state.agent, prepared, key)
        observation = rollout.steps.observation
        upcoming = jnp.concatenate([observation[1:], jnp.asarray(state.env.obs)[None]])
        agent = self.agent.see(agent, upcoming.reshape(-1, upcoming.shape[-1]))
        metrics_sum = _added(state.totals.update_metrics, metrics)
        return _learnt(state.replace(agent=agent), 1, metrics_sum, ~_finite(metrics))


TURNS: Mapping[Experience, Callable[[Any, Agent, Step], Turn]] = {
    "replay": ReplayTurn,
    "rollouts": RolloutTurn,
}


def _added(total: Any, metrics: Any) -> Any:
    return jax.tree.map(jnp.add, total, metrics)


def _finite(metrics: Any) -> Bool[Array, ""]:
    """Whether all metrics are: their sum is not where one of them is not."""
    return jnp.isfinite(sum(metrics))


def _learnt(state: TrainState, updates: Any, metrics: Any, diverged: Bool[Array, ""]) -> TrainState:
    """`state` with some updates counted, and the step of the first that was not finite."""
    first = diverged & (state.diverged_at < 0)
    return state.replace(
        diverged_at=jnp.where(first, state.env_steps, state.diverged_at),
        totals=state.totals._replace(
            updates=state.totals.updates + updates, update_metrics=metrics
        ),
    )
