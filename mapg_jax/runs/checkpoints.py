"""Checkpoints by Orbax: written whole or not at all, the newest ones kept.

A checkpoint has two parts: `agent`, enough to act and evaluate, and `rest`, what else a run needs
to go on bit for bit. Only the filled slots of the replay are written. Leaves are stored under
their paths in the tree, random keys as their bits; nothing is pickled.
"""

import logging
import pathlib
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from mapg_jax.training import replay
from mapg_jax.training.agent import AgentState
from mapg_jax.training.state import TrainState

logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax logs every save at WARNING


class Checkpoints:
    """The checkpoints of a run folder."""

    def __init__(self, path: pathlib.Path, kept: int | None = None):
        options = ocp.CheckpointManagerOptions(
            max_to_keep=kept, enable_async_checkpointing=False, create=kept is not None
        )
        self.path = path
        self._manager = ocp.CheckpointManager(path.absolute(), options=options)

    def newest(self) -> int | None:
        """Environment steps of the newest complete checkpoint; None without one."""
        return self._manager.latest_step()

    def save(self, state: TrainState, host: dict[str, Any]) -> None:
        """Writes the state and the host's own numbers (JSON)."""
        rest = state.replace(agent=None)
        if state.replay is not None:
            rest = rest.replace(replay=replay.trim(state.replay))
        args = ocp.args.Composite(
            agent=ocp.args.StandardSave(_flatten(state.agent)),
            rest=ocp.args.StandardSave(_flatten(rest)),
            host=ocp.args.JsonSave(host),
        )
        self._manager.save(int(state.env_steps), args=args, force=True)

    def drop_replay(self) -> None:
        """Leaves the agents: enough to act and to evaluate, not to train further."""
        for step in self._manager.all_steps():
            shutil.rmtree(self.path / str(step) / "rest", ignore_errors=True)

    def can_go_on(self) -> bool:
        """Whether the newest checkpoint is whole, or only its agent is left."""
        return (self.path / str(self.newest()) / "rest").exists()

    def load(self, shapes: Any) -> tuple[Any, dict[str, Any]]:
        """The newest state, and the host's numbers.

        Args:
          shapes: the state's shapes, as `jax.eval_shape` gives them.

        Raises:
          ValueError: if there is none, or it does not fit or is damaged.
        """
        step = self._newest()
        agent = self._load_agent(step, shapes.agent)
        restored = self._restore(step, "rest", ocp.args.StandardRestore())
        host = self._restore(step, "host", ocp.args.JsonRestore())
        rest_shapes = shapes.replace(agent=None)
        rest = self._unflatten(rest_shapes, restored)
        return rest.replace(agent=agent), host

    def load_agent(self, shapes: AgentState) -> tuple[AgentState, int]:
        """The newest agent, and its environment steps; the replay is not read."""
        step = self._newest()
        return self._load_agent(step, shapes), step

    def _newest(self) -> int:
        if (step := self.newest()) is None:
            raise ValueError(f"{self.path.parent} has no complete checkpoint")
        return step

    def _load_agent(self, step: int, shapes: AgentState) -> AgentState:
        return self._unflatten(shapes, self._restore(step, "agent", ocp.args.StandardRestore()))

    def _restore(self, step: int, item: str, arguments) -> Any:
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**{item: arguments}))[item]
        except Exception as error:  # Orbax and TensorStore raise many kinds
            reason = (str(error).strip() or repr(error)).splitlines()[0][:200]
            raise ValueError(
                f"the checkpoint {self.path / str(step)} is damaged ({reason}); "
                "remove that folder to go on from the one before"
            ) from error

    def _unflatten(self, shapes: Any, stored: dict[str, Any]) -> Any:
        leaves, structure = jax.tree_util.tree_flatten_with_path(shapes)
        named = [(jax.tree_util.keystr(path), shape) for path, shape in leaves]
        if {name for name, shape in named if shape.size} != set(stored):
            raise ValueError(
                f"{self.path.parent}: the checkpoint is of another configuration, or engine"
            )
        values = [
            _as_leaf(stored.get(name), shape, name.startswith(".replay.data"))
            for name, shape in named
        ]
        return jax.tree_util.tree_unflatten(structure, values)


def _flatten(tree: Any) -> dict[str, Any]:
    """Leaves by name, but for the empty ones, which Orbax refuses: MJX's state has some."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): _as_array(leaf) for path, leaf in leaves if leaf.size}


def _is_key(dtype) -> bool:
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def _as_array(leaf: jax.Array | np.ndarray) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf.dtype) else leaf)


def _as_leaf(stored: Any, shape: jax.ShapeDtypeStruct, padded: bool) -> jax.Array:
    value = np.zeros(shape.shape, shape.dtype) if stored is None else np.asarray(stored)
    if _is_key(shape.dtype):
        return jax.random.wrap_key_data(jnp.asarray(value))
    if padded:
        whole = np.zeros(shape.shape, shape.dtype)
        whole[: len(value)] = value
        value = whole
    if value.shape != shape.shape:
        raise ValueError(f"the checkpoint holds {value.shape} where {shape.shape} is expected")
    return jnp.asarray(value, shape.dtype)
