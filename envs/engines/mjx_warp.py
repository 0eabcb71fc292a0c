"""MuJoCo Warp through MJX: the same tasks once more, by kernels that NVIDIA's GPUs run fastest."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from envs.engines.mjx import MjxEngine, field, mjx
from envs.mujoco_tasks.task import MujocoTask

Values = Mapping[str, jax.Array]


class MjxWarpEngine(MjxEngine):
    """A task on MuJoCo Warp.

    All simulations of a program share the memory of their contacts, which is sized when it is
    traced: they are counted there, whatever axes `vmap` lays them along.
    """

    name = "mjx-warp"

    def __init__(self, task: MujocoTask):
        """Prepares the model.

        Raises:
          ValueError: if Warp is missing, cannot run here, or does not compute what the task reads.
        """
        if "cfrc_ext" in task.fields:
            raise ValueError(
                f"{type(task).__name__} reads cfrc_ext, which MuJoCo Warp does not compute; "
                "choose the engine native or mjx"
            )
        try:
            import warp  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ValueError("the engine mjx-warp needs: pip install 'mapg-jax[warp]'") from None
        if jax.default_backend() not in ("cpu", "gpu"):
            raise ValueError(
                f"the engine mjx-warp runs on GPUs and CPUs, not on {jax.default_backend()}; "
                "choose the engine mjx"
            )
        # It would tell of every kernel that it compiles.
        warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
        super().__init__(task)
        room: Any = mjx.make_data(self._model)._impl  # of all contacts that there can be
        self._contacts, self._constraints = room.ncon, room.nefc
        self._model = mjx.put_model(self.model, impl="warp")
        self._all_simulated = functools.cache(self._of_all)

    def _simulated(self, start: Values, frames: int) -> dict[str, jax.Array]:
        alone = {name: jnp.asarray(value)[None] for name, value in start.items()}
        return {name: value[0] for name, value in self._all_simulated(frames)(alone).items()}

    def _of_all(self, frames: int) -> Callable[[Values], dict[str, jax.Array]]:
        """(starts, leaves [N, ...]) → what is read of each; `vmap` makes N larger."""

        @jax.custom_batching.custom_vmap
        def simulated(starts: Values) -> dict[str, jax.Array]:
            return self._batch(starts, frames)

        @simulated.def_vmap
        def _(size: int, batched: Sequence[Mapping[str, bool]], starts: Values):
            whole = {
                name: value if batched[0][name] else jnp.broadcast_to(value, (size, *value.shape))
                for name, value in starts.items()
            }
            n = next(iter(whole.values())).shape[1]
            flat = {name: jax.lax.collapse(value, 0, 2) for name, value in whole.items()}
            values = simulated(flat)
            split = {
                name: value.reshape(size, n, *value.shape[1:]) for name, value in values.items()
            }
            return split, dict.fromkeys(split, True)

        return simulated

    def _batch(self, starts: Values, frames: int) -> dict[str, jax.Array]:
        n = len(starts["qpos"])
        data = mjx.make_data(
            self.model, impl="warp", naconmax=n * self._contacts, njmax=self._constraints
        )

        def simulated(start: Values) -> dict[str, jax.Array]:
            after = self._after(data.replace(**start), frames)
            return {name: field(after, name) for name in self._names}

        return jax.vmap(simulated)(starts)
