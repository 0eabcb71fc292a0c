"""A MuJoCo task on a physics engine."""

import contextlib
import pkgutil

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Action, Env, State
from envs.frames import Painter, Shown, mujoco_painter, mujoco_viewer
from envs.mujoco_tasks.restriction import scaled
from envs.mujoco_tasks.task import MujocoTask

ENGINES = {
    "native": "envs.engines.native:NativeEngine",
    "mjx": "envs.engines.mjx:MjxEngine",
    "mjx-warp": "envs.engines.mjx_warp:MjxWarpEngine",
}
"""Imported when an environment is made by one: MJX takes longer than all else."""


class MujocoEnv(Env):
    """One instance of a task. Actions are float32 in [-1, 1]^A, clipped there first.

    The control is `float32(action * action_high)`, in Gymnasium's units; `done` is termination.
    A restricted task takes an action outside of its balls as 0, and `metrics["valid"]` says so.
    """

    def __init__(self, task: MujocoTask, engine: str):
        self.task = task
        self.action_high, self.scored_metrics = task.action_high, task.scored_metrics
        self._balls = task.balls
        self.engine = pkgutil.resolve_name(ENGINES[engine])(task)
        shapes = jax.eval_shape(self.reset, jax.random.key(0))
        self._observation_size = shapes.obs.shape[-1]

    @property
    def observation_size(self) -> int:
        return self._observation_size

    @property
    def action_size(self) -> int:
        return self.task.model.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    @property
    def dt(self) -> float:
        return self.task.dt

    def reset(self, rng: jax.Array) -> State:
        return self._first(*self.engine.reset(rng))

    def reset_to(self, qpos, qvel) -> State:
        """Start at qpos [nq] and qvel [nv]; natively, float64 NumPy arrays keep every bit."""
        nq, nv = self.task.model.nq, self.task.model.nv
        if np.shape(qpos) != (nq,) or np.shape(qvel) != (nv,):
            raise ValueError(
                f"qpos and qvel must have shapes ({nq},) and ({nv},), "
                f"got {np.shape(qpos)} and {np.shape(qvel)}"
            )
        return self._first(*self.engine.reset_to(qpos, qvel))

    def step(self, state: State, action: Action) -> State:
        action, metrics = self.clipped(action), dict(state.metrics)
        if self._balls:
            valid = self._balls.hold(jnp, scaled(action))
            action = jnp.where(valid, action, 0.0)
            metrics["valid"] = valid.astype(jnp.float32)
        control = action * self.action_high
        pipeline_state, outcome = self.engine.step(state.pipeline_state, control)
        return state.replace(
            pipeline_state=pipeline_state,
            obs=outcome.observation,
            reward=outcome.reward,
            done=outcome.terminated,
            metrics={**metrics, **outcome.metrics},
        )

    def mj_data(self, state: State) -> mujoco.MjData:
        """A `mujoco.MjData` of one instance, for drawing and inspection."""
        return self.engine.mj_data(state.pipeline_state)

    def painter(self, width: int, height: int) -> Painter:
        return mujoco_painter(self.task.model, self.engine.mj_data, width, height)

    def viewer(self) -> contextlib.AbstractContextManager[Shown]:
        return mujoco_viewer(self.task.model, self.engine.mj_data)

    def _first(self, pipeline_state, outcome) -> State:
        own = {"valid": jnp.zeros(())} if self._balls else {}
        return State(
            pipeline_state,
            outcome.observation,
            outcome.reward,
            outcome.terminated,
            {**own, **outcome.metrics},
            {},
        )
