"""What the trainers share: turns, the jitted programs made of them, and what is summed."""

import abc
import dataclasses
import fractions
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

import envs
from envs.base import Episodes
from mapg_jax.training.agent import Agent
from mapg_jax.training.config import Config


class Totals(NamedTuple):
    """Sums since the last evaluation, over updates and over finished training episodes."""

    updates: jax.Array  # [] f32
    update_metrics: Any  # the UpdateMetrics of the algorithm
    episodes: jax.Array  # [] f32
    episode_return: jax.Array  # []
    episode_length: jax.Array  # [] steps


class RunKeys(NamedTuple):
    """A run's independent random streams."""

    agent: PRNGKeyArray
    env: PRNGKeyArray
    loop: PRNGKeyArray
    evaluation: PRNGKeyArray


def run_keys(seed: int | Int[Array, ""]) -> RunKeys:
    """The streams of a seed."""
    return RunKeys(*jax.random.split(jax.random.key(seed), 4))


@dataclasses.dataclass(frozen=True)
class Loop(abc.ABC):
    """The static part of a run.

    A turn is the least that the host can ask for: some steps of every environment, and the updates
    that come with them.
    """

    config: Config
    env: Episodes
    agent: Agent

    @property
    @abc.abstractmethod
    def steps_per_turn(self) -> int:
        """Environment steps of a turn, all environments together."""

    @property
    @abc.abstractmethod
    def updates_ratio(self) -> fractions.Fraction:
        """Updates per environment step."""

    @abc.abstractmethod
    def init(self, seed: int | Int[Array, ""]) -> Any:
        """The state before the first step."""

    @abc.abstractmethod
    def turn(self, state: Any) -> Any:
        """The state after one more turn."""

    def run(self, state: Any, turns: Int[Array, ""]) -> Any:
        """Any number of turns; where the host cuts them changes nothing."""
        return jax.lax.fori_loop(0, turns, lambda _, state: self.turn(state), state)

    @functools.cached_property
    def jitted_init(self):
        return jax.jit(self.init)

    @functools.cached_property
    def jitted_run(self):
        return jax.jit(self.run, donate_argnums=0)

    @functools.cached_property
    def shapes(self) -> Any:
        """Shapes of the state, found without allocating it."""
        return jax.eval_shape(self.init, 0)


def count_step(state: Any, env: envs.State) -> Any:
    """`state` after a step of its N environments, the episodes that ended counted."""
    ended = env.done > 0.5
    running_return = state.running_return + env.reward
    steps_ended = jnp.where(ended, state.env.info["steps"] + 1, 0)
    totals = state.totals._replace(
        episodes=state.totals.episodes + ended.sum(),
        episode_return=state.totals.episode_return + (ended * running_return).sum(),
        episode_length=state.totals.episode_length + steps_ended.sum(),
    )
    return state.replace(
        env=env,
        running_return=jnp.where(ended, 0.0, running_return),
        env_steps=state.env_steps + len(ended),
        totals=totals,
    )


def no_totals(update_metrics: Any) -> Totals:
    """Nothing summed yet, of the algorithm with these UpdateMetrics."""
    zero = jnp.zeros(())
    return Totals(zero, update_metrics(*(zero,) * len(update_metrics._fields)), zero, zero, zero)


def state_bytes(trainer: Loop) -> int:
    """Memory the training state will take, before any of it is allocated."""
    leaves = jax.tree.leaves(trainer.shapes)
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in leaves)
