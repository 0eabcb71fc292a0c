"""What does not fit the memory is refused before anything is allocated."""

import dataclasses

import jax
import pytest

from mapg_jax.runs import hosts, memory
from mapg_jax.runs.train import begin
from mapg_jax.training.config import Config
from mapg_jax.training.layout import Layout
from mapg_jax.training.lockstep import Lockstep
from mapg_jax.training.state import tree_bytes


def test_what_does_not_fit_is_refused_before_anything_is_allocated(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 2_500_000_000)
    config = Config(env="humanoid")
    arrays = len(jax.live_arrays())
    message = r"needs 3\.0 GB, .*1,000,000 transitions.* 2\.5 GB are available.*--replay-size"
    with pytest.raises(ValueError, match=message):
        begin(config, tmp_path / "run")
    assert len(jax.live_arrays()) == arrays
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(memory, "available_bytes", lambda: 3_100_000_000)
    memory.prepare(config)


def test_what_takes_the_most_is_named(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 10_000_000_000)
    for changes, message in (
        (
            {"heads": 100_000_000},
            r"of which the networks with 100,000,000 heads are the most, .*--heads",
        ),
        ({"replay_size": 2**30}, r"replay of 1,073,741,824 transitions .* smaller --replay-size"),
        ({"algorithm": "a3c", "environments": 2**30}, r"choose fewer .*--environments"),
        (
            {"algorithm": "ppo", "rollout_steps": 2**30},
            r"rollouts of 1,073,741,824 steps are the most, .* fewer --rollout-steps",
        ),
        ({"updates_per_step": 1e8}, r"batches of the updates .* fewer --updates-per-step"),
    ):
        with pytest.raises(ValueError, match=message):
            memory.prepare(Config(**changes))


def test_an_accelerator_needs_its_own_shards_and_what_all_share(monkeypatch):
    config = Config(env="pendulum", shards=8, environments=8, replay_size=800_000, batch_size=64)
    program = Lockstep([config])
    one, shapes = program.trainer, program.trainer.shapes
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    shared = tree_bytes(shapes.replace(explorer=(), replay=(), env=(), running_return=()))
    apart = memory.needed_bytes(program) - shared
    assert apart > 10 * shared
    program.trainer = dataclasses.replace(one, layout=Layout(8, 8))
    vars(program.trainer)["shapes"] = shapes  # which need no devices
    assert memory.needed_bytes(program) == shared + apart // 8


def test_a_replay_is_made_to_fit(monkeypatch, caplog):
    """It fills the share of the memory that it may, to a step a shard."""
    config = Config(env="pendulum", shards=4, environments=8, replay_size=4_000_000)
    monkeypatch.setattr(memory, "available_bytes", lambda: 100_000_000)
    fitted = memory.fitting(config)
    assert fitted == dataclasses.replace(config, replay_size=fitted.replay_size)
    assert f"the replay holds {fitted.replay_size:,}" in caplog.text
    assert fitted.replay_size % 4 == 0
    needed = memory.needed_bytes(Lockstep([fitted]))
    assert needed == pytest.approx(memory.FILLED * 100e6, rel=1e-3)
    assert memory.fitting(fitted) == fitted


def test_a_replay_that_fills_more_than_its_share_is_made_to_fit_too(monkeypatch):
    config = Config(env="pendulum", replay_size=100_000)
    needed = memory.needed_bytes(Lockstep([config]))
    monkeypatch.setattr(memory, "available_bytes", lambda: needed / 0.79)
    assert memory.fitting(config) == config
    monkeypatch.setattr(memory, "available_bytes", lambda: needed / 0.9)
    memory.prepare(config)
    smaller = memory.fitting(config)
    assert smaller.replay_size < config.replay_size
    needed_now = memory.needed_bytes(Lockstep([smaller]))
    assert needed_now == pytest.approx(memory.FILLED / 0.9 * needed, rel=1e-3)


def test_of_several_hosts_the_replay_fits_the_one_with_the_least_memory(monkeypatch):
    config = Config(env="pendulum", replay_size=4_000_000)
    monkeypatch.setattr(memory, "available_bytes", lambda: 100_000_000)
    of_the_least = memory.fitting(config).replay_size
    monkeypatch.setattr(memory, "available_bytes", lambda: 200_000_000)
    gathered = iter([False, -of_the_least])  # nobody is refused
    monkeypatch.setattr(hosts, "largest", lambda ours: max(ours, next(gathered)))
    assert memory.fitting(config).replay_size == of_the_least


def test_a_replay_that_fits_stays_and_one_that_never_would_is_refused(monkeypatch):
    config = Config(env="pendulum", replay_size=1_000)
    assert memory.fitting(config) == config
    monkeypatch.setattr(memory, "available_bytes", lambda: 1_000)
    assert memory.fitting(config) == config
    with pytest.raises(ValueError, match="GB are available"):
        memory.prepare(memory.fitting(config))


def test_available_memory_is_this_machines():
    assert 10e6 < memory.available_bytes() < 1e15
