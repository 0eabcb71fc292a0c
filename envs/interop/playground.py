"""MuJoCo Playground's environments under our contract: `playground:NAME`."""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import mujoco
import numpy as np

from envs.base import Action, Env, State
from envs.frames import Painter, Shown, mujoco_painter, mujoco_viewer

POLICY = "state"
"""Of observations with several parts, the one that Playground's policies see."""


def time_limit(name: str) -> int:
    """Steps of an episode, each of which repeats its action as the configuration says.

    Raises:
      ValueError: if Playground has no such environment, or is not installed.
    """
    settings = _settings(name)
    return int(settings.episode_length) // int(settings.action_repeat)


def constructor(name: str) -> Callable[..., "PlaygroundEnv"]:
    """Makes Playground's environment `name`; its options are the entries of its configuration.

    The physics are MJX's in JAX (`impl=jax`), unless an option says otherwise.

    Raises:
      ValueError: if Playground has no such environment, or is not installed.
    """
    _settings(name)  # refuses what there is not

    def construct(**options: Any) -> PlaygroundEnv:
        settings = _settings(name)
        ours = {"impl": "jax"} if "impl" in settings else {}
        _change(name, settings, {**ours, **options})
        return PlaygroundEnv(name, settings)

    return construct


class PlaygroundEnv(Env):
    """An environment of Playground whose actions are float32 in [-1, 1]^A, clipped there first.

    `done` is theirs; rewards add up over the repeats of an action, as in their training. The
    physics state holds their simulation and their whole observation.
    """

    def __init__(self, name: str, settings: Any):
        """One of that configuration.

        Raises:
          ValueError: if it cannot be made, repeats no action, or observes no row of numbers.
        """
        self._repeats = int(settings.action_repeat)
        if self._repeats < 1:
            raise ValueError(f"playground:{name}: action_repeat must be at least 1")
        self._env = _made(name, settings)
        self.action_high = np.ones(self.action_size, np.float32)
        seen = _seen(jax.eval_shape(self._env.reset, jax.random.key(0)).obs)
        if seen is None or len(seen.shape) != 1:
            raise ValueError(
                f"playground:{name} observes no row of numbers, and only those are taken"
            )
        self._observation_size = seen.shape[0]

    @property
    def observation_size(self) -> int:
        return self._observation_size

    @property
    def action_size(self) -> int:
        return self._env.action_size

    @property
    def backend(self) -> str:
        return "mjx"

    @property
    def dt(self) -> float:
        return self._env.dt * self._repeats

    def reset(self, rng: jax.Array) -> State:
        theirs = self._env.reset(rng)
        simulated: Any = theirs.data, theirs.obs
        return State(
            simulated,
            _seen(theirs.obs),
            theirs.reward,
            theirs.done,
            theirs.metrics,
            theirs.info,
        )

    def step(self, state: State, action: Action) -> State:
        from mujoco_playground import State as Theirs  # pyright: ignore[reportMissingImports]

        simulated: Any = state.pipeline_state
        data, observation = simulated
        # They write into the caller's dictionaries; copies keep `step` pure.
        before = Theirs(
            data, observation, state.reward, state.done, dict(state.metrics), dict(state.info)
        )
        clipped = self.clipped(action)

        def step(theirs: Any, _: None) -> Any:
            following = self._env.step(theirs, clipped)
            return following, following.reward

        after, rewards = jax.lax.scan(step, before, length=self._repeats)
        return state.replace(
            pipeline_state=(after.data, after.obs),
            obs=_seen(after.obs),
            reward=rewards.sum(),
            done=after.done,
            metrics=after.metrics,
            info=after.info,
        )

    def mj_data(self, simulated: Any) -> mujoco.MjData:
        """A `mujoco.MjData` of a physics state, for drawing."""
        model = self._env.mj_model
        data = mujoco.MjData(model)
        for name in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
            getattr(data, name)[:] = getattr(simulated[0], name)
        mujoco.mj_forward(model, data)
        return data

    def painter(self, width: int, height: int) -> Painter:
        return mujoco_painter(self._env.mj_model, self.mj_data, width, height)

    def viewer(self) -> contextlib.AbstractContextManager[Shown]:
        return mujoco_viewer(self._env.mj_model, self.mj_data)


def _seen(observation: Any) -> Any:
    """What the policy sees; None where there is no such part."""
    return observation.get(POLICY) if isinstance(observation, Mapping) else observation


def _registry() -> Any:
    try:
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("playground:NAME needs: pip install 'mapg-jax[playground]'") from None
    return registry


def _settings(name: str) -> Any:
    """The configuration of an environment."""
    registry = _registry()
    if name not in registry.ALL_ENVS:
        known = ", ".join(registry.ALL_ENVS)
        raise ValueError(f"Playground has no environment {name!r}; it has {known}")
    return registry.get_default_config(name)


def _change(name: str, settings: Any, options: Mapping[str, Any]) -> None:
    """Puts options into a configuration; those of a part of it are written PART.ENTRY."""
    for option, value in options.items():
        try:
            if option not in (place := settings):
                for part in option.split("."):
                    place = place[part]
            settings.update_from_flattened_dict({option: value})
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            wrong = "is unknown" if isinstance(error, AttributeError | KeyError) else str(error)
            raise ValueError(
                f"playground:{name}: the option {option}={value!r} {wrong.splitlines()[0]}; it has "
                f"{', '.join(sorted(settings))}"
            ) from None


def _made(name: str, settings: Any) -> Any:
    try:
        return _registry().load(name, config=settings)
    except Exception as error:  # whatever a stranger's constructor does
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        raise ValueError(f"playground:{name} cannot be made: {reason}") from None
