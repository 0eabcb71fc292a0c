"""A run of several shards: one run, wherever its shards are."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest

from mapg_jax.algorithms import descent, normalization, registry, shards
from mapg_jax.runs.hosts import placed
from mapg_jax.training.config import Config, preset
from mapg_jax.training.layout import Layout
from mapg_jax.training.trainer import make_trainer

SMALL = {"environments": 16, "shards": 8, "hidden": (8, 8)}
REPLAY = {"replay_size": 640, "batch_size": 32, "learning_starts": 16, "updates_per_step": 0.25}
ROLLOUTS = {"rollout_steps": 8}
RUNS = {
    **{name: preset("smoke", name, **SMALL, **REPLAY) for name in ("mapg", "td3", "sac")},
    "naf": preset("smoke", "naf", heads=1, **SMALL, **REPLAY),  # which peak is highest can be a tie
    **{name: preset("smoke", name, **SMALL, **ROLLOUTS) for name in ("a3c", "trpo")},
    "ppo": preset("smoke", "ppo", minibatches=2, **SMALL, **ROLLOUTS),
}
"""Of every algorithm, what runs on 8 devices."""
TASKS = {
    # Observations that are all alike are 0 but for rounding once they are normalised; rounding
    # then decides on which side of its kink a ReLU is.
    "driving": preset("smoke", env="driving", env_options={"start": "anywhere"}, **SMALL, **REPLAY),
    "driving alike": preset("smoke", env="driving", normalize=False, **SMALL, **REPLAY),
    "brax": preset("smoke", env="brax:inverted_pendulum", **SMALL, **REPLAY),
    "mjx": preset("smoke", env="swimmer", engine="mjx", **SMALL, **REPLAY),
}
"""Of every kind of physics on the device; Pendulum's is the algorithms'."""
ALL = RUNS | TASKS
"""`python test_shards.py NAME,… DEVICES…` prints where each was the same."""


def over(*axes):
    """A function of one shard, over an axis in front of the arguments."""
    return lambda function: jax.vmap(function, axis_name=shards.SHARD)(*axes)


def test_statistics_over_shards_are_those_of_all_rows():
    rows = jax.random.normal(jax.random.key(0), (4, 6, 3)) * 2 + 5
    before = normalization.update(normalization.init(3), jnp.ones((5, 3)))
    found = over(rows)(lambda x: normalization.update(before, x))
    alone = normalization.update(before, rows.reshape(-1, 3))
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(x, jnp.broadcast_to(y, x.shape), rtol=1e-5)


def test_a_step_over_shards_is_that_of_the_whole_batch():
    rows = jax.random.normal(jax.random.key(0), (4, 6, 3))
    params, optimizer = jnp.array([1.0, -2.0, 0.5]), descent.adam(0.1)

    def step(rows):
        loss = lambda p: (jnp.square(rows @ p - 1).mean(), None)  # noqa: E731
        return descent.minimize(loss, optimizer, params, optimizer.init(params), jnp.float32(0.1))

    found, alone = over(rows)(step), step(rows.reshape(-1, 3))
    for shard in found.params:
        np.testing.assert_allclose(shard, alone.params, rtol=1e-6)
    np.testing.assert_allclose(found.gradient_norm, alone.gradient_norm, rtol=1e-6)
    assert optax.tree.norm(alone.params - params) > 0


def test_each_shard_has_keys_of_its_own():
    key = jax.random.key(3)
    keys = jax.vmap(lambda _: shards.own(key), axis_name=shards.SHARD)(jnp.arange(5))
    assert len({tuple(x) for x in np.asarray(jax.random.key_data(keys)).tolist()}) == 5
    assert shards.own(key) is key  # of a run of one shard


def test_every_algorithm_is_laid_over_devices():
    assert set(RUNS) == set(registry.names())


def test_starts_are_those_of_the_run_of_one_shard():
    whole = make_trainer(preset("smoke", environments=16)).jitted_init(2)
    parts = make_trainer(preset("smoke", environments=16, shards=4)).jitted_init(2)
    assert parts.env.obs.shape == (4, 4, 3)
    np.testing.assert_array_equal(parts.env.obs.reshape(16, 3), whole.env.obs)
    oracles.assert_equal(parts.agent.learner, whole.agent.learner)
    assert parts.replay.size.shape == (4,)
    nothing = make_trainer(preset("smoke", environments=16, shards=4))._by_shard(jnp.zeros((16, 0)))
    assert nothing.shape == (4, 4, 0)  # as MuJoCo's states have


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environments": 10}, "4 shards do not divide environments = 10; 8 is near"),
        ({"batch_size": 30}, "4 shards do not divide batch_size = 30; 32 is near"),
        ({"replay_size": 1_001}, "4 shards do not divide replay_size = 1,001; 1,000 is near"),
        ({"algorithm": "ppo", "minibatches": 32, "rollout_steps": 4}, "cannot be cut into 32"),
    ],
)
def test_what_is_shared_out_must_divide(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(**{"shards": 4, **changes})


def test_devices_divide_the_shards_and_are_there():
    with pytest.raises(ValueError, match="3 devices do not divide 4 shards; choose --devices 1"):
        Layout(4, 3)
    with pytest.raises(ValueError, match="there are 1 devices, not 2; choose --devices 1"):
        Layout(4, 2)


@pytest.mark.parametrize(
    ("env", "remedy"), [("gym:Pendulum-v1", "1$"), ("hopper", "1, or --engine mjx$")]
)
def test_what_the_host_steps_is_on_one_device(env, remedy):
    config = Config(env=env, engine="auto", shards=2)
    with pytest.raises(ValueError, match=f"runs on one device; choose --devices {remedy}"):
        make_trainer(config, devices=2)


@pytest.mark.parametrize(
    ("names", "devices"),
    [
        (["mapg", "a3c"], [8]),  # from replay, and from rollouts
        *(pytest.param([name], [2, 4, 8], marks=pytest.mark.slow) for name in RUNS),
        *(pytest.param([name], [2, 8], marks=pytest.mark.slow) for name in TASKS if name != "mjx"),
        pytest.param(["mjx"], [2, 8], marks=pytest.mark.mjx),
    ],
)
def test_the_same_run_on_one_device_and_several(names, devices):
    """Draws and whole numbers are the same, others within 1e-5 after two turns."""
    flags = "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0"
    environ = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, __file__, ",".join(names), *map(str, devices)],
        env=environ, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.splitlines() == [f"{name},{n}" for name in names for n in devices]


def compare_devices(names: str, *several: str) -> None:
    """In a process with 8 devices."""
    for name in names.split(","):
        alone = after_two_turns(ALL[name], 1)
        for devices in several:
            found = after_two_turns(ALL[name], int(devices))
            for path, x in alone.items():
                np.testing.assert_allclose(found[path], x, rtol=1e-5, atol=1e-5)
                if not np.issubdtype(x.dtype, np.floating):
                    np.testing.assert_array_equal(found[path], x)
            print(f"{name},{devices}")


def after_two_turns(config: Config, devices: int) -> dict[str, np.ndarray]:
    """All numbers of the state, but the environment's own, which are floats in words."""
    trainer = make_trainer(config, devices)
    state = placed(trainer.jitted_init(0), trainer.layout)
    run = trainer.jitted_run.lower(state, 0).compile()  # once, as a run does
    state = run(run(state, 1), 1)
    assert int(state.agent.learner.updates) > 0
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {
        jax.tree_util.keystr(path): np.asarray(
            jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        )
        for path, x in leaves
        if "pipeline_state" not in jax.tree_util.keystr(path)
    }


if __name__ == "__main__":
    compare_devices(*sys.argv[1:])
