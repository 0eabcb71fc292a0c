"""Any Gymnasium environment with flat boxes under our contract: `gym:NAME`.

Its instances live on the host, one an episode, known by the random key that the episode began
with: to begin an episode again that is under way changes nothing, so that what XLA takes for a
function behaves like one. What a state holds of an instance is its key alone, which is why a run
cannot save its episodes.
"""

import threading
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from envs import registry
from envs.base import Action, Env, State
from envs.engines.host_call import host_call
from envs.frames import Painter
from envs.interop.gymnasium_ids import gymnasium_id

TIME_LIMIT = 1000
"""Steps of an episode where Gymnasium's registry names none."""
FLATTEN = (
    "; register the environment with gymnasium's FlattenObservation, or another wrapper, round it"
)
RUN_JAX = ("phys2d/", "tabular/")
"""Beginnings of ids whose environments run JAX, which inside of a call from JAX can hang."""


def time_limit(name: str) -> int:
    """Of an id in Gymnasium's registry.

    Raises:
      ValueError: if there is none, or its environment runs JAX.
    """
    ours = {gymnasium_id(spec): spec.name for spec in registry.loaded()}
    if name in ours:
        raise ValueError(f"gym:{name} is one of ours: choose it by its own name, {ours[name]}")
    if name.startswith(RUN_JAX):
        raise ValueError(f"gym:{name} runs JAX, which cannot be called from a jitted program")
    try:
        return gymnasium.spec(name).max_episode_steps or TIME_LIMIT
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise ValueError(f"Gymnasium has no environment {name!r}: {error}") from None


def constructor(name: str) -> Callable[..., "HostedEnv"]:
    """Makes the environment of an id; its options are Gymnasium's."""
    limit = time_limit(name)

    def construct(**options: Any) -> HostedEnv:
        return HostedEnv(name, limit, options)

    return construct


class HostedEnv(Env):
    """An environment of Gymnasium.

    `done` is termination. An episode that it truncates before the time limit is broken: its last
    reward is NaN, so that it is cut off and counted.
    """

    saved = False

    def __init__(self, name: str, limit: int, options: dict[str, Any]):
        """Makes one to see what it is.

        Raises:
          ValueError: if it cannot be made, or its spaces are no flat boxes.
        """
        self._name, self._limit, self._options = name, limit, options
        self._host = _Host(lambda: _made(name, limit, options))
        one = self._host.spare()
        high = _most(name, one.action_space)
        self.action_high = high
        self.observation_bounds = _box(name, "observations", one.observation_space, FLATTEN)
        self._observation = jax.ShapeDtypeStruct(self.observation_bounds[0].shape, jnp.float32)

    def limited(self, time_limit: int) -> Env:
        return HostedEnv(self._name, time_limit, self._options)

    @property
    def observation_size(self) -> int:
        return self._observation.shape[0]

    @property
    def action_size(self) -> int:
        return len(self.action_high)

    @property
    def backend(self) -> str:
        return "gymnasium"

    def reset(self, rng: jax.Array) -> State:
        key: Any = jax.random.key_data(rng).astype(jnp.uint32)
        (observation,) = host_call(self._host.start, (self._observation,), key)
        zero = jnp.zeros(())
        return State(key, observation, zero, zero, {}, {})

    def step(self, state: State, action: Action) -> State:
        control = self.clipped(action) * self.action_high
        number = jax.ShapeDtypeStruct((), jnp.float32)
        result = (self._observation, number, number)
        key: Any = state.pipeline_state
        observation, reward, done = host_call(self._host.step, result, key, control)
        return state.replace(obs=observation, reward=reward, done=done)

    def painter(self, width: int, height: int) -> Painter:
        """There is none: a state tells which episode it belongs to, and not how far it has come."""
        raise ValueError(
            f"gym:{self._name} has no pictures: Gymnasium keeps its states, and draws them as it "
            "steps; let mapg_jax.load_policy(RUN) act in "
            f"gymnasium.make({self._name!r}, render_mode='rgb_array')"
        )


class _Host:
    """The instances: those of episodes under way, by their keys, and those that are free."""

    def __init__(self, make: Callable[[], gymnasium.Env]):
        self._make = make
        self._live: dict[bytes, tuple[gymnasium.Env, np.ndarray]] = {}
        self._free: list[gymnasium.Env] = []
        self._lock = threading.Lock()

    def spare(self) -> gymnasium.Env:
        """One that is free, and stays so."""
        if not self._free:
            self._free.append(self._make())
        return self._free[-1]

    def start(self, keys: np.ndarray) -> tuple[np.ndarray]:
        """First observations [..., D] of the episodes of some keys [..., 2]."""
        with self._lock:
            first = [self._begun(key) for key in keys.reshape(-1, keys.shape[-1])]
        return (np.stack(first).reshape(*keys.shape[:-1], -1),)

    def _begun(self, key: np.ndarray) -> np.ndarray:
        name = key.tobytes()
        if name not in self._live:
            env = self._free.pop() if self._free else self._make()
            observation, _ = env.reset(seed=int(key[-1]) & 0x7FFFFFFF)
            self._live[name] = env, np.asarray(observation, np.float32)
        return self._live[name][1]

    def step(self, keys: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Observations [..., D], rewards [...] and terminations [...]."""
        batch = keys.shape[:-1]
        pairs = zip(
            keys.reshape(-1, keys.shape[-1]), actions.reshape(-1, actions.shape[-1]), strict=True
        )
        with self._lock:
            observations, rewards, dones = zip(*(self._stepped(*x) for x in pairs), strict=True)
        numbers = (np.array(x, np.float32).reshape(batch) for x in (rewards, dones))
        return np.stack(observations).reshape(*batch, -1), *numbers

    def _stepped(self, key: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float, float]:
        name = key.tobytes()
        if name not in self._live:  # it has ended, and waits for others in an evaluation
            return np.zeros(self.spare().observation_space.shape or (), np.float32), 0.0, 1.0
        env, _ = self._live[name]
        observation, reward, terminated, truncated, info = env.step(action)
        early = truncated and not info.get("TimeLimit.truncated", _at_limit(env))
        if terminated or truncated:
            self._free.append(self._live.pop(name)[0])
        reward = float("nan") if early and not terminated else float(reward)
        return np.asarray(observation, np.float32), reward, float(terminated)


def _at_limit(env: gymnasium.Env) -> bool:
    """Whether the time limit, the outermost wrapper, has been reached."""
    limit: Any = env
    return limit._elapsed_steps >= limit._max_episode_steps


def _made(name: str, limit: int, options: dict[str, Any]) -> gymnasium.Env:
    try:
        env = gymnasium.make(name, max_episode_steps=-1, disable_env_checker=True, **options)
    except Exception as error:  # whatever a stranger's constructor does
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        raise ValueError(f"gym:{name} cannot be made: {reason}") from None
    return gymnasium.wrappers.TimeLimit(env, limit)


def _box(
    name: str, what: str, space: gymnasium.Space, remedy: str = ""
) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of a flat box."""
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"gym:{name} has {what} in {space}, and only flat boxes of numbers are taken{remedy}"
        )
    return space.low.astype(np.float32), space.high.astype(np.float32)


def _most(name: str, space: gymnasium.Space) -> np.ndarray:
    """What an action of 1 is."""
    low, high = _box(name, "actions", space)
    if not (np.isfinite(high).all() and np.array_equal(low, -high)):
        raise ValueError(
            f"gym:{name} has actions between {low.tolist()} and {high.tolist()}, and bounds must "
            "be finite and alike on both sides of 0; gymnasium's RescaleAction makes them so"
        )
    return high
