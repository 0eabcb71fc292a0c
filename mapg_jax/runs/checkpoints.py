"""Checkpoints by Orbax: written whole or not at all, sealed, and read as they were written.

A checkpoint has three parts: `agent`, enough to act and evaluate; `rest`, what else a run needs to
go on bit for bit; and `host`, its seal: digests of every array, of the configuration, of itself.
Of the replay, if it is saved at all, one host writes the filled slots alone. Leaves are stored
under their paths in the tree, random keys as their bits; nothing is pickled. Of several hosts each
writes and reads what its devices hold, filled or not; an array that all have they write in slices.
"""

import concurrent.futures
import functools
import logging
import pathlib
import re
import shutil
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from mapg_jax.runs import hosts
from mapg_jax.runs.checkpoint_record import Record, digests_in, digests_of, holds
from mapg_jax.training import replay
from mapg_jax.training.agent import AgentState
from mapg_jax.training.layout import BY_SHARD
from mapg_jax.training.state import TrainState

# Orbax logs every save at WARNING, and what it raises besides at ERROR.
logging.getLogger("absl").setLevel(logging.CRITICAL)
LOG = logging.getLogger(__name__)
WRITER = concurrent.futures.ThreadPoolExecutor(1, "checkpoints")
"""One checkpoint at a time, of all runs in lockstep too. (Orbax's own threads wait five minutes for
each other where one cannot write.)"""
RAISED = ("Event loop is closed", "Encountered error while reading array index")
"""How what TensorStore tells again of a checkpoint begins: the one error of it has been raised."""


def _without_what_was_raised(tell):
    """A hook for what cannot be raised."""

    def hook(unraisable):
        if not str(unraisable.exc_value).startswith(RAISED):
            tell(unraisable)

    return hook


sys.unraisablehook = _without_what_was_raised(sys.unraisablehook)


class DamagedError(ValueError):
    """A checkpoint is not what was written."""


class Checkpoints:
    """The checkpoints of a run folder."""

    def __init__(
        self, path: pathlib.Path, kept: int | None = None, config: str = "", shards: int = 1
    ):
        """Reads; it writes too where it is told how many to keep.

        Args:
          path: their folder.
          kept: how many.
          config: the digest of the run's configuration, which is sealed with each of them.
          shards: of the run.
        """
        if kept is not None and hosts.is_first():
            path.mkdir(parents=True, exist_ok=True)
        self.path, self._kept, self._config, self._shards = path, kept, config, shards
        self._manager = self._made(_alone())
        self._writing: concurrent.futures.Future[None] | None = None

    def _made(self, hosts_of_it: ocp.options.MultiprocessingOptions) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=self._kept,
            enable_async_checkpointing=False,
            create=False,
            multiprocessing_options=hosts_of_it,
        )
        return ocp.CheckpointManager(self.path.absolute(), options=options)

    @functools.cached_property
    def _writer(self) -> ocp.CheckpointManager:
        """Of all hosts together, while each reads for itself and waits for no other."""
        if jax.process_count() == 1:
            return self._manager
        return self._made(ocp.options.MultiprocessingOptions())

    def steps(self) -> list[int]:
        """Environment steps of all complete checkpoints, the newest last."""
        return sorted(self._manager.all_steps())

    def newest(self) -> int | None:
        """Environment steps of the newest complete checkpoint; None without one."""
        return self._manager.latest_step()

    def save(self, state: TrainState, host: Mapping[str, Any]) -> None:
        """Writes the state and the host's own numbers (JSON).

        Raises:
          OSError: if it cannot be written, as where the disk is full or the hosts differ.
        """
        self.begin_to_save(state, host)
        self.wait()

    def begin_to_save(self, state: TrainState, host: Mapping[str, Any]) -> None:
        """`save` from a copy, beside what goes on; it is whole once `wait` has returned.

        Several hosts save together, at once and from the state itself.

        Raises:
          OSError: if the one before could not be written.
        """
        self.wait()
        rest = state.replace(agent=None)
        if state.replay is not None:
            rest = rest.replace(replay=replay.trim(state.replay))
        parts = {"agent": _flatten(state.agent), "rest": _flatten(rest)}
        step = int(state.env_steps)
        if jax.process_count() > 1:
            self._write(step, parts, dict(host))
            self._manager.reload()
            return
        # Arrays of NumPy share the buffers of those of JAX, which the next chunk writes over.
        copies = {
            part: {name: np.array(leaf) for name, leaf in leaves.items()}
            for part, leaves in parts.items()
        }
        self._writing = WRITER.submit(self._write, step, copies, dict(host))

    def wait(self) -> None:
        """Until the checkpoint that was begun is whole.

        Raises:
          OSError: if it cannot be written.
        """
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()

    def _write(self, step: int, parts: dict[str, dict[str, Any]], host: dict) -> None:
        saved = {part: ocp.args.StandardSave(leaves) for part, leaves in parts.items()}
        try:
            digests = {
                part: digests_of(leaves, self._by_row(leaves)) for part, leaves in parts.items()
            }
            record = Record(step, self._config, host, digests)
            sealed = {**record._asdict(), "seal": record.seal()}
            args = ocp.args.Composite(**saved, host=ocp.args.JsonSave(sealed))
            self._writer.save(step, args=args, force=True)
        except Exception as error:  # Orbax and TensorStore raise many kinds
            raise OSError(
                f"the checkpoint of step {step:,} cannot be written to {self.path} "
                f"({_reason(error)}); those before it are whole"
            ) from None

    def drop_replay(self) -> None:
        """Leaves the agents: enough to act and to evaluate, not to train further."""
        for step in self._manager.all_steps():
            shutil.rmtree(self.path / str(step) / "rest", ignore_errors=True)

    def can_go_on(self, step: int) -> bool:
        """Whether that checkpoint is whole, or only its agent is left."""
        return (self.path / str(step) / "rest").exists()

    def drop_leftovers(self) -> None:
        """Removes what a process that was killed had half written."""
        for folder in self.path.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(folder)

    def drop_after(self, step: int) -> None:
        """Removes those of later steps: a run that goes on from `step` makes them again."""
        for later in self.steps():
            if later > step:
                shutil.rmtree(self.path / str(later))
        self._manager.reload()

    def set_aside(self, error: DamagedError, step: int) -> None:
        """Renames a damaged checkpoint, and says so: the one before it is the newest then."""
        number, place = 1, self.path / f"{step}.damaged"
        while place.exists():
            number, place = number + 1, self.path / f"{step}.damaged-{number}"
        hosts.wait("damage found")
        if hosts.is_first():
            (self.path / str(step)).rename(place)
        hosts.wait("damage set aside")
        self._manager.reload()
        LOG.warning("%s; it is set aside as %s", error, place.name)

    def load(self, shapes: Any, step: int | None = None) -> tuple[Any, dict[str, Any]]:
        """A state, in NumPy's arrays but for random keys, and the host's numbers.

        Args:
          shapes: the state's shapes, as `jax.eval_shape` gives them; with shardings, of which this
            host holds a part, the arrays are made there.
          step: of the checkpoint; by default the newest.

        Raises:
          DamagedError: if it is not what was written.
          ValueError: if there is none, or it is of another configuration.
        """
        step = self.newest() if step is None else step
        if step is None:
            raise self._none()
        record = self._record(step)
        agent = self._load(step, "agent", shapes.agent, record)
        rest = self._load(step, "rest", shapes.replace(agent=None), record)
        return rest.replace(agent=agent), dict(record.host)

    def load_agent(self, shapes: AgentState) -> tuple[AgentState, int]:
        """The newest agent that is whole, and its environment steps; the replay is not read.

        Raises:
          ValueError: if there is none, or it is of another configuration.
        """
        damages = []
        for step in reversed(self.steps()):
            try:
                agent = self._load(step, "agent", shapes, self._record(step))
            except DamagedError as error:
                damages.append(error)
                continue
            for damage in damages:
                LOG.warning("%s; the one of step %s is used", damage, f"{step:,}")
            return jax.device_put(agent), step
        raise damages[0] if damages else self._none()

    def _none(self) -> ValueError:
        return ValueError(f"{self.path.parent} has no complete checkpoint")

    def _by_row(self, leaves: Iterable[str]) -> set[str]:
        """Those of several shards, [S, ...], which have a digest for each."""
        return {x for x in leaves if self._shards > 1 and re.split(r"\W", x)[1] in BY_SHARD}

    def _record(self, step: int) -> Record:
        """What a checkpoint says of itself."""
        stored = self._restore(step, "host", ocp.args.JsonRestore())
        try:
            record = Record(**{name: stored[name] for name in Record._fields})
            sealed = stored["seal"] == record.seal() and record.env_steps == int(record.env_steps)
        except (KeyError, TypeError, ValueError):
            record, sealed = None, False
        if record is None or not sealed:
            raise self._damaged(step, "its seal is broken")
        if record.env_steps != step:
            raise self._damaged(step, f"it is that of step {record.env_steps:,}")
        if record.config != self._config:
            raise ValueError(
                f"{self.path.parent}: config.json is not the configuration that the checkpoint "
                f"{self.path.name}/{step} was made with"
            )
        return record

    def _load(self, step: int, part: str, shapes: Any, record: Record) -> Any:
        leaves, structure = jax.tree_util.tree_flatten_with_path(shapes)
        wanted = {jax.tree_util.keystr(path): shape for path, shape in leaves}
        digests = record.leaves[part]
        self._refuse_other_shapes(step, part, wanted, digests)
        stored = self._restore(step, part, _request(wanted, digests))
        for name, digest in digests.items():
            if not holds(stored[name], digest):
                raise self._damaged(step, f"{part}{name} is not what was written")
            if name.startswith(".learner") and not np.isfinite(stored[name]).all():
                raise self._damaged(step, f"{part}{name} is not finite")
        values = [_as_leaf(stored.get(name), shape) for name, shape in wanted.items()]
        return jax.tree_util.tree_unflatten(structure, values)

    def _refuse_other_shapes(self, step, part: str, wanted, digests: dict[str, Any]) -> None:
        """Before an array is read, whose size would otherwise be what a file says."""
        expected = {name: _stored(shape) for name, shape in wanted.items() if shape.size}
        lacking = set(expected) - set(digests)
        empty = bool(lacking) and lacking == {x for x in expected if x.startswith(".replay.data")}
        if set(digests) - set(expected) or (lacking and not empty):
            raise ValueError(
                f"{self.path.parent}: the checkpoint's {part} is of another configuration, engine "
                "or version of mapg-jax"
            )
        whole = [x for x in self._by_row(digests) if len(digests_in(digests[x])) == 1]
        if whole and jax.process_count() > 1:
            raise ValueError(
                f"{self.path.parent} was saved by an earlier version, which sealed the shards as "
                "one: resume it on one host first"
            )
        for name in digests:
            shape, ours = tuple(digests[name]["shape"]), expected[name].shape
            if name.startswith(".replay.data"):  # only filled slots are written
                slots = len(expected[".replay.size"].shape)  # their axis, behind that of shards
                if shape[slots : slots + 1] <= ours[slots : slots + 1]:
                    shape = (*shape[:slots], *ours[slots : slots + 1], *shape[slots + 1 :])
            if shape != ours:
                raise ValueError(
                    f"{self.path.parent}: the checkpoint holds {shape} where {ours} is expected"
                )
        try:
            with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as checkpointer:
                path = (self.path / str(step) / part).absolute()
                found = checkpointer.metadata(path).item_metadata.tree
            sizes = {name: [list(array.shape), str(array.dtype)] for name, array in found.items()}
        except Exception as error:  # Orbax and TensorStore raise many kinds
            raise self._damaged(step, _reason(error)) from error
        if sizes != {name: [digest["shape"], digest["dtype"]] for name, digest in digests.items()}:
            raise self._damaged(step, f"its arrays of {part} are of other sizes")

    def _restore(self, step: int, item: str, arguments) -> Any:
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**{item: arguments}))[item]
        except Exception as error:  # Orbax and TensorStore raise many kinds
            raise self._damaged(step, _reason(error)) from error

    def _damaged(self, step: int, reason: str) -> DamagedError:
        return DamagedError(f"the checkpoint {self.path / str(step)} is damaged ({reason})")


def _reason(error: Exception) -> str:
    return (str(error).strip() or repr(error)).splitlines()[0][:200]


def _flatten(tree: Any) -> dict[str, Any]:
    """Leaves by name, but for the empty ones, which Orbax refuses: MJX's state has some."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): _as_array(leaf) for path, leaf in leaves if leaf.size}


def _is_key(dtype) -> bool:
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def _as_array(leaf: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
    """As it is stored: in NumPy's array, but for what lies on several hosts."""
    bits = jax.random.key_data(leaf) if _is_key(leaf.dtype) else leaf
    return (
        bits if isinstance(bits, jax.Array) and not bits.is_fully_addressable else np.asarray(bits)
    )


def _stored(shape: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """Of the array that a leaf is stored as."""
    if not _is_key(shape.dtype):
        return shape
    bits = jax.eval_shape(jax.random.key_data, shape)
    return jax.ShapeDtypeStruct(bits.shape, bits.dtype, sharding=shape.sharding)


def _request(wanted: Mapping[str, jax.ShapeDtypeStruct], digests: Mapping[str, Any]) -> Any:
    """What Orbax is asked for: NumPy's arrays, or those that lie on several hosts in full size."""

    def like(name):
        whole, written = _stored(wanted[name]), digests[name]
        if whole.sharding:
            return whole
        return np.broadcast_to(np.zeros((), written["dtype"]), written["shape"])  # takes no memory

    return ocp.args.StandardRestore({name: like(name) for name in digests}, strict=False)


def _as_leaf(stored: Any, shape: jax.ShapeDtypeStruct) -> jax.Array | np.ndarray:
    """The leaf of that shape: of the replay, slots that were not filled are zeros."""
    if _is_key(shape.dtype):
        return jax.random.wrap_key_data(jnp.asarray(stored))
    if stored is not None and stored.shape == shape.shape:
        return stored if shape.sharding else np.asarray(stored, shape.dtype)
    whole = np.zeros(shape.shape, shape.dtype)
    if shape.sharding:
        return jax.make_array_from_callback(shape.shape, shape.sharding, lambda index: whole[index])
    if stored is not None:
        whole[tuple(map(slice, stored.shape))] = stored
    return whole


def _alone() -> ocp.options.MultiprocessingOptions:
    """Of this process, which waits for no other."""
    this = jax.process_index()
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    return ocp.options.MultiprocessingOptions(
        primary_host=this, active_processes={this}, barrier_sync_key_prefix=f"host_{this}"
    )
