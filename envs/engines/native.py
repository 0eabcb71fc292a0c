"""MuJoCo's C engine as a pure, batched function inside jitted programs.

`mujoco.batch` steps many simulations on a thread pool behind one `jax.pure_callback`. JAX computes
in float32 and the engine in float64, so a simulation travels as the bits of its float64 numbers
(uint32, twice as many): its `mjSTATE_INTEGRATION` row, then the task's anchor. The task's own
lines run in NumPy float64 inside the callback and are rounded to float32 once.
"""

import functools
import os
import threading

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.engines.outcome import Outcome
from envs.mujoco_tasks.task import MujocoTask, Physics

ROW = mujoco.mjtState.mjSTATE_INTEGRATION


def _to_bits(values: np.ndarray) -> np.ndarray:
    """[..., K] float64 as [..., 2K] uint32."""
    return np.ascontiguousarray(values).view(np.uint32)


def _to_float64(values: np.ndarray) -> np.ndarray:
    """[..., K] float64 from its bits, or from any other numbers."""
    values = np.ascontiguousarray(values)
    return values.view(np.float64) if values.dtype == np.uint32 else values.astype(np.float64)


class NativeEngine:
    """A task on MuJoCo's C engine; the state of an instance is [2 * (row + anchor)] uint32."""

    name = "native"

    def __init__(self, task: MujocoTask):
        self.task = task
        self.model = task.model
        self._row_size = mujoco.mj_stateSize(self.model, ROW)
        self._lock = threading.Lock()
        self._batches: dict[int, Batch] = {}
        bits, packed, self._metric_names = self._start(
            np.zeros((1, self.model.nq)), np.zeros((1, self.model.nv))
        )
        self._result = (
            jax.ShapeDtypeStruct(bits.shape[1:], bits.dtype),
            jax.ShapeDtypeStruct(packed.shape[1:], packed.dtype),
        )

    def reset(self, key: jax.Array) -> tuple[jax.Array, Outcome]:
        """A start drawn as the task says; the offset is drawn in float32 and added in float64."""

        def start(qpos_offset, qvel_offset):
            return self._start(
                self.model.qpos0 + _to_float64(qpos_offset), _to_float64(qvel_offset)
            )

        return self._call(start, *self.task.start_offset(key))

    def reset_to(self, qpos, qvel) -> tuple[jax.Array, Outcome]:
        """The start at a given qpos [nq] and qvel [nv]; float64 NumPy arrays keep every bit."""

        def bits(x):
            return _to_bits(x) if isinstance(x, np.ndarray) and x.dtype == np.float64 else x

        def start(qpos, qvel):
            return self._start(_to_float64(qpos), _to_float64(qvel))

        return self._call(start, bits(qpos), bits(qvel))

    def step(self, bits: jax.Array, control: jax.Array) -> tuple[jax.Array, Outcome]:
        """`task.frame_skip` physics steps under `control` ([A] float32, Gymnasium's units)."""
        return self._call(self._step, bits, control)

    def mj_data(self, bits: jax.Array) -> mujoco.MjData:
        """The simulation of one instance, with everything derived from its state computed."""
        data = mujoco.MjData(self.model)
        row = _to_float64(np.asarray(bits))[: self._row_size]
        mujoco.mj_setState(self.model, data, row, ROW)
        mujoco.mj_forward(self.model, data)
        return data

    # -- on the device ---------------------------------------------------------------------------

    def _call(self, function, *arguments) -> tuple[jax.Array, Outcome]:
        def host(*arguments):
            # Under vmap, nested too, the axes in front are all one batch to the engine.
            arguments = [np.asarray(x) for x in arguments]
            axes = arguments[0].shape[:-1]
            bits, packed, _ = function(*(x.reshape(-1, x.shape[-1]) for x in arguments))
            return bits.reshape(*axes, -1), packed.reshape(*axes, -1)

        bits, packed = jax.pure_callback(
            host, self._result, *arguments, vmap_method="broadcast_all"
        )
        return bits, Outcome.unpack(packed, self._metric_names)

    # -- on the host: NumPy only, since JAX inside a callback can hang ---------------------------

    def _start(self, qpos: np.ndarray, qvel: np.ndarray):
        n = len(qpos)
        with self._lock:
            batch = self._batch(n)
            batch.state[:] = self._blank_row
            batch.qpos, batch.qvel = qpos, qvel
            batch.forward()
            # Gymnasium has no contact forces after a reset.
            physics = self._physics(batch, contact_forces=False)
            anchor = self.task.anchor(np, physics)
            control = np.zeros((n, self.model.nu), np.float32)
            _, metrics = self.task.reward(np, anchor, physics, control)
            zero = np.zeros(n)
            metrics = dict.fromkeys(metrics, zero)
            bits = _to_bits(np.concatenate([batch.state, anchor], -1))
            observation = self.task.observation(np, physics)
            return bits, *Outcome(observation, zero, zero, metrics).pack()

    def _step(self, bits: np.ndarray, control: np.ndarray):
        values = _to_float64(bits)
        rows, anchor = values[:, : self._row_size], values[:, self._row_size :]
        with self._lock:
            batch = self._batch(len(rows))
            batch.state[:] = rows
            batch.ctrl = control
            batch.step(nstep=self.task.frame_skip)
            physics = self._physics(batch, contact_forces=True)
            reward, metrics = self.task.reward(np, anchor, physics, control)
            bits = _to_bits(np.concatenate([batch.state, self.task.anchor(np, physics)], -1))
            observation = self.task.observation(np, physics)
            terminated = self.task.terminated(np, physics)
            return bits, *Outcome(observation, reward, terminated, metrics).pack()

    def _physics(self, batch: Batch, contact_forces: bool) -> Physics:
        names = [name for name in self.task.fields if name != "cfrc_ext"]
        fields = {name: getattr(batch, name) for name in ("qpos", "qvel", *names)}
        if "cfrc_ext" in self.task.fields:
            fields["cfrc_ext"] = np.zeros((batch.nsim, self.model.nbody, 6))
            if contact_forces:
                self._add_contact_forces(batch, fields["cfrc_ext"])
        return Physics(**fields)

    def _add_contact_forces(self, batch: Batch, cfrc_ext: np.ndarray) -> None:
        """mj_step leaves cfrc_ext to be asked for, as Gymnasium does after its steps."""
        for i in range(batch.nsim):
            batch.get_data(i, self._scratch)
            mujoco.mj_rnePostConstraint(self.model, self._scratch)
            cfrc_ext[i] = self._scratch.cfrc_ext

    @functools.cached_property
    def _scratch(self) -> mujoco.MjData:
        return mujoco.MjData(self.model)

    @functools.cached_property
    def _blank_row(self) -> np.ndarray:
        row = np.zeros(self._row_size)
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), row, ROW)
        return row

    def _batch(self, n: int) -> Batch:
        """One batch a size, made on first use; every call overwrites all of its state."""
        if n not in self._batches:
            batch = Batch(
                self.model,
                n,
                nthread=min(n, len(os.sched_getaffinity(0))),
                persistent="cfrc_ext" in self.task.fields,
            )
            for name in self.task.fields:
                if name != "cfrc_ext":
                    batch.bind(name)  # from now on every call computes it
            self._batches[n] = batch
        return self._batches[n]
