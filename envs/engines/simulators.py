"""Two ways to run many simulations of one MuJoCo model from their state rows, bit for bit alike.

A row is a simulation's `mjSTATE_INTEGRATION`, all that its next step depends on: [R] float64.
What a simulator returns may be overwritten by its next call.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from jaxtyping import Float, Float32, Float64
from mujoco.batch import Batch

ROW = mujoco.mjtState.mjSTATE_INTEGRATION

Rows = Float64[np.ndarray, "N R"]
Fields = dict[str, Float[np.ndarray, "N ..."]]


def cpus() -> int:
    """The processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class BatchSimulator:
    """`mujoco.batch`, on C++ threads: the fields that `mj_step` itself computes."""

    def __init__(self, model: mujoco.MjModel, fields: tuple[str, ...]):
        self._model, self._fields = model, fields
        self._batches: dict[int, tuple[Batch, np.ndarray, Fields]] = {}

    def forward(self, rows: Rows) -> tuple[Rows, Fields]:
        """All that `mj_forward` derives from the rows."""
        batch, _, fields = self._batch(len(rows))
        batch.state[:] = rows
        batch.forward()
        return batch.state, fields

    def step(
        self, rows: Rows, control: Float32[np.ndarray, "N A"], frames: int
    ) -> tuple[Rows, Fields]:
        """The rows after `frames` physics steps, and the fields as they leave them."""
        batch, batch_control, fields = self._batch(len(rows))
        batch.state[:] = rows
        batch_control[:] = control
        batch.step(nstep=frames)
        return batch.state, fields

    def _batch(self, size: int) -> tuple[Batch, np.ndarray, Fields]:
        """The batch, its control and its fields; both are views, which binding anew makes slow."""
        if size not in self._batches:
            batch = Batch(self._model, size, nthread=min(size, cpus()))
            fields = {name: batch.bind(name) for name in self._fields}
            self._batches[size] = batch, batch.bind("ctrl"), fields
        return self._batches[size]


class ContactForceSimulator:
    """One `mujoco.MjData` a thread, on Python threads: `cfrc_ext` too.

    `mj_step` leaves `cfrc_ext` to `mj_rnePostConstraint`, which wants the simulation's whole
    `MjData` right after the step. A batch can keep one for each simulation, but that takes
    15 MB each and the forces one after the other; here a thread does both for its share.
    """

    def __init__(self, model: mujoco.MjModel, fields: tuple[str, ...]):
        self._model, self._fields = model, fields
        self._data = [mujoco.MjData(model) for _ in range(cpus())]
        self._pool = ThreadPoolExecutor(len(self._data))

    def forward(self, rows: Rows) -> tuple[Rows, Fields]:
        """All that `mj_forward` derives from the rows; no contact forces, as Gymnasium's reset."""

        def forward(data, _):
            mujoco.mj_forward(self._model, data)
            data.cfrc_ext = 0.0

        return self._run(rows, forward)

    def step(
        self, rows: Rows, control: Float32[np.ndarray, "N A"], frames: int
    ) -> tuple[Rows, Fields]:
        """The rows after `frames` physics steps, and the fields as they leave them."""

        def step(data, i):
            data.ctrl = control[i]
            mujoco.mj_step(self._model, data, frames)
            mujoco.mj_rnePostConstraint(self._model, data)

        return self._run(rows, step)

    def _run(
        self, rows: Rows, function: Callable[[mujoco.MjData, int], None]
    ) -> tuple[Rows, Fields]:
        size, threads = len(rows), min(len(rows), len(self._data))
        rows = rows.copy()
        fields = {
            name: np.empty((size, *getattr(self._data[0], name).shape)) for name in self._fields
        }

        def share(thread: int) -> None:
            data = self._data[thread]
            for i in range(thread, size, threads):
                mujoco.mj_setState(self._model, data, rows[i], ROW)
                function(data, i)
                mujoco.mj_getState(self._model, data, rows[i], ROW)
                for name, values in fields.items():
                    values[i] = getattr(data, name)

        if threads == 1:
            share(0)
        else:
            list(self._pool.map(share, range(threads)))
        return rows, fields
