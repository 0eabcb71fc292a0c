"""Several runs as one compiled program are the separate runs."""

import dataclasses
import logging
import typing
import weakref
from typing import Literal

import jax
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms import registry
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.member import DivergedError
from mapg_jax.runs.memory import prepare
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.policy import load_policy
from mapg_jax.runs.run import Run
from mapg_jax.runs.train import begin
from mapg_jax.training import lockstep
from mapg_jax.training.config import Config, fields
from mapg_jax.training.trainer import make_trainer

CELLS = [
    dataclasses.replace(oracles.RUN, steps=400, heads=m, seed=seed, noise_scale=0.2 + 0.1 * seed)
    for m, seed in ((1, 0), (4, 1), (10, 0), (10, 1))
]
# Sums over 10 heads, and batched products, round otherwise than a run alone: some 200 updates
# later numbers agree to 1e-4 of the largest of their leaf.
CLOSE = 1e-4


def lockstep_run(program, path) -> Run:
    folders = [RunFolder.create(path / str(k), cell) for k, cell in enumerate(program.configs)]
    return Run(program, folders)


def numbers(x):
    return jax.random.key_data(x) if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else x


def assert_close(got, expected):
    def close(x, y):
        x, y = np.asarray(numbers(x)), np.asarray(numbers(y))
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        if np.issubdtype(x.dtype, np.floating):
            np.testing.assert_allclose(x, y, rtol=0, atol=CLOSE * max(1e-3, np.abs(y).max()))
        else:  # heads drawn, ends of episodes, keys and counters
            np.testing.assert_array_equal(x, y)

    jax.tree.map(close, got, expected)


@pytest.fixture(scope="module")
def program():
    return prepare(*CELLS)


@pytest.fixture(scope="module")
def whole(program, tmp_path_factory):
    """M = 1, 4, 10, two seeds, each with its noise, and the names of what was compiled."""
    compiled = []

    class Names(logging.Handler):
        def emit(self, record):
            compiled.append(record.getMessage())

    handler, logger = Names(), logging.getLogger("jax._src.interpreters.pxla")
    run = lockstep_run(program, tmp_path_factory.mktemp("lockstep"))
    logger.addHandler(handler)
    before = jax.config.jax_log_compiles
    jax.config.update("jax_log_compiles", True)
    try:
        run.go()
    finally:
        jax.config.update("jax_log_compiles", before)
        logger.removeHandler(handler)
    return [member.folder for member in run.members], compiled


def test_one_program_serves_all(whole):
    """The training loop and the evaluation are compiled once each, not once a run."""
    _, compiled = whole
    for name in ("run", "play"):
        assert sum(f"Compiling jit({name}) " in message for message in compiled) == 1, compiled


@pytest.mark.parametrize("k", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_each_is_the_run_alone(whole, k, tmp_path):
    """Heads, ends of episodes, keys and counters to the last bit, floats up to rounding."""
    folders, _ = whole
    config = dataclasses.replace(CELLS[k], checkpoint_seconds=300.0)
    run = begin(config, tmp_path / "alone")
    run.go()
    alone = run.folder
    assert_close(oracles.newest_state(folders[k]), oracles.newest_state(alone))
    rows = zip(read_metrics(folders[k].metrics), read_metrics(alone.metrics), strict=True)
    for one, other in rows:
        for name, value in other.items():
            if not name.endswith(("seconds", "per_second")):
                assert one[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name
    assert load_policy(folders[k].path).proposals(np.zeros(3)).shape == (CELLS[k].heads, 1)


def test_an_initial_state_is_that_of_the_run_alone_to_the_last_bit(program):
    state = program.init()
    for k in (0, 1, 3):
        alone = make_trainer(CELLS[k]).jitted_init(CELLS[k].seed)
        oracles.assert_equal(program.plain_state(state, k), alone)


def test_states_are_joined_one_at_a_time(program):
    """Each is what it was alone, padded with zeros; a run without one has the first's."""
    alone = [make_trainer(cell).jitted_init(cell.seed) for cell in CELLS]
    held = []

    def as_read(x):
        return x if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else np.array(x)

    def loaded():
        for k in (0, 2, 3):
            state = jax.tree.map(as_read, alone[k])
            held.append(weakref.ref(state.replay.data.observations))
            assert sum(ref() is not None for ref in held) <= 2  # this one, and that before it
            yield k, state
            del state

    joined = program.join(loaded())
    for k in (0, 2, 3):
        oracles.assert_equal(program.plain_state(joined, k), alone[k])
    padded, first = program.of_run(joined, 0), program.plain_state(joined, 0)
    for x, y in zip(jax.tree.leaves(padded.agent), jax.tree.leaves(first.agent), strict=True):
        assert np.count_nonzero(x) == np.count_nonzero(y)
    oracles.assert_equal(program.of_run(joined, 1), padded)


def test_resuming_equals_not_stopping(whole, program, tmp_path):
    """From the checkpoints of step 200, all leaves and all numbers to the last bit."""
    folders, _ = whole
    copies = [oracles.copy_run(folder, tmp_path / folder.path.name, upto=200) for folder in folders]
    run = Run(program, copies)
    run.restore()
    assert run.env_steps == 200
    run.go()
    for copy, folder in zip(copies, folders, strict=True):
        oracles.assert_equal(oracles.newest_state(copy), oracles.newest_state(folder))
        assert [row["q_mean"] for row in read_metrics(copy.metrics)] == [
            row["q_mean"] for row in read_metrics(folder.metrics)
        ]


def test_a_run_that_diverges_does_not_stop_the_others(whole, tmp_path):
    folders, _ = whole
    cells = [*CELLS[:2], dataclasses.replace(CELLS[2], critic_learning_rate=1e30), *CELLS[3:]]
    rare = [dataclasses.replace(cell, checkpoint_seconds=300.0) for cell in cells]
    run = lockstep_run(prepare(*rare), tmp_path)
    run.go()
    failures = [member.failure for member in run.members]
    assert [k for k, failure in enumerate(failures) if failure] == [2]
    assert "no longer finite at step 16" in str(failures[2])
    assert not read_metrics(run.members[2].folder.metrics)
    for k in (0, 1, 3):
        oracles.assert_equal(
            oracles.newest_state(run.members[k].folder), oracles.newest_state(folders[k])
        )


def test_it_ends_when_none_is_left(tmp_path):
    cells = [dataclasses.replace(cell, critic_learning_rate=1e30) for cell in CELLS]
    with pytest.raises(DivergedError, match="at step 16"):
        lockstep_run(prepare(*cells), tmp_path).go()


@pytest.mark.parametrize("algorithm", registry.names())
def test_what_is_traced_may_differ_and_nothing_else(algorithm):
    config = Config(algorithm=algorithm)
    for name in fields(type(config)).keys() - {"algorithm"}:
        differ = lockstep.program_key(config) != lockstep.program_key(changed(config, name))
        assert differ == (name not in lockstep.traced_fields(config)), name


def test_what_is_traced_is_the_seed_and_what_an_update_reads():
    """Fields of each algorithm; M is one of all but A3C."""
    rates = {"actor_learning_rate", "critic_learning_rate"}
    of_heads = {
        "heads", "tau", "noise_scale", "noise_scale_last", "temperature", "hold",
        "repulsion_weight", "repulsion_updates", *rates,
    }  # fmt: skip
    own = {
        "mapg": {"critic_l2", *of_heads},
        "td3": {"target_noise", "target_noise_clip", "policy_delay", *of_heads},
        "sac": {"heads", "tau", "temperature_learning_rate", "entropy_target", *rates},
        "naf": {"heads", "tau", "learning_rate", "noise_scale"},
        "a3c": {"entropy_weight", *rates},
        "ppo": {"heads", "trace", "clip", *rates},
        "trpo": {"heads", "trace", "trust_region", "damping", "critic_learning_rate"},
    }
    assert own.keys() == set(registry.names())
    for algorithm, names in own.items():
        config = Config(algorithm=algorithm)
        found = lockstep.traced_fields(config) & fields(type(config)).keys()
        assert found == {"seed", "discount"} | names


@pytest.mark.parametrize("changes", [{"batch_size": 32}, {"noise": "none"}])
def test_other_programs_are_refused(changes):
    with pytest.raises(ValueError, match="traced numbers alone"):
        lockstep.Lockstep([Config(), Config(**changes)])


def test_other_algorithms_are_refused():
    with pytest.raises(ValueError, match="traced numbers alone"):
        lockstep.Lockstep([Config(heads=1), Config(algorithm="a3c")])


def changed(config: Config, name: str) -> Config:
    """The configuration with another value of one field."""
    others = {
        "env": "hopper", "env_options": ("g=9.81",), "engine": "jax", "hidden": (8, 8),
        "time_limit": 7, "noise_scale_last": 0.3, "rollout_steps": 64, "minibatches": 16,
        "annealing_updates": 1_000, "action_layer": 1,
    }  # fmt: skip
    value = getattr(config, name)
    hint = typing.get_type_hints(type(config))[name]
    if name in others:
        value = others[name]
    elif typing.get_origin(hint) is Literal:
        value = next(choice for choice in typing.get_args(hint) if choice != value)
    elif value is None:
        value = 1.0
    elif isinstance(value, bool):
        value = not value
    else:
        value = value + 1 if isinstance(value, int) else value / 2
    return dataclasses.replace(config, **{name: value})
