"""A run on the host: written down before it starts, resumed bit for bit, stopped honestly."""

import csv
import dataclasses
import json
import os
import pathlib
import shutil
import signal
import time

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from mapg_jax.runs.runner import resume, start

import mapg_jax
from mapg_jax.runs import runner, signals
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.member import DivergedError
from mapg_jax.runs.metrics import Progress, read_metrics
from mapg_jax.runs.signals import StoppedError
from mapg_jax.training.config import PRESETS
from mapg_jax.training.trainer import make_trainer

CLOCK = ("seconds", "per_second")


def copy(run: RunFolder, path: pathlib.Path, upto: int | None = None) -> RunFolder:
    """A copy, without the checkpoints after a step."""
    shutil.copytree(run.path, path)
    folder = RunFolder.open(path)
    for checkpoint in folder.checkpoints.iterdir():
        if upto is not None and int(checkpoint.name) > upto:
            shutil.rmtree(checkpoint)
    return folder


def newest_state(folder: RunFolder):
    return Checkpoints(folder.checkpoints).load(make_trainer(folder.config).shapes)[0]


def metrics_without_clock(folder: RunFolder):
    """The text of every column that does not depend on the clock."""
    with folder.metrics.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if not k.endswith(CLOCK)} for row in rows]


def assert_same_run(folder: RunFolder, expected: RunFolder):
    oracles.assert_equal(newest_state(folder), newest_state(expected))
    assert metrics_without_clock(folder) == metrics_without_clock(expected)


# ----- what a run leaves


def test_the_folder_is_there_before_anything_is_compiled(tmp_path):
    run = start(oracles.RUN, tmp_path / "run")
    assert RunFolder.open(tmp_path / "run").config == oracles.RUN
    assert not {"jitted_init", "jitted_run"} & set(vars(run.trainer))
    assert not run.folder.metrics.exists()


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_survive_the_folder(preset, tmp_path):
    config = dataclasses.replace(
        PRESETS[preset], env_options=("g=9.81", "name=a"), max_gradient_norm=0.1, time_limit=3
    )
    folder = RunFolder.create(tmp_path / "new" / "run", config)
    assert RunFolder.open(folder.path).config == config
    record = json.loads((folder.path / "config.json").read_text())
    (process,) = record["history"]
    assert process["packages"]["jax"] == jax.__version__
    assert [path.name for path in folder.path.iterdir()] == ["config.json"]


def test_folders_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = dataclasses.replace(oracles.RUN, env="brax:ant")
    names = [RunFolder.create(None, config).path for _ in range(2)]
    assert names == [pathlib.Path("runs/brax-ant-m3-1"), pathlib.Path("runs/brax-ant-m3-2")]


def test_metrics_have_a_row_an_evaluation(finished_run):
    rows = read_metrics(finished_run.metrics)
    assert [row["env_steps"] for row in rows] == [200, 400, 600, 800]
    # Learning starts in the turn that reaches step 16: half an update for each of its 4 steps.
    assert [row["updates"] for row in rows] == [(steps - 12) / 2 for steps in (200, 400, 600, 800)]
    # Episodes of 50 steps, 4 side by side: those of training end as an evaluation comes.
    assert all(row["episodes"] == 2 and row["episode_length"] == 50 for row in rows)
    assert all(row["training_episodes"] == 4 for row in rows)
    assert all(row["training_episode_length"] == 50 for row in rows)
    for row in rows:
        assert all(np.isfinite(value) for value in row.values())
        assert -1000 < row["return_mean"] < 0
        assert -1000 < row["training_return"] < 0
        assert 0 < row["spread"] < 1
        assert row["q_gap"] > 0


def test_columns_that_depend_on_the_clock_say_so(finished_run, tmp_path):
    """The same run again: all other columns are equal, to the last digit; these differ."""
    again = mapg_jax.train(oracles.RUN, tmp_path / "again")
    assert_same_run(again, finished_run)
    rows = zip(read_metrics(again.metrics), read_metrics(finished_run.metrics), strict=True)
    for one, other in rows:
        clock = {k for k in one if k.endswith(CLOCK)}
        assert clock == {"steps_per_second", "updates_per_second", "seconds"}
        assert all(one[k] != other[k] for k in clock)


def test_a_run_folder_holds_data_only(finished_run):
    kinds = {path.suffix for path in finished_run.path.rglob("*") if path.is_file()}
    assert not kinds & {".py", ".pkl", ".pickle", ".npy", ".npz", ".so", ".sh"}
    assert (finished_run.path / "config.json").is_file()
    names = {path.name.split(".")[0] for path in finished_run.path.iterdir()} - {""}  # .lock
    assert names == {"config", "metrics", "checkpoints", "events"}


# ----- resuming


@pytest.mark.parametrize("upto", [64, 400, None])
def test_resuming_equals_not_stopping(finished_run, tmp_path, upto):
    """From a checkpoint between two evaluations, and at one; metrics are cut back to it.

    None: at no checkpoint at all, from the beginning. The trainer is a fresh one each time.
    """
    folder = copy(finished_run, tmp_path / "run", upto=0 if upto is None else upto)
    assert len(read_metrics(folder.metrics)) == 4
    run = resume(folder.path)
    assert run.turn == (upto or 0) // 4
    run.go()
    assert run.finished
    assert_same_run(folder, finished_run)


def test_a_finished_run_goes_further(finished_run, tmp_path):
    """n steps and n more equal 2 n, every leaf."""
    folder = mapg_jax.train(dataclasses.replace(oracles.RUN, steps=400), tmp_path / "run")
    assert resume(folder.path).finished
    further = resume(folder.path, steps=800)
    assert not further.finished
    further.go()
    assert RunFolder.open(folder.path).config == oracles.RUN  # the new total is written down
    assert_same_run(folder, finished_run)


def test_a_damaged_checkpoint_is_refused_and_the_one_before_serves(finished_run, tmp_path):
    folder = copy(finished_run, tmp_path / "run")
    for file in (folder.checkpoints / "800").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    with pytest.raises(ValueError, match=r"800 is damaged .*remove that folder"):
        resume(folder.path)
    shutil.rmtree(folder.checkpoints / "800")
    run = resume(folder.path)
    assert 0 < run.turn < 200
    run.go()
    assert_same_run(folder, finished_run)


def test_seconds_go_on_where_they_stopped(finished_run, tmp_path):
    folder = copy(finished_run, tmp_path / "run", upto=400)
    before = read_metrics(folder.metrics)[1]["seconds"]
    resume(folder.path).go()
    seconds = [row["seconds"] for row in read_metrics(folder.metrics)]
    assert seconds == sorted(seconds)
    assert seconds[1] == before
    assert seconds[2] > before


# ----- divergence


def test_divergence_stops_at_its_step(tmp_path):
    """A rate of 1e30: the second update of step 16 meets parameters near 1e30, and overflows."""
    config = dataclasses.replace(oracles.RUN, critic_learning_rate=1e30)
    with pytest.raises(DivergedError, match="no longer finite at step 16; no checkpoint was due"):
        mapg_jax.train(config, tmp_path / "run")
    folder = RunFolder.open(tmp_path / "run")
    assert read_metrics(folder.metrics) == []
    assert Checkpoints(folder.checkpoints).newest() is None


def test_divergence_keeps_the_last_checkpoint(finished_run, tmp_path):
    folder = copy(finished_run, tmp_path / "run", upto=64)
    good = newest_state(folder)
    hyper = good.agent.hyper.replace(critic_learning_rate=jnp.float32(1e30))
    bad = good.replace(agent=good.agent.replace(hyper=hyper))
    shutil.rmtree(folder.checkpoints / "64")
    Checkpoints(folder.checkpoints, kept=2).save(bad, {"seconds": 0.0})
    with pytest.raises(DivergedError, match="at step 68; the checkpoint at step 64 stays"):
        resume(folder.path).go()
    oracles.assert_equal(newest_state(folder), bad)


# ----- refusals


def test_what_does_not_fit_is_refused_before_anything_is_allocated(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "available_bytes", lambda: 2_000_000_000)
    config = dataclasses.replace(PRESETS["paper"], env="humanoid")
    arrays = len(jax.live_arrays())
    message = r"needs 2\.9 GB, .*1,000,000 transitions.* 2\.0 GB are available.*--replay-size"
    with pytest.raises(ValueError, match=message):
        start(config, tmp_path / "run")
    assert len(jax.live_arrays()) == arrays
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(runner, "available_bytes", lambda: 3_000_000_000)
    runner.prepare(config)


def test_available_memory_is_this_machines():
    assert 10e6 < runner.available_bytes() < 1e15


# ----- signals


@pytest.fixture
def interrupts():
    """Sets what SIGINT does, whatever the tests were started with, and sets it back."""
    before = signal.getsignal(signal.SIGINT)
    yield lambda handler: signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGINT, before)


def test_a_second_signal_acts_as_usual(interrupts):
    interrupts(signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), signals.caught_signals() as caught:
        os.kill(os.getpid(), signal.SIGINT)
        assert caught == [signal.SIGINT]
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_signal_stays_ignored(interrupts):
    interrupts(signal.SIG_IGN)
    with signals.caught_signals() as caught:
        os.kill(os.getpid(), signal.SIGINT)
    assert caught == []
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_signal_saves_and_resuming_equals_not_stopping(finished_run, tmp_path, monkeypatch):
    path = tmp_path / "run"
    run = start(dataclasses.replace(oracles.RUN, checkpoint_seconds=1e6), path)
    with monkeypatch.context() as patch:
        kill = lambda *_: os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
        patch.setattr(Progress, "evaluated", kill)
        with pytest.raises(StoppedError, match=f"by SIGTERM; go on with: mapg resume {path}"):
            run.go()
    assert [checkpoint.name for checkpoint in (path / "checkpoints").iterdir()] == ["200"]
    run = resume(path)
    run.go()
    assert_same_run(run.folder, finished_run)
