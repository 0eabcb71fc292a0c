"""MuJoCo's C engine as a pure, batched function inside jitted programs.

Many simulations are stepped on a thread pool behind one `jax.pure_callback`. JAX computes in
float32 and the engine in float64, so a simulation travels as the bits of its float64 numbers
(uint32, twice as many): its `mjSTATE_INTEGRATION` row, then the task's anchor. The task's own
lines run in NumPy float64 inside the callback and are rounded to float32 once.
"""

import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.engines.outcome import Outcome
from envs.engines.simulators import ROW, BatchSimulator, ContactForceSimulator
from envs.mujoco_tasks.task import MujocoTask, Physics


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
        simulator = ContactForceSimulator if "cfrc_ext" in task.fields else BatchSimulator
        self._simulator = simulator(self.model, ("qpos", "qvel", *task.fields))
        self._lock = threading.Lock()
        self._blank_row = np.zeros(mujoco.mj_stateSize(self.model, ROW))
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), self._blank_row, ROW)
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
        # One argument, since each costs a callback tens of microseconds.
        packed = jnp.concatenate([bits, jax.lax.bitcast_convert_type(control, jnp.uint32)])
        return self._call(self._step, packed)

    def mj_data(self, bits: jax.Array) -> mujoco.MjData:
        """The simulation of one instance, with everything derived from its state computed."""
        data = mujoco.MjData(self.model)
        row = _to_float64(np.asarray(bits))[: self._blank_row.size]
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
        nq, nv, zero = self.model.nq, self.model.nv, np.zeros(len(qpos))
        rows = np.tile(self._blank_row, (len(qpos), 1))
        rows[:, 1 : 1 + nq + nv] = np.concatenate([qpos, qvel], -1)  # a row begins with the time
        with self._lock:
            rows, fields = self._simulator.forward(rows)
            physics = Physics(**fields)
            anchor = self.task.anchor(np, physics)
            control = np.zeros((len(qpos), self.model.nu), np.float32)
            _, metrics = self.task.reward(np, anchor, physics, control)
            outcome = Outcome(
                self.task.observation(np, physics), zero, zero, dict.fromkeys(metrics, zero)
            )
            return _to_bits(np.concatenate([rows, anchor], -1)), *outcome.pack()

    def _step(self, packed: np.ndarray):
        control = packed[:, -self.model.nu :].view(np.float32)
        values = packed[:, : -self.model.nu].view(np.float64)
        rows, anchor = values[:, : self._blank_row.size], values[:, self._blank_row.size :]
        with self._lock:
            rows, fields = self._simulator.step(rows, control, self.task.frame_skip)
            physics = Physics(**fields)
            reward, metrics = self.task.reward(np, anchor, physics, control)
            outcome = Outcome(
                self.task.observation(np, physics),
                reward,
                self.task.terminated(np, physics),
                metrics,
            )
            anchor = self.task.anchor(np, physics)
            return _to_bits(np.concatenate([rows, anchor], -1)), *outcome.pack()
