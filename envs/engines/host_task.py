"""A MuJoCo task on the host: simulations and the task's own lines, for a whole batch.

NumPy only, since JAX inside a call to the host can hang. A simulation is the bits of its float64
numbers; the task's lines run in float64 too and are rounded to float32 once.
"""

import copy
import functools
import hashlib
import threading

import mujoco
import numpy as np

from envs.engines.outcome import Outcome
from envs.engines.simulators import ROW, BatchSimulator, ContactForceSimulator
from envs.mujoco_tasks.task import MujocoTask, Physics


def to_bits(values: np.ndarray) -> np.ndarray:
    """[..., K] float64 as [..., 2K] uint32."""
    return np.ascontiguousarray(values).view(np.uint32)


def to_float64(values: np.ndarray) -> np.ndarray:
    """[..., K] float64 from its bits, or from any other numbers."""
    values = np.ascontiguousarray(values)
    return values.view(np.float64) if values.dtype == np.uint32 else values.astype(np.float64)


Stepped = tuple[np.ndarray, np.ndarray, tuple[str, ...]]
"""Bits [N, 2K] uint32, packed outcomes [N, D + 2 + metrics] float32, the metrics' names."""


class HostTask:
    """Starts and steps of any number of instances at once; one thread at a time."""

    def __init__(self, task: MujocoTask, name: str | None):
        # Of its own, since others may share it: whoever changes the model later changes theirs.
        self.task = copy.copy(task)
        self.model = vars(self.task)["model"] = copy.copy(task.model)
        self.name = name
        simulator = ContactForceSimulator if "cfrc_ext" in task.fields else BatchSimulator
        self._simulator = simulator(self.model, ("qpos", "qvel", *task.fields))
        self._lock = threading.Lock()
        self._blank_row = np.zeros(mujoco.mj_stateSize(self.model, ROW))
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), self._blank_row, ROW)
        self.row_size = self._blank_row.size

    def start(self, qpos: np.ndarray, qvel: np.ndarray) -> Stepped:
        """The starts at these [N, nq] and [N, nv], float64, its bits or float32."""
        qpos, qvel = to_float64(qpos), to_float64(qvel)
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
            return to_bits(np.concatenate([rows, anchor], -1)), *outcome.pack()

    def start_off(self, qpos: np.ndarray, qvel: np.ndarray) -> Stepped:
        """`start`, so far from the model's initial position and from rest."""
        return self.start(self.model.qpos0 + to_float64(qpos), qvel)

    def step(self, bits: np.ndarray, control: np.ndarray) -> Stepped:
        """`task.frame_skip` physics steps under `control`, [N, A]."""
        values = to_float64(bits)
        rows, anchor = values[:, : self.row_size], values[:, self.row_size :]
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
            return to_bits(np.concatenate([rows, anchor], -1)), *outcome.pack()


_hosts: dict[str, list[HostTask]] = {}
_making = threading.Lock()


def host_task(task: MujocoTask) -> HostTask:
    """The host's side of a task; all tasks that are equal have one, while the process lives."""
    digest = _digest(task)
    if digest is None:
        return HostTask(task, None)
    with _making:
        same = _hosts.setdefault(digest, [])
        for host in same:
            if type(host.task) is type(task):  # not one defined before under the same name
                return host
        same.append(HostTask(task, f"{type(task).__qualname__}-{digest}-{len(same)}"))
        return same[-1]


def _digest(task: MujocoTask) -> str | None:
    """Of all that tells tasks apart, the same in every process; None for one that holds objects."""
    digest = hashlib.sha256(f"{type(task).__module__}.{type(task).__qualname__}".encode())
    for name, value in sorted(vars(task).items()):
        if isinstance(getattr(type(task), name, None), functools.cached_property):
            continue  # it follows from the others
        if not _is_plain(value):
            return None
        digest.update(f"{name}={value!r};".encode())
    content = np.empty(mujoco.mj_sizeModel(task.model), np.uint8)
    mujoco.mj_saveModel(task.model, None, content)
    digest.update(content.tobytes())
    return digest.hexdigest()[:16]


def _is_plain(value) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or type(value) in (bool, int, float, str)
