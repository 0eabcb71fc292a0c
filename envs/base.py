"""The environment contract, and episodes: time limits and automatic resets that lose nothing.

An environment has the interface of `brax.envs.base.Env`: one instance, never batched (`jax.vmap`
batches it), with all of its state in the `State` it returns. `done` means that the task itself
ended; time limits and resets belong to `with_episodes`. (Brax's own classes would do, but importing
them takes a second: behind them stand MJX and three physics engines.)
"""

import abc
import contextlib
import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.custom_batching import custom_vmap
from jaxtyping import Float, Float32

from envs.frames import Painter, Shown
from envs.recording import Episode, Player
from envs.scored import ScoredMetric

__all__ = ["Action", "Env", "Episodes", "State", "Wrapper", "where_ended", "with_episodes"]

Action = Float[jax.Array | np.ndarray, "A"]
"""In [-1, 1]^A; clipped there first."""


class State(struct.PyTreeNode):
    """Of one instance after a reset or a step; its fields are those of Brax's."""

    pipeline_state: Any  # of the physics, whatever it is
    obs: Any  # [D] float32
    reward: Any  # []
    done: Any  # [] float32, 1 where the task ended
    metrics: dict[str, Any] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class Env(abc.ABC):
    """One instance, with flat observations and actions in [-1, 1]."""

    action_high: np.ndarray
    """[A] float32, what an action of 1 is in Gymnasium's units."""
    scored_metrics: tuple[ScoredMetric, ...] = ()
    """What belongs to a score, beside the return."""
    observation_bounds: tuple[Any, Any] = (-np.inf, np.inf)
    """Lowest and highest, each a number or [D]."""
    drawn_episodes: int = 1
    """How many episodes a drawing shows."""
    saved: bool = True
    """Whether a state holds all of an episode: else a run that goes on begins its episodes anew."""

    @abc.abstractmethod
    def reset(self, rng: jax.Array) -> State:
        """A fresh start, drawn by a key."""

    @abc.abstractmethod
    def step(self, state: State, action: Action) -> State:
        """What the action makes of the state."""

    def limited(self, time_limit: int) -> "Env":
        """This environment, told how long its episodes can be; most need not know."""
        return self

    @property
    @abc.abstractmethod
    def observation_size(self) -> int:
        """D."""

    @property
    @abc.abstractmethod
    def action_size(self) -> int:
        """A."""

    @property
    @abc.abstractmethod
    def backend(self) -> str:
        """What steps it: native, mjx, jax, gymnasium, or a pipeline of Brax."""

    @property
    def unwrapped(self) -> "Env":
        """The environment inside of all wrappers, as Brax's trainers ask for it."""
        return self

    def render(
        self, episodes: Sequence[Episode], player: Player, folder: pathlib.Path
    ) -> list[pathlib.Path]:
        """Draws episodes into files of `folder`, which it returns; not every environment can.

        Args:
          episodes: `drawn_episodes` of them.
          player: the agent that played them.
          folder: exists already.

        Raises:
          NotImplementedError: if the environment has no drawing.
        """
        raise NotImplementedError(f"{type(self).__name__} has no drawing of its episodes")

    def painter(self, width: int, height: int) -> Painter:
        """Draws physics states as RGB pictures; not every environment can.

        Raises:
          NotImplementedError: if the environment has no pictures.
          ValueError: if there is nothing to draw with.
        """
        raise NotImplementedError(f"{type(self).__name__} has no pictures of its states")

    def viewer(self) -> contextlib.AbstractContextManager[Shown]:
        """A window that shows physics states; MuJoCo's tasks have one.

        Raises:
          NotImplementedError: if the environment has none.
          ValueError: if there is no display.
        """
        raise NotImplementedError(f"{type(self).__name__} has no viewer of its states")

    def clipped(self, action: Action) -> Float32[jax.Array, "A"]:
        """The action as a step takes it.

        Raises:
          ValueError: if its length is not A.
        """
        if np.shape(action) != (self.action_size,):
            raise ValueError(
                f"an action must have shape ({self.action_size},), got {np.shape(action)}"
            )
        return jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)


class Wrapper(Env):
    """An environment round another, which answers for all that it does not change."""

    def __init__(self, env: Any):
        self.env = env

    def reset(self, rng: jax.Array) -> State:
        return self.env.reset(rng)

    def step(self, state: State, action: Action) -> State:
        return self.env.step(state, action)

    @property
    def observation_size(self) -> int:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.backend

    @property
    def unwrapped(self) -> Env:
        return self.env.unwrapped

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # copying and pickling ask before there is an `env`
            raise AttributeError(name)
        return getattr(self.env, name)


RESETS_PER_ROUND = 1 / 16
"""Of a batch: few enough to be cheap, enough that most steps need one round."""


def where_ended(make: Callable[[Any], Any], ended: jax.Array, argument: Any, kept: Any) -> Any:
    """`make(argument)` where `ended`, else `kept`; a batch pays for the ended instances alone.

    Under `vmap`, `lax.cond` would run `make` for every instance at every step. Here the ended
    instances are gathered, made in rounds of a sixteenth of the batch, and scattered back; a step
    in which none ended costs nothing.

    Args:
      make: a pure function of one instance, returning a tree like `kept`.
      ended: [] bool.
      argument: tree of arrays, all that `make` depends on.
      kept: tree of arrays.
    """

    @custom_vmap
    def select(ended, argument, kept):
        return jax.lax.cond(ended, lambda: make(argument), lambda: kept)

    @select.def_vmap
    def _(size, batched, *arguments):
        def broadcast(x, is_batched):
            return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

        arguments = jax.tree.map(broadcast, arguments, tuple(batched))
        if size == 1:  # XLA would take a round that can only be this one out of its loop
            values = select(*jax.tree.map(lambda x: x[0], arguments))
            return jax.tree.map(lambda x: x[None], values), jax.tree.map(lambda _: True, values)
        ended, argument, kept = arguments
        per_round = max(1, round(size * RESETS_PER_ROUND))

        def one_round(carry):
            waiting, values = carry
            (chosen,) = jnp.nonzero(waiting, size=per_round, fill_value=size)
            made = jax.vmap(make)(jax.tree.map(lambda x: x[chosen], argument))
            values = jax.tree.map(lambda x, y: x.at[chosen].set(y, mode="drop"), values, made)
            return waiting.at[chosen].set(False, mode="drop"), values

        _, values = jax.lax.while_loop(lambda carry: carry[0].any(), one_round, (ended, kept))
        return values, jax.tree.map(lambda _: True, values)

    return select(ended, argument, kept)


class Episodes(Wrapper):
    """An environment that ends its episodes at a time limit and starts the next one by itself.

    `info` tells `terminated` (the task ended), `truncated` (the time limit was reached; both may
    hold, as in Gymnasium), `final_observation` (what `step` observed before a reset replaced it),
    `steps` (of the present episode) and `episode` (how many ended before it). `done` is
    either end. Each start is a fresh draw from the instance's own key and the episode's number.

    A step whose observation or reward is not finite is `broken`: it cuts the episode off where it
    began, with its last observation and a reward of 0.
    """

    def __init__(self, env: Env, time_limit: int):
        if time_limit < 1:
            raise ValueError(f"time_limit must be at least 1 step, got {time_limit}")
        env = env.limited(time_limit)
        super().__init__(env)
        self.env: Env = env
        self.saved = env.saved
        self.time_limit = time_limit
        # What `Env` has a default for, the wrapper would otherwise not look up in `env`.
        self.scored_metrics, self.drawn_episodes = env.scored_metrics, env.drawn_episodes

    def render(
        self, episodes: Sequence[Episode], player: Player, folder: pathlib.Path
    ) -> list[pathlib.Path]:
        return self.env.render(episodes, player, folder)

    def reset(self, rng: jax.Array) -> State:
        start_key, key = jax.random.split(rng)
        state = self.env.reset(start_key)
        no, zero = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        info = {
            "terminated": no,
            "truncated": no,
            "broken": no,
            "final_observation": state.obs,
            "steps": zero,
            "episode": zero,
            "key": key,
        }
        return state.replace(info={**state.info, **info})

    def step(self, state: State, action: Action) -> State:
        nstate = self.env.step(state, jnp.asarray(action))
        steps = state.info["steps"] + 1
        observation = jnp.asarray(nstate.obs)
        broken = ~(jnp.isfinite(observation).all() & jnp.isfinite(nstate.reward))
        terminated = (nstate.done > 0.5) & ~broken
        truncated = (steps >= self.time_limit) | broken
        ended = terminated | truncated
        episode = state.info["episode"] + ended

        own_info = {name: nstate.info[name] for name in self._own_info}
        pipeline_state, obs, own_info = where_ended(
            self._start,
            ended,
            (state.info["key"], episode),
            (nstate.pipeline_state, nstate.obs, own_info),
        )
        info = {
            "terminated": terminated,
            "truncated": truncated,
            "broken": broken,
            "final_observation": jnp.where(broken, jnp.asarray(state.obs), observation),
            "steps": jnp.where(ended, 0, steps),
            "episode": episode,
            "key": state.info["key"],
        }
        return nstate.replace(
            pipeline_state=pipeline_state,
            obs=obs,
            reward=jnp.where(broken, 0.0, nstate.reward),
            done=ended.astype(nstate.done.dtype),
            info={**nstate.info, **own_info, **info},
        )

    def _start(self, key_and_episode: tuple[jax.Array, jax.Array]):
        """What the start of an episode replaces of the state that ended the one before."""
        state = self.env.reset(jax.random.fold_in(*key_and_episode))
        return state.pipeline_state, state.obs, {name: state.info[name] for name in self._own_info}

    @functools.cached_property
    def _own_info(self) -> tuple[str, ...]:
        """The entries that the environment itself writes: a reset renews these and no wrapper's."""
        return tuple(jax.eval_shape(self.env.reset, jax.random.key(0)).info)


def with_episodes(env: Env, time_limit: int) -> Episodes:
    """`env` with a time limit in steps and automatic resets; see `Episodes`."""
    return Episodes(env, time_limit)
