"""MuJoCo's C engine as a pure, batched function inside jitted programs.

Many simulations are stepped on a thread pool behind one call to the host. JAX computes in float32
and the engine in float64, so a simulation travels as the bits of its float64 numbers (uint32,
twice as many): its `mjSTATE_INTEGRATION` row, then the task's anchor. What the host does with them
is in `host_task`.
"""

import jax
import mujoco
import numpy as np

from envs.engines.host_call import host_call
from envs.engines.host_task import host_task, to_bits, to_float64
from envs.engines.outcome import Outcome
from envs.engines.simulators import ROW
from envs.mujoco_tasks.task import MujocoTask


class NativeEngine:
    """A task on MuJoCo's C engine; the state of an instance is [2 * (row + anchor)] uint32."""

    name = "native"

    def __init__(self, task: MujocoTask):
        self.task = task
        self._host = host_task(task)
        bits, packed, self._metric_names = self._host.start(
            np.zeros((1, task.model.nq)), np.zeros((1, task.model.nv))
        )
        self._result = (
            jax.ShapeDtypeStruct(bits.shape[1:], bits.dtype),
            jax.ShapeDtypeStruct(packed.shape[1:], packed.dtype),
        )

    def reset(self, key: jax.Array) -> tuple[jax.Array, Outcome]:
        """A start drawn as the task says; the offset is drawn in float32 and added in float64."""
        return self._call("start_off", *self.task.start_offset(key))

    def reset_to(self, qpos, qvel) -> tuple[jax.Array, Outcome]:
        """The start at a given qpos [nq] and qvel [nv]; float64 NumPy arrays keep every bit."""

        def bits(x):
            return to_bits(x) if isinstance(x, np.ndarray) and x.dtype == np.float64 else x

        return self._call("start", bits(qpos), bits(qvel))

    def step(self, bits: jax.Array, control: jax.Array) -> tuple[jax.Array, Outcome]:
        """`task.frame_skip` physics steps under `control` ([A] float32, Gymnasium's units)."""
        return self._call("step", bits, control)

    def mj_data(self, bits: jax.Array | np.ndarray) -> mujoco.MjData:
        """The simulation of one instance, with everything derived from its state computed."""
        data = mujoco.MjData(self.task.model)
        values = to_float64(np.asarray(bits))
        mujoco.mj_setState(self.task.model, data, values[: self._host.row_size], ROW)
        mujoco.mj_forward(self.task.model, data)
        return data

    def _call(self, method: str, *arguments) -> tuple[jax.Array, Outcome]:
        function = getattr(self._host, method)

        def batched(*arguments):
            # Under vmap, nested too, the axes in front are all one batch to the engine.
            axes = arguments[0].shape[:-1]
            bits, packed, _ = function(*(x.reshape(-1, x.shape[-1]) for x in arguments))
            return bits.reshape(*axes, -1), packed.reshape(*axes, -1)

        name = self._host.name and f"{self._host.name}.{method}"
        bits, packed = host_call(batched, self._result, *arguments, name=name)
        return bits, Outcome.unpack(packed, self._metric_names)
