"""What an engine reports of a step besides the physics state."""

from typing import Any, NamedTuple

import numpy as np

Array = Any


class Outcome(NamedTuple):
    """What a step or a reset shows."""

    observation: Array  # [..., D]
    reward: Array  # [...]
    terminated: Array  # [...] 0 or 1
    metrics: dict[str, Array]  # [...] each

    def pack(self) -> tuple[np.ndarray, tuple[str, ...]]:
        """One float32 array [..., D + 2 + metrics], a single result to transfer, and the names."""
        last = (self.reward, self.terminated, *self.metrics.values())
        packed = np.empty(
            (*self.observation.shape[:-1], self.observation.shape[-1] + len(last)), np.float32
        )
        packed[..., : -len(last)] = self.observation
        for i, column in enumerate(last):
            packed[..., i - len(last)] = column
        return packed, tuple(self.metrics)

    @classmethod
    def unpack(cls, packed: Array, names: tuple[str, ...]) -> "Outcome":
        reward = packed.shape[-1] - len(names) - 2
        metrics = {name: packed[..., reward + 2 + i] for i, name in enumerate(names)}
        return cls(packed[..., :reward], packed[..., reward], packed[..., reward + 1], metrics)
