"""Devices and hosts of a run: what lies where, and how several processes make it together.

All processes compute the same program, each on its devices, and take every decision together. What
is small in the run folder the first alone writes; of a checkpoint each writes its part.
"""

import os
import re
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import NamedSharding

from mapg_jax.training.layout import Layout
from mapg_jax.training.state import TrainState
from mapg_jax.training.trainer import Trainer

Made = TypeVar("Made")
LEAVING_SECONDS = 30
"""How long a process that has failed by itself is waited for by the others; then they abort."""


def join(address: str | None, count: int | None, index: int | None) -> None:
    """Becomes one of the processes of a run; what is None is what Slurm's environment says.

    Args:
      address: of the first process, as HOST:PORT.
      count: of processes.
      index: of this one, from 0.

    Raises:
      ValueError: if a number is missing and there is no cluster to ask, the address has no port,
        there is no process of that index, or the processes do not meet.
    """
    if address is not None and not re.fullmatch(r".+:\d+", address):
        raise ValueError(f"--coordinator must be HOST:PORT or slurm, got {address!r}")
    if count is not None and count < 1:
        raise ValueError(f"--hosts must be at least 1, got {count}")
    if count is not None and index is not None and not 0 <= index < count:
        raise ValueError(f"--host must be from 0 to {count - 1} of --hosts {count}, got {index}")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    if "SLURM_JOB_ID" not in os.environ and None in (address, count, index):
        raise ValueError(
            "this is no job of Slurm; several hosts need --coordinator HOST:PORT, --hosts N and "
            "--host I, from 0"
        )
    try:
        jax.distributed.initialize(address, count, index, shutdown_timeout_seconds=LEAVING_SECONDS)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"the processes of this run cannot meet: {reason}") from None


def refuse_idle(trainer: Trainer) -> None:
    """Raises ValueError if one of the processes has no device of the run, and no part in it."""
    hosts, devices = jax.process_count(), jax.device_count()
    at_work = {device.process_index for device in trainer.layout.mesh.devices.flat}
    if len(at_work) == hosts:
        return
    remedy = f"--shards {devices}, or a multiple, and --devices all"
    if trainer.on_one_device:
        remedy = f"--hosts 1: {trainer.config.env} runs on one device ({trainer.env.backend})"
    raise ValueError(
        f"the run takes {trainer.layout.devices} of {devices} devices, and {len(at_work)} of "
        f"{hosts} hosts have one of them; choose {remedy}"
    )


def is_first() -> bool:
    """Whether this process writes what is small, and tells the user."""
    return jax.process_index() == 0


def by_first(make: Callable[[], Made], find: Callable[[], Made]) -> Made:
    """What the first process makes and the others then find; its refusal is theirs."""
    if not is_first():
        if not of_first(0):
            raise ValueError("the first process of this run was refused; see what it says")
        return find()
    try:
        made = make()
    except Exception:
        of_first(0)
        raise
    of_first(1)
    return made


def by_all(make: Callable[[], Made], elsewhere: Exception | None = None) -> Made:
    """What each process makes for itself, asking none of the others; the refusal of one is theirs.

    Args:
      make: makes it, or raises an exception of that type.
      elsewhere: what is raised where another process alone was refused; by default a ValueError.
    """
    elsewhere = elsewhere or ValueError("another process of this run was refused; see what it says")
    error = None
    made: Any = None
    try:
        made = make()
    except type(elsewhere) as ours:
        error = ours
    if largest(error is not None):
        raise error or elsewhere
    return made


def of_first(numbers: Any) -> np.ndarray:
    """Whole numbers as the first process has them."""
    if jax.process_count() == 1:
        return np.asarray(numbers)
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.broadcast_one_to_all(np.asarray(numbers)))


def largest(numbers: Any) -> Any:
    """The largest that any process has of a number, or of each of an array."""
    if jax.process_count() == 1:
        return numbers
    from jax.experimental import multihost_utils

    return np.max(multihost_utils.process_allgather(np.asarray(numbers)), axis=0)


def wait(where: str) -> None:
    """Until all processes are here."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(where)


def parted(shapes: TrainState, layout: Layout) -> TrainState:
    """The shapes of a state, with where their arrays lie if that is on several hosts."""
    if jax.process_count() == 1:
        return shapes

    def among_all(x, sharding):
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)

    return jax.tree.map(among_all, shapes, layout.shardings(shapes))


def placed(state: TrainState, layout: Layout) -> TrainState:
    """The state where the program wants it; a device is given its own part alone."""
    if layout.devices == 1:
        return jax.device_put(state)
    if jax.process_count() == 1:
        return jax.device_put(state, layout.shardings(state))
    return jax.tree.map(_put, state, layout.shardings(state))


def fetched(shared: Any, layout: Layout) -> Any:
    """What all shards share, off the devices of the run if there are several."""
    return shared if layout.devices == 1 else jax.device_get(shared)


def _put(x: Any, sharding: NamedSharding) -> Any:
    """An array, which every process has or which is among all of them, where it is wanted."""
    if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(x), sharding))
    if isinstance(x, np.ndarray) or x.is_fully_addressable:
        whole = np.asarray(x)
        return jax.make_array_from_callback(x.shape, sharding, lambda index: whole[index])
    return jax.jit(lambda y: y, out_shardings=sharding)(x)
