"""Brax's own environments under our contract."""

import contextlib
import inspect
from collections.abc import Callable
from typing import Any, Literal

import jax
import mujoco
import numpy as np

with contextlib.redirect_stdout(None):  # importing brax.envs prints what its backends lack
    from brax import envs as brax_envs

from envs.base import Action, State, Wrapper
from envs.frames import Painter, mujoco_painter

TIME_LIMIT = 1000
"""Steps of an episode in Brax's own training runs."""
Backend = Literal["generalized", "spring", "positional", "mjx"]


def names() -> tuple[str, ...]:
    """The environments in Brax's registry."""
    return tuple(sorted(brax_envs._envs))


def constructor(name: str) -> Callable[..., brax_envs.Env]:
    """Makes Brax's environment `name`; its parameters are those of the class.

    Raises:
      ValueError: if Brax has no such environment.
    """
    if name not in names():
        raise ValueError(f"Brax has no environment {name!r}; it has {', '.join(names())}")
    cls = brax_envs._envs[name]

    def construct(**options: Any) -> brax_envs.Env:
        return cls(**options)

    # Brax leaves `backend` open, and finds a wrong one only after it has loaded the model.
    signature = inspect.signature(cls)
    parameters = [
        p.replace(annotation=Backend) if p.name == "backend" else p
        for p in signature.parameters.values()
    ]
    construct.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return construct


def is_brax(made: Any) -> bool:
    """Whether it is an environment of Brax's kind."""
    return isinstance(made, brax_envs.Env)


class BraxEnv(Wrapper):
    """A Brax environment whose actions are float32 in [-1, 1]^A, clipped there first."""

    def __init__(self, env: brax_envs.Env):
        super().__init__(env)
        # Brax finds its observation size by a reset, op by op; the shapes alone are free.
        shapes = jax.eval_shape(env.reset, jax.random.key(0))
        self._observation_size = shapes.obs.shape[-1]

    @property
    def observation_size(self) -> int:
        return self._observation_size

    @property
    def backend(self) -> str:
        return getattr(self.env, "_backend", "jax")  # its smallest ones have none

    @property
    def action_high(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        return np.ones(self.action_size, np.float32)

    def reset(self, rng: jax.Array) -> State:
        return _ours(self.env.reset(rng))

    def step(self, state: State, action: Action) -> State:
        # Brax writes its metrics into the caller's dictionary; a copy keeps `step` pure.
        theirs = brax_envs.State(
            state.pipeline_state,
            state.obs,
            state.reward,
            state.done,
            dict(state.metrics),
            dict(state.info),
        )
        return _ours(self.env.step(theirs, self.clipped(action)))

    def painter(self, width: int, height: int) -> Painter:
        """By MuJoCo's renderer, of the model that Brax made its own of."""
        if not hasattr(self.env, "sys"):  # its smallest ones have none
            raise ValueError(f"Brax's {type(self.env).__name__} has no bodies, thus no pictures")
        model = self.env.sys.mj_model

        def data_of(theirs: Any) -> mujoco.MjData:
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = theirs.q, theirs.qd
            mujoco.mj_forward(model, data)
            return data

        return mujoco_painter(model, data_of, width, height)


def _ours(theirs: brax_envs.State) -> State:
    return State(
        theirs.pipeline_state, theirs.obs, theirs.reward, theirs.done, theirs.metrics, theirs.info
    )
