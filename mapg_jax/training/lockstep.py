"""Runs in lockstep: K runs as one compiled program, M and all other numbers traced under `vmap`.

Actors are padded to the largest M; heads past a run's own are never drawn, averaged or updated. A
run alone is the plain program, without an axis in front and without padding.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mapg_jax.algorithms import registry
from mapg_jax.training.agent import hyperparameters
from mapg_jax.training.config import Config
from mapg_jax.training.evaluation import play
from mapg_jax.training.trainer import Trainer, make_trainer, run_keys


def traced_fields(config: Config) -> frozenset[str]:
    """The fields in which the runs of one program may differ: the seed, and what `Hyper` has."""
    hyper = registry.find(config.algorithm).Hyper
    return frozenset({"seed", *(field.name for field in dataclasses.fields(hyper))})


def program_key(config: Config) -> tuple:
    """All other fields: runs whose keys are equal can go in lockstep."""
    traced = traced_fields(config)
    names = (field.name for field in dataclasses.fields(config) if field.name not in traced)
    return tuple(getattr(config, name) for name in names)


class Lockstep:
    """The static part of K runs, and their compiled functions.

    States have leaves [K, ...], or those of a plain run where K = 1.
    """

    def __init__(self, configs: Sequence[Config], devices: int | None = 1):
        if len({program_key(config) for config in configs}) != 1:
            raise ValueError("runs in lockstep may differ in traced numbers alone")
        self.configs = tuple(configs)
        self.alone = len(configs) == 1
        largest = max(configs, key=lambda config: config.heads)
        if not self.alone:  # the same program for other numbers: a compiled one is used again
            numbers = traced_fields(largest) - {"heads"}
            largest = dataclasses.replace(
                largest, **{name: getattr(type(largest), name) for name in numbers}
            )
        self.trainer: Trainer = make_trainer(largest, devices)

    @property
    def bytes(self) -> int:
        """Memory of each device for the state."""
        return self.trainer.bytes * len(self.configs)

    @property
    def turn_bytes(self) -> int:
        """Memory of each device that a turn takes beside it, at least."""
        return self.trainer.turn_bytes * len(self.configs)

    def init(self) -> Any:
        """The state before the first step."""
        if self.alone:
            return self.trainer.jitted_init(self.configs[0].seed)
        state = jax.jit(jax.vmap(self.trainer.init))(self._seeds)
        hyper = _stack([hyperparameters(config) for config in self.configs])
        return state.replace(agent=state.agent.replace(hyper=hyper))

    @functools.cached_property
    def jitted_run(self):
        """(state, turns) → state; the state is donated."""
        if self.alone:
            return self.trainer.jitted_run
        return jax.jit(jax.vmap(self.trainer.run, in_axes=(0, None)), donate_argnums=0)

    @functools.cached_property
    def jitted_evaluation(self):
        """(agents, keys) → episodes; see `evaluation_keys`."""
        evaluate = functools.partial(
            play,
            self.trainer.env.env,
            self.trainer.agent,
            episodes=self.trainer.config.evaluation_episodes,
            time_limit=self.trainer.env.time_limit,
            select="uniform",
        )
        return jax.jit(evaluate if self.alone else jax.vmap(evaluate))

    def evaluation_keys(self, env_steps: int) -> jax.Array:
        """Each run's key of an evaluation: of its seed and, where starts are fresh, of the step."""
        step = env_steps if self.trainer.config.evaluation_starts == "fresh" else 0

        def key(seed):
            return jax.random.fold_in(run_keys(seed).evaluation, step)

        return key(self.configs[0].seed) if self.alone else jax.vmap(key)(self._seeds)

    def of_run(self, tree: Any, k: int) -> Any:
        """The k-th run's part of any tree of this program."""
        return tree if self.alone else jax.tree.map(lambda x: x[k], tree)

    def plain_state(self, state: Any, k: int) -> Any:
        """The k-th run's state as the run alone has it, without padding."""
        if self.alone:
            return state

        def cut(leaf, shape):
            return _as_dtype(leaf[tuple(map(slice, shape.shape))], shape.dtype)

        return jax.tree.map(cut, self.of_run(state, k), self.plain_shapes(k))

    def plain_shapes(self, k: int) -> Any:
        """Shapes of the k-th run's state alone."""
        return self._plain_shapes[self.configs[k].heads]

    def join(self, states: Iterable[tuple[int, Any]]) -> Any:
        """The state of all runs from those of some alone; heads that are padding are zeros.

        Args:
          states: by the number of the run, at least one. They are taken one at a time, so that
            memory holds all of them once; a run without one gets that of the first.
        """
        joined = None
        for k, state in states:
            if self.alone:
                return state
            joined = self._repeated(state) if joined is None else self._with(joined, state, k)
        return joined

    @functools.cached_property
    def _repeated(self):
        """(state of a run alone) → it, as that of all."""

        def repeat(state):
            copies = len(self.configs)
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (copies, *x.shape)), self._pad(state))

        return jax.jit(repeat)

    @functools.cached_property
    def _with(self):
        """(joined, state of a run alone, k) → the same memory, with that of the k-th run."""

        def put(joined, state, k):
            return jax.tree.map(lambda x, y: x.at[k].set(y), joined, self._pad(state))

        return jax.jit(put, donate_argnums=0)

    def _pad(self, state: Any) -> Any:
        def pad(leaf, shape):
            return _as_dtype(_padded(leaf, shape.shape), shape.dtype)

        return jax.tree.map(pad, state, self.trainer.shapes)

    @functools.cached_property
    def _seeds(self) -> jax.Array:
        return jnp.asarray([config.seed for config in self.configs], jnp.int32)

    @functools.cached_property
    def _plain_shapes(self) -> dict[int, Any]:
        """By number of heads."""
        heads = {config.heads for config in self.configs} - {self.trainer.config.heads}
        others = {m: dataclasses.replace(self.trainer.config, heads=m) for m in heads}
        shapes = {m: make_trainer(config).shapes for m, config in others.items()}
        return {**shapes, self.trainer.config.heads: self.trainer.shapes}


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _as_dtype(leaf: Any, dtype: Any) -> Any:
    """Heads are stored in a byte or not, by the largest M of the program."""
    return leaf if leaf.dtype == dtype else leaf.astype(dtype)


def _padded(leaf: Any, shape: Sequence[int]) -> Any:
    """The array in the first corner of one of zeros."""
    if leaf.shape == tuple(shape):
        return leaf
    return jnp.pad(leaf, [(0, n - m) for n, m in zip(shape, leaf.shape, strict=True)])
