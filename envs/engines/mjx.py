"""MuJoCo XLA: the same models and the same task lines, in JAX, for accelerators."""

import contextlib
import copy
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

with contextlib.redirect_stdout(None):  # importing mjx prints what it lacks
    from mujoco import mjx

from envs.engines.contact_frames import mujoco_contact_frames
from envs.engines.outcome import Outcome
from envs.mujoco_tasks.task import Array, MujocoTask, Physics


@struct.dataclass
class MjxState:
    """All that one step hands to the next; everything else follows from it."""

    time: Array  # [] s
    qpos: Array  # [nq]
    qvel: Array  # [nv]
    act: Array  # [na]
    qacc_warmstart: Array  # [nv]
    anchor: Array  # [K]


HANDED_ON = ("time", "qpos", "qvel", "act", "qacc_warmstart")
"""Of MjxState, what MuJoCo has too."""


def supported_model(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with what MJX lacks replaced: the PGS solver by Newton."""
    if model.opt.solver != mujoco.mjtSolver.mjSOL_PGS:
        return model
    model = copy.copy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


class MjxEngine:
    """A task on MuJoCo XLA."""

    name = "mjx"

    def __init__(self, task: MujocoTask):
        self.task = task
        self.model = supported_model(task.model)
        self._model = mjx.put_model(self.model, impl="jax")
        self._qpos0 = self.model.qpos0.astype(np.float32)
        self._names = (*HANDED_ON, *task.fields)

    def reset(self, key: jax.Array) -> tuple[MjxState, Outcome]:
        """A start drawn as the task says."""
        qpos_offset, qvel_offset = self.task.start_offset(key)
        return self.reset_to(self._qpos0 + qpos_offset, qvel_offset)

    def reset_to(self, qpos, qvel) -> tuple[MjxState, Outcome]:
        """The start at a given qpos [nq] and qvel [nv]."""
        start = {"qpos": jnp.asarray(qpos, jnp.float32), "qvel": jnp.asarray(qvel, jnp.float32)}
        simulated = self._simulated(start, frames=0)
        physics = self._physics(simulated)
        anchor = self.task.anchor(jnp, physics)
        _, metrics = self.task.reward(jnp, anchor, physics, jnp.zeros(self.model.nu))
        zero = jnp.zeros(())
        outcome = Outcome(
            self.task.observation(jnp, physics), zero, zero, dict.fromkeys(metrics, zero)
        )
        return self._state(simulated, anchor), outcome

    def step(self, state: MjxState, control: jax.Array) -> tuple[MjxState, Outcome]:
        """`task.frame_skip` physics steps under `control` ([A] float32, Gymnasium's units)."""
        start = {name: getattr(state, name) for name in HANDED_ON}
        simulated = self._simulated({**start, "ctrl": control}, self.task.frame_skip)
        physics = self._physics(simulated)
        reward, metrics = self.task.reward(jnp, state.anchor, physics, control)
        outcome = Outcome(
            self.task.observation(jnp, physics),
            reward,
            self.task.terminated(jnp, physics).astype(jnp.float32),
            {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()},
        )
        return self._state(simulated, self.task.anchor(jnp, physics)), outcome

    def mj_data(self, state: MjxState) -> mujoco.MjData:
        """The simulation of one instance, with everything derived from its state computed."""
        data = mujoco.MjData(self.model)
        data.time, data.qpos, data.qvel = state.time, state.qpos, state.qvel
        data.act, data.qacc_warmstart = state.act, state.qacc_warmstart
        mujoco.mj_forward(self.model, data)
        return data

    @mujoco_contact_frames()
    def _simulated(self, start: Mapping[str, jax.Array], frames: int) -> dict[str, jax.Array]:
        """What is read of one instance after so many physics steps, or none, from its start."""
        data = self._after(mjx.make_data(self._model, impl="jax").replace(**start), frames)
        simulated = {name: field(data, name) for name in self._names}
        if "cfrc_ext" in simulated:
            if frames:
                data = mjx.rne_postconstraint(self._model, data)
                simulated["cfrc_ext"] = field(data, "cfrc_ext")
            else:
                simulated["cfrc_ext"] = jnp.zeros((self.model.nbody, 6))
        return simulated

    def _after(self, data: mjx.Data, frames: int) -> mjx.Data:
        """After so many physics steps; after none, with everything derived from its state."""
        if not frames:
            return mjx.forward(self._model, data)
        return jax.lax.fori_loop(0, frames, lambda _, data: mjx.step(self._model, data), data)

    def _physics(self, simulated: Mapping[str, jax.Array]) -> Physics:
        return Physics(**{name: simulated[name] for name in ("qpos", "qvel", *self.task.fields)})

    def _state(self, simulated: Mapping[str, jax.Array], anchor: jax.Array) -> MjxState:
        return MjxState(**{name: simulated[name] for name in HANDED_ON}, anchor=anchor)


def field(data: mjx.Data, name: str) -> Any:
    """A field of MjData, which MJX keeps either in its public or in its own part."""
    public = data if name in data.__dataclass_fields__ else data._impl
    return getattr(public, name)
