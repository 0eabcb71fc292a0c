"""The loop of a run: steps of the environments and the updates that come with them, jitted."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

import envs
from envs.base import Episodes
from mapg_jax.algorithms import shards
from mapg_jax.algorithms.base import Transition
from mapg_jax.training import replay
from mapg_jax.training.agent import Agent, AgentState, hyperparameters, make_agent
from mapg_jax.training.config import Config
from mapg_jax.training.layout import Layout, most_devices
from mapg_jax.training.state import Totals, TrainState
from mapg_jax.training.turns import TURNS, Turn


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
class Trainer:
    """The static part of a run.

    A turn is the least that the host can ask for: some steps of every environment, and the updates
    that come with them. What it is made of depends on what the algorithm learns from (`turns`).
    """

    config: Config
    env: Episodes
    agent: Agent
    layout: Layout = Layout()

    @functools.cached_property
    def turn(self) -> Turn:
        """(state) → the state after one more turn."""
        return TURNS[self.agent.algorithm.experience](self.config, self.agent, self.step)

    @property
    def steps_per_turn(self) -> int:
        """Environment steps of a turn, all environments together."""
        return self.turn.steps

    @property
    def on_one_device(self) -> bool:
        """Whether it can be on one device alone."""
        return _on_one_device(self.env)

    def init(self, seed: int | Int[Array, ""]) -> TrainState:
        """The state before the first step; of several shards, parts of it have an axis [S, ...]."""
        n = self.config.environments
        keys = run_keys(seed)
        agent = self.agent.init(keys.agent, hyperparameters(self.config), self.env.observation_size)
        env = jax.vmap(self.env.reset)(jax.random.split(keys.env, n))
        zero = jnp.zeros(())
        metrics = self.agent.algorithm.Metrics
        state = TrainState(
            agent=agent,
            explorer=self._by_shard(self.agent.algorithm.explorer(n)),
            replay=None,
            update_credit=None,
            env=self._by_shard(env),
            running_return=self._by_shard(jnp.zeros(n)),
            key=keys.loop,
            env_steps=jnp.zeros((), jnp.int32),
            diverged_at=jnp.full((), -1, jnp.int32),
            totals=Totals(zero, metrics(*(zero,) * len(metrics._fields)), zero, zero, zero, zero),
        )
        return self.layout.over_shards(self.turn.begin)(state)

    def restarted(self, state: TrainState) -> TrainState:
        """`state` at the beginning of new episodes: where theirs could not be saved."""
        n = self.config.environments
        keys = jax.random.split(jax.random.fold_in(state.key, 0), n)
        fresh = jax.vmap(self.env.reset)(keys), self.agent.algorithm.explorer(n)
        env, explorer = jax.tree.map(jnp.copy, fresh)  # each buffer is donated, once
        if state.replay is not None:
            of_shard = n // self.layout.shards
            state = state.replace(replay=replay.cut_off(state.replay, of_shard))
        return state.replace(
            env=self._by_shard(env),
            explorer=self._by_shard(explorer),
            running_return=jnp.zeros_like(state.running_return),
        )

    def _by_shard(self, tree: Any) -> Any:
        """Leaves [N, ...] as [S, N / S, ...]; of one shard as they are."""
        s = self.layout.shards
        part = self.config.environments // s
        return tree if s == 1 else jax.tree.map(lambda x: x.reshape(s, part, *x.shape[1:]), tree)

    def step(
        self, state: TrainState, key: PRNGKeyArray
    ) -> tuple[TrainState, Transition, Bool[Array, "N"]]:
        """One step of every environment, and which episodes it ended."""
        observation = jnp.asarray(state.env.obs)
        explored = self.agent.explore(state.agent, state.explorer, observation, key)
        env = jax.vmap(self.env.step)(state.env, explored.action)
        ended = env.done > 0.5
        terminal = ended if self.config.truncation == "terminal" else env.info["terminated"]
        transition = Transition(
            observation=observation,
            extra=explored.extra,
            action=explored.action,
            reward=env.reward,
            terminal=terminal,
            next_observation=env.info["final_observation"],
        )
        fresh = self.agent.algorithm.explorer(len(ended))
        state = state.replace(explorer=_where(ended, fresh, explored.explorer))
        return _counted(state, env, self.config.environments), transition, ended

    def run(self, state: TrainState, turns: Int[Array, ""]) -> TrainState:
        """Any number of turns; where the host cuts them changes nothing."""

        def of_shard(state: TrainState, turns: Int[Array, ""]) -> TrainState:
            return jax.lax.fori_loop(0, turns, lambda _, state: self.turn(state), state)

        return self.layout.over_shards(of_shard)(state, turns)

    def refuse_unshared(self) -> None:
        """Traces a turn, which costs seconds less than to compile it.

        Raises:
          ValueError: if what all shards share would not come out equal in all of them.
        """
        if self.layout.shards == 1:
            return
        try:
            self.jitted_run.eval_shape(self.shapes, 0)
        except ValueError as error:
            raise ValueError(
                f"{self.config.algorithm} does not learn in {self.layout.shards} shards; choose "
                "--shards 1, or average by shards.mean what moves the learner, as "
                f"docs/extending.md does ({str(error).splitlines()[0]})"
            ) from error

    @functools.cached_property
    def jitted_init(self):
        return jax.jit(self.init)

    @functools.cached_property
    def jitted_run(self):
        # Said, since what has no numbers in it would come back elsewhere than it went in.
        out = self.layout.shardings(self.shapes) if self.layout.devices > 1 else None
        return jax.jit(self.run, donate_argnums=0, out_shardings=out)

    @functools.cached_property
    def shapes(self) -> TrainState:
        """Shapes of the state, found without allocating it."""
        return jax.eval_shape(self.init, 0)

    @property
    def bytes(self) -> int:
        """Memory of each device that the state will take, before any of it is allocated."""
        return self.layout.bytes(self.shapes)

    @property
    def turn_bytes(self) -> int:
        """Memory of each device that a turn takes beside the state, at least."""
        return self.turn.bytes(self.shapes) // self.layout.devices


def make_trainer(config: Config, devices: int | None = 1) -> Trainer:
    """The environment, the agent and the loop of a run.

    Args:
      config: of the run.
      devices: D, for its shards; None takes as many as there are that serve.

    Raises:
      ValueError: if the environment cannot be made, or the shards cannot be on so many devices.
    """
    env = envs.with_episodes(config.make_env(), config.episode_steps())
    on_one = _on_one_device(env)
    if devices is None:
        devices = 1 if on_one else most_devices(config.shards)
    if on_one and devices > 1:
        other = ", or --engine mjx" if "mjx" in envs.spec(config.env).engines else ""
        raise ValueError(
            f"{config.env} is stepped on the host ({env.backend}) and runs on one device; choose "
            f"--devices 1{other}"
        )
    agent = make_agent(config, env.action_size)
    return Trainer(config, env, agent, Layout(config.shards, devices))


def agent_shapes(config: Config, agent: Agent, observation_size: int) -> AgentState:
    """Shapes of an agent's state, for reading it from a checkpoint."""

    def init():
        return agent.init(jax.random.key(0), hyperparameters(config), observation_size)

    return jax.eval_shape(init)


def _on_one_device(env: Episodes) -> bool:
    """Whether it is stepped by calls of the host, which are in no order among devices."""
    return env.backend in ("native", "gymnasium")


def _where(ended: Bool[Array, "N"], fresh: Any, kept: Any) -> Any:
    """Leaves [N, ...] of `fresh` where an episode ended, else those of `kept`."""

    def choose(new, old):
        return jnp.where(ended.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, kept)


def _counted(state: TrainState, env: envs.State, environments: int) -> TrainState:
    """`state` after a step of all environments, the episodes that ended counted."""
    ended = env.done > 0.5
    running_return = state.running_return + env.reward
    steps_ended = jnp.where(ended, state.env.info["steps"] + 1, 0)
    counts = (ended, ended * running_return, steps_ended, env.info["broken"])
    episodes, returns, lengths, broken = shards.total(tuple(x.sum() for x in counts))
    totals = state.totals._replace(
        episodes=state.totals.episodes + episodes,
        episode_return=state.totals.episode_return + returns,
        episode_length=state.totals.episode_length + lengths,
        broken=state.totals.broken + broken,
    )
    return state.replace(
        env=env,
        running_return=jnp.where(ended, 0.0, running_return),
        env_steps=state.env_steps + environments,
        totals=totals,
    )
