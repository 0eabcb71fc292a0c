"""Where the shards of a run are computed: over devices, and side by side on each."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mapg_jax.algorithms.shards import DEVICE, SHARD
from mapg_jax.training.state import TrainState, tree_bytes

BY_SHARD = ("explorer", "replay", "env", "running_return")
_AXES: Any = {field.name: None for field in dataclasses.fields(TrainState)}
AXES = TrainState(**_AXES | dict.fromkeys(BY_SHARD, 0))
"""Of the state of several shards: what has an axis [S, ...] in front, and what all shards share."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """S shards on D devices, S/D on each."""

    shards: int = 1
    devices: int = 1

    def __post_init__(self):
        """Raises ValueError if there are not so many devices, or they do not divide the shards."""
        if self.devices < 1 or self.shards % self.devices:
            raise ValueError(
                f"{self.devices} devices do not divide {self.shards} shards; "
                f"choose --devices {most_devices(self.shards)} or other --shards"
            )
        if self.devices > 1 and self.devices > jax.device_count():
            raise ValueError(
                f"there are {jax.device_count()} devices, not {self.devices}; "
                f"choose --devices {most_devices(self.shards)}"
            )

    @functools.cached_property
    def mesh(self) -> Mesh:
        """Of the first D devices."""
        devices = jax.devices()[: self.devices]
        return jax.make_mesh((self.devices,), (DEVICE,), (AxisType.Auto,), devices=devices)

    def over_shards(self, function: Callable[..., TrainState]) -> Callable[..., TrainState]:
        """(state, *numbers) → state of all shards, of a function that does it for one.

        What all shards share must come out equal in all of them: `algorithms.shards` averages it.
        """
        if self.shards == 1:
            return function

        def on_a_device(state, *numbers):
            return jax.vmap(
                function,
                in_axes=(AXES, *(None for _ in numbers)),
                out_axes=AXES,
                axis_name=SHARD,
                axis_size=self.shards // self.devices,
            )(state, *numbers)

        def on_all(state, *numbers):
            mapped = jax.shard_map(
                on_a_device,
                mesh=self.mesh,
                in_specs=(_specs(), *(PartitionSpec() for _ in numbers)),
                out_specs=_specs(),
                check_vma=False,
            )
            return mapped(state, *numbers)

        return on_a_device if self.devices == 1 else on_all

    def bytes(self, state: TrainState) -> int:
        """Memory of each device for a state, or its shapes: its own shards, and what all share."""
        of_shards = tree_bytes([getattr(state, name) for name in BY_SHARD])
        return tree_bytes(state) - of_shards + of_shards // self.devices

    def shardings(self, state: TrainState) -> Any:
        """Of each leaf."""
        of_part = jax.tree.map(lambda spec: NamedSharding(self.mesh, spec), _specs())
        return jax.tree.broadcast(of_part, state, is_leaf=lambda x: isinstance(x, NamedSharding))


def _specs() -> Any:
    def spec(axis):
        return PartitionSpec() if axis is None else PartitionSpec(DEVICE)

    return jax.tree.map(spec, AXES, is_leaf=lambda axis: axis is None)


def most_devices(shards: int) -> int:
    """The most of this program's devices that divide the shards."""
    return max(n for n in range(1, jax.device_count() + 1) if shards % n == 0)
