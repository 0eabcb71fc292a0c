"""MuJoCo XLA: the same models and the same task lines, in JAX, for accelerators."""

import contextlib
import copy
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
        self._model = mjx.put_model(self.model)
        self._qpos0 = self.model.qpos0.astype(np.float32)

    def reset(self, key: jax.Array) -> tuple[MjxState, Outcome]:
        """A start drawn as the task says."""
        qpos_offset, qvel_offset = self.task.start_offset(key)
        return self.reset_to(self._qpos0 + qpos_offset, qvel_offset)

    @mujoco_contact_frames()
    def reset_to(self, qpos, qvel) -> tuple[MjxState, Outcome]:
        """The start at a given qpos [nq] and qvel [nv]."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        data = mjx.make_data(self._model).replace(qpos=qpos, qvel=qvel)
        data = mjx.forward(self._model, data)
        physics = self._physics(data, contact_forces=False)
        anchor = self.task.anchor(jnp, physics)
        _, metrics = self.task.reward(jnp, anchor, physics, jnp.zeros(self.model.nu))
        zero = jnp.zeros(())
        outcome = Outcome(
            self.task.observation(jnp, physics), zero, zero, dict.fromkeys(metrics, zero)
        )
        return self._state(data, anchor), outcome

    @mujoco_contact_frames()
    def step(self, state: MjxState, control: jax.Array) -> tuple[MjxState, Outcome]:
        """`task.frame_skip` physics steps under `control` ([A] float32, Gymnasium's units)."""
        data = mjx.make_data(self._model).replace(
            time=state.time,
            qpos=state.qpos,
            qvel=state.qvel,
            act=state.act,
            qacc_warmstart=state.qacc_warmstart,
            ctrl=control,
        )
        data = jax.lax.fori_loop(
            0, self.task.frame_skip, lambda _, data: mjx.step(self._model, data), data
        )
        physics = self._physics(data, contact_forces=True)
        reward, metrics = self.task.reward(jnp, state.anchor, physics, control)
        outcome = Outcome(
            self.task.observation(jnp, physics),
            reward,
            self.task.terminated(jnp, physics).astype(jnp.float32),
            {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()},
        )
        return self._state(data, self.task.anchor(jnp, physics)), outcome

    def mj_data(self, state: MjxState) -> mujoco.MjData:
        """The simulation of one instance, with everything derived from its state computed."""
        data = mujoco.MjData(self.model)
        data.time, data.qpos, data.qvel = state.time, state.qpos, state.qvel
        data.act, data.qacc_warmstart = state.act, state.qacc_warmstart
        mujoco.mj_forward(self.model, data)
        return data

    def _state(self, data: mjx.Data, anchor: jax.Array) -> MjxState:
        return MjxState(data.time, data.qpos, data.qvel, data.act, data.qacc_warmstart, anchor)

    def _physics(self, data: mjx.Data, contact_forces: bool) -> Physics:
        fields = {name: _field(data, name) for name in ("qpos", "qvel", *self.task.fields)}
        if "cfrc_ext" in fields:
            if contact_forces:
                data = mjx.rne_postconstraint(self._model, data)
                fields["cfrc_ext"] = _field(data, "cfrc_ext")
            else:
                fields["cfrc_ext"] = jnp.zeros((self.model.nbody, 6))
        return Physics(**fields)


def _field(data: mjx.Data, name: str) -> Any:
    """A field of MjData, which MJX keeps either in its public or in its own part."""
    public = data if name in data.__dataclass_fields__ else data._impl
    return getattr(public, name)
