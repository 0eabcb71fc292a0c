"""What an algorithm promises, checked: to be called in the tests of one's own (docs/extending.md).

Each check raises AssertionError with what is wrong. They take seconds, on tiny networks.
"""

import dataclasses
import functools
import pathlib
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.training.agent import make_agent
from mapg_jax.training.config import Config, config_type, fields, preset
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.trainer import Trainer, make_trainer

CLOSE = 1e-4
"""Of a leaf's largest number: batched and padded programs add in another order."""
TINY = {
    "heads": 3,
    "environments": 4,
    "hidden": (8, 8),
    "replay_size": 200,
    "batch_size": 8,
    "learning_starts": 16,
    "rollout_steps": 4,
    "minibatches": 4,
    "critic_steps": 5,
    "time_limit": 25,
    "steps": 400,
    "evaluate_every": 200,
    "evaluation_episodes": 2,
    "final_episodes": 2,
}
"""Numbers of a run that compiles and goes fast; an algorithm takes those that it has."""


def tiny(name: str, **options: Any) -> Config:
    """A tiny run of Pendulum with that algorithm."""
    known = fields(config_type(name))
    numbers = {field: value for field, value in TINY.items() if field in known}
    return preset("paper", name, **{**numbers, **options})


def check_algorithm(name: str, **options: Any) -> None:
    """All checks but that of the values, which depend on how long one learns; see `check_values`.

    Args:
      name: under which the algorithm is registered.
      **options: of its runs, if the tiny ones do not suit it.
    """
    config = tiny(name, **options)
    check_shapes(config)
    check_resuming(config)
    check_lockstep(config)
    check_lowering(config)
    check_shards(config)


def check_shapes(config: Config) -> None:
    """Shapes and types of all that it gives; an update leaves the tree of its learner as it was."""
    trainer = make_trainer(config)
    algorithm, state = trainer.agent.algorithm, trainer.shapes
    learner, hyper, key = state.agent.learner, state.agent.hyper, state.key
    n, size = config.environments, trainer.env.action_size
    floats = jnp.float32
    seen = jax.ShapeDtypeStruct((n, trainer.env.observation_size), floats)

    assert hyper.heads.dtype == jnp.int32, "hyper.heads must be int32"
    assert learner.updates.dtype == jnp.int32, "the learner must count its updates, as int32"
    explored = jax.eval_shape(algorithm.explore, learner, hyper, state.explorer, seen, key)
    _same("explore: action", explored.action, jax.ShapeDtypeStruct((n, size), floats))
    _same("explore: explorer", explored.explorer, state.explorer)
    for leaf in jax.tree.leaves((explored.extra, explored.explorer)):
        assert leaf.shape[:1] == (n,), f"explore: a leaf has no axis of {n} environments in front"
    proposals, values = jax.eval_shape(algorithm.proposals, learner, hyper, seen)
    _same("proposals", proposals, jax.ShapeDtypeStruct((n, config.heads, size), floats))
    _same("values", values, jax.ShapeDtypeStruct((n, config.heads), floats))
    q_values = jax.eval_shape(algorithm.q_values, learner, hyper, seen, proposals)
    _same("q_values", q_values, values)
    for select in algorithm.selects:
        act = functools.partial(algorithm.act, select=select)
        action = jax.eval_shape(act, learner, hyper, seen, key)
        _same(f"act, {select}", action, jax.ShapeDtypeStruct((n, size), floats))
    after = jax.eval_shape(trainer.turn, state)
    _same("a turn", after, state)
    for metric, value in after.totals.update_metrics._asdict().items():
        _same(f"metric {metric}", value, jax.ShapeDtypeStruct((), floats))


def check_resuming(config: Config) -> None:
    """A state that is saved and loaded goes on as if it had not been, bit for bit."""
    trainer, turns = make_trainer(config), 20
    half = trainer.jitted_run(trainer.jitted_init(config.seed), turns)
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(pathlib.Path(folder), kept=1)
        checkpoints.save(half, {})
        loaded, _ = checkpoints.load(trainer.shapes)
    _equal("a resumed run", trainer.jitted_run(loaded, turns), trainer.jitted_run(half, turns))


def check_lockstep(config: Config, turns: int = 20) -> None:
    """A run in one program with another seed and more heads is the run alone, up to rounding.

    Args:
      config: of the run alone.
      turns: of training; rounding errors grow with the steps of the optimiser that a turn makes.
    """
    more = dataclasses.replace(config, seed=config.seed + 1)
    fewer = "heads" in fields(type(config))
    less = dataclasses.replace(config, heads=1) if fewer else config  # padded, if it can be
    program, trainer = Lockstep([less, more]), make_trainer(less)
    together = program.jitted_run(program.init(), turns)
    alone = trainer.jitted_run(trainer.jitted_init(less.seed), turns)
    _equal("a run in lockstep", program.plain_state(together, 0), alone, CLOSE)


def check_lowering(config: Config) -> None:
    """The training chunk lowers for accelerators, without one at hand."""
    trainer = make_trainer(config)
    traced = trainer.jitted_run.trace(trainer.shapes, jax.ShapeDtypeStruct((), jnp.int32))
    for platform in ("cuda", "tpu"):
        traced.lower(lowering_platforms=(platform,))


def check_shards(config: Config) -> None:
    """A run of two shards learns one and the same in both; it is traced, not compiled."""
    trainer = make_trainer(dataclasses.replace(config, shards=2))
    try:
        trainer.refuse_unshared()
    except ValueError as error:
        raise AssertionError(str(error)) from error


def check_values(
    config: Config, env: envs.Env, time_limit: int, turns: int, values: dict[float, float]
) -> None:
    """A trained critic knows the values of a task whose values are known, within 0.1.

    Args:
      config: of the run; its environment does not count.
      env: observes one number.
      time_limit: steps of an episode.
      turns: of training.
      values: by observation, the value of its proposals.
    """
    agent = make_agent(config, env.action_size)
    trainer = Trainer(config, envs.with_episodes(env, time_limit), agent)
    state = trainer.jitted_run(trainer.jitted_init(config.seed), turns)
    for observation, value in values.items():
        _, found = trainer.agent.proposals(state.agent, jnp.full((1, 1), observation))
        distance = float(jnp.abs(found - value).max())
        assert distance < 0.1, f"at {observation} the values are {found}, not {value}"


def _same(what: str, found: Any, wanted: Any) -> None:
    """Equal trees of shapes and types."""
    one, other = jax.tree.structure(found), jax.tree.structure(wanted)
    assert one == other, f"{what} is {one}, not {other}"
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        same = (x.shape, x.dtype) == (y.shape, y.dtype)
        assert same, f"{what} has {x.dtype}{list(x.shape)}, not {y.dtype}{list(y.shape)}"


def _equal(what: str, found: Any, wanted: Any, close: float = 0.0) -> None:
    """Whole numbers and keys to the last bit, others within `close` of a leaf's largest number.

    Where physics travels as bits, rounding differs in them; what it shows is in the observations.
    """
    leaves = jax.tree_util.tree_leaves_with_path(found)
    for (path, x), y in zip(leaves, jax.tree.leaves(wanted), strict=True):
        if close and jax.tree_util.keystr(path).startswith(".env.pipeline_state"):
            continue
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        x, y = np.asarray(x), np.asarray(y)
        bound = close * max(1e-3, np.abs(y).max(initial=0)) if x.dtype.kind == "f" else 0
        same = np.array_equal(x, y, equal_nan=x.dtype.kind == "f")
        assert same or np.abs(x - y).max() <= bound, (
            f"{what} differs in {jax.tree_util.keystr(path)}"
        )
