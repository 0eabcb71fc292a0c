"""Every registered algorithm keeps the contract, and learns what tiny tasks are worth."""

import dataclasses

import jax
import oracles
import pytest

from mapg_jax.algorithms import registry
from mapg_jax.runs import contract
from mapg_jax.runs.train import begin
from mapg_jax.sweeps.sweep import make_schedule

LEARNS = {
    "mapg": {
        "hidden": (16, 16), "batch_size": 32, "replay_size": 2_000, "updates_per_step": 1.0,
        "tau": 0.05, "critic_l2": 0.0, "critic_learning_rate": 1e-2, "actor_learning_rate": 1e-2,
        "noise": "gaussian", "noise_scale": 0.5,
    },
    "td3": {
        "hidden": (16, 16), "batch_size": 32, "replay_size": 2_000, "updates_per_step": 1.0,
        "tau": 0.05, "critic_learning_rate": 1e-2, "actor_learning_rate": 1e-2, "noise_scale": 0.5,
    },
    "sac": {
        "hidden": (16, 16), "batch_size": 32, "replay_size": 2_000, "updates_per_step": 1.0,
        "tau": 0.05, "critic_learning_rate": 1e-2, "actor_learning_rate": 1e-2,
        "temperature_learning_rate": 0.05,
    },
    "naf": {
        "hidden": (16, 16), "batch_size": 32, "replay_size": 2_000, "updates_per_step": 1.0,
        "tau": 0.05, "learning_rate": 1e-2, "noise_scale": 0.5,
    },
    "ppo": {
        "hidden": (16, 16), "environments": 16, "minibatches": 4, "epochs": 4,
        "critic_learning_rate": 3e-3,
    },
    "trpo": {"hidden": (16, 16), "environments": 16, "critic_learning_rate": 3e-3},
    "a3c": {"hidden": (16, 16), "environments": 16, "actor_learning_rate": 3e-3},
}  # fmt: skip
"""By algorithm, the options by which it learns tiny tasks in some hundred turns."""


def test_every_algorithm_is_listed():
    assert set(LEARNS) == set(registry.names())


QUICK = ("mapg", "a3c", "ppo")
"""One or two of each kind; what it takes to compile the others is left to `make test-slow`."""
each = pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in LEARNS],
)


@pytest.mark.parametrize("name", LEARNS)
@pytest.mark.parametrize(
    "check", [contract.check_shapes, contract.check_lowering, contract.check_shards]
)
def test_an_algorithm_keeps_the_contract(name, check):
    check(contract.tiny(name))


@each
def test_an_algorithm_resumes_bit_for_bit(name):
    contract.check_resuming(contract.tiny(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNS)
def test_runs_of_an_algorithm_go_in_lockstep(name):
    """A turn of PPO is 40 steps of Adam; TRPO's step has four times the error of the one before."""
    turns = {"ppo": 5, "trpo": 2}.get(name, 20)
    contract.check_lockstep(contract.tiny(name), turns)


@each
def test_an_algorithm_learns_known_values(name):
    """Reward 0, then 1, then the end, at γ = ½: worth ½, then 1."""
    config = contract.tiny(name, discount=0.5, **LEARNS[name])
    contract.check_values(config, oracles.TwoSteps(), 10, 400, {0.0: 0.5, 1.0: 1.0})


def test_what_breaks_the_contract_is_named(monkeypatch, tmp_path):
    """An update that changes a type, one that differs by shard, and an action that lacks a row."""
    config, mapg = contract.tiny("mapg"), registry.find("mapg")
    update = mapg.update

    def retyped(self, learner, hyper, batch, key):
        learner, metrics = update(self, learner, hyper, batch, key)
        return learner.replace(updates=learner.updates * 1.0), metrics

    monkeypatch.setattr(mapg, "update", retyped)
    with pytest.raises(TypeError, match="updates"):
        contract.check_shapes(config)

    def of_its_shard(self, learner, hyper, batch, key):
        learner, metrics = update(self, learner, hyper, batch, key)
        return jax.tree.map(
            lambda x: x + (0 * batch.reward.mean()).astype(x.dtype), learner
        ), metrics

    monkeypatch.setattr(mapg, "update", of_its_shard)
    with pytest.raises(AssertionError, match=r"mapg does not learn in 2 shards; choose --shards 1"):
        contract.check_shards(config)
    sharded, path = dataclasses.replace(config, shards=2), tmp_path / "run"
    for refuses in (lambda: begin(sharded, path), lambda: make_schedule([(sharded, path)])):
        with pytest.raises(ValueError, match="mapg does not learn in 2 shards"):
            refuses()
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(mapg, "selects", ("uniform", "none such"))
    monkeypatch.setattr(mapg, "update", update)
    monkeypatch.setattr(mapg, "act", lambda self, *x, select: x[2][..., :2])
    with pytest.raises(AssertionError, match="act, uniform has float32"):
        contract.check_shapes(config)
