"""Our environments as Gymnasium has them: one, or many that one jitted call steps."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs import registry
from envs.base import Env, State, with_episodes

LARGEST_SEED = 2**31
PICTURE = 480
"""Pixels, of a side."""


class SingleEnv(gymnasium.Env):
    """One instance, without a time limit: `gymnasium.make` adds it.

    Args:
      name: of `envs.make`.
      render_mode: None, or rgb_array: `render` gives a picture of the state.
      **options: `engine`, and the options of the task.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, name: str, render_mode: str | None = None, **options: Any):
        self._env = registry.make(name, **options)
        modes = [] if type(self._env).painter is Env.painter else ["rgb_array"]
        self.metadata = {**self.metadata, "render_modes": modes}
        if (dt := getattr(self._env, "dt", None)) is not None:
            self.metadata["render_fps"] = round(1 / dt)
        self.render_mode, self._paint = render_mode, None
        if render_mode is not None:
            if render_mode not in modes:
                known = ", ".join(modes) or "none"
                raise ValueError(f"{name} has no render_mode {render_mode!r}; it has {known}")
            self._paint = self._env.painter(PICTURE, PICTURE)
        self.observation_space, self.action_space = spaces(self._env)
        self._reset, self._step = jax.jit(self._env.reset), jax.jit(self._env.step)
        self._state: Any = None  # before the first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self._state = self._reset(_next_key(self.np_random))
        return _observation(self._state), {}

    def step(self, action: np.ndarray):
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        self._state = self._step(self._state, _inside(action, self._env))
        reward, done, metrics = jax.device_get(
            (self._state.reward, self._state.done, self._state.metrics)
        )
        info = {name: float(value) for name, value in metrics.items()}
        return _observation(self._state), float(reward), bool(done), False, info

    def render(self):
        """A picture of the state, [H, W, 3] uint8, by `render_mode="rgb_array"`; else None."""
        if self._paint is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first picture")
        return self._paint(jax.device_get(self._state.pipeline_state))


class VectorEnv(gymnasium.vector.VectorEnv):
    """N instances in one jitted step, each reset in the step that ends its episode.

    Args:
      name: of `envs.make`.
      num_envs: N.
      max_episode_steps: the time limit of an episode.
      render_mode: None; nothing is drawn step by step.
      **options: `engine`, and the options of the task.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        name: str,
        num_envs: int,
        max_episode_steps: int,
        render_mode: str | None = None,
        **options: Any,
    ):
        if render_mode is not None:
            raise ValueError(
                f"the vector environment of {name} has no render_mode {render_mode!r}; one by "
                "gymnasium.make draws itself, as rgb_array"
            )
        self.num_envs = num_envs
        env = registry.make(name, **options)
        self._env = with_episodes(env, max_episode_steps)
        self.single_observation_space, self.single_action_space = spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset = jax.jit(jax.vmap(self._env.reset))
        self._step = jax.jit(jax.vmap(self._env.step), donate_argnums=0)
        self._state: Any = None  # before the first reset

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ):
        """Begins N episodes.

        Args:
          seed: of all starts, or a list of one for each instance.
          options: none are known.
        """
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(f"{self.num_envs} instances take as many seeds, got {len(seed)}")
            keys = jnp.stack([_next_key(np_random(one)[0]) for one in seed])
        else:
            super().reset(seed=seed)
            keys = jax.random.split(_next_key(self.np_random), self.num_envs)
        self._state = self._reset(keys)
        return _observation(self._state), {}

    def step(self, actions: np.ndarray):
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        self._state = state = self._step(self._state, _inside(actions, self._env))
        info = state.info
        observation, reward, terminated, truncated, last, metrics = map(
            np.array,
            jax.device_get(
                (state.obs, state.reward, info["terminated"], info["truncated"],
                 info["final_observation"], list(state.metrics.values()))
            ),
        )  # fmt: skip
        infos: dict[str, Any] = {}
        if (ended := terminated | truncated).any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final[i] = last[i]
            infos |= {"final_obs": final, "_final_obs": ended}
            named = dict(zip(state.metrics, metrics, strict=True))
            infos |= {"final_info": named, "_final_info": ended}
        return observation, reward.astype(np.float64), terminated, truncated, infos


def spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of observations and actions, both in Gymnasium's units."""
    shape = (env.observation_size,)
    low, high = (np.broadcast_to(np.float32(x), shape) for x in env.observation_bounds)
    observation = gymnasium.spaces.Box(low, high, dtype=np.float32)
    most = np.asarray(env.action_high, np.float32)
    return observation, gymnasium.spaces.Box(-most, most, dtype=np.float32)


def _inside(action: Any, env: Env) -> np.ndarray:
    """In the units of the inside, [-1, 1]."""
    return np.asarray(action, np.float32) / np.asarray(env.action_high, np.float32)


def _observation(state: State) -> np.ndarray:
    return np.array(jnp.asarray(state.obs), np.float32)


def _next_key(random: np.random.Generator) -> jax.Array:
    return jax.random.key(int(random.integers(LARGEST_SEED)))
