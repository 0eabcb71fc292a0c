"""A run on the host: its rows, resumed bit for bit, stopped where it diverges."""

import dataclasses
import functools
import json
import os
import platform
import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.runs import disk, hosts
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder, write_json
from mapg_jax.runs.host import precise, this_host
from mapg_jax.runs.member import DivergedError, Member
from mapg_jax.runs.memory import prepare
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.run import Run
from mapg_jax.runs.train import begin, take_up
from mapg_jax.training.trainer import make_trainer


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


def test_the_folder_names_what_trained_the_run(finished_run):
    record = json.loads((finished_run.path / "config.json").read_text())
    host = record["history"][-1]["host"]
    assert set(host) == {
        "processor", "instructions", "commit", "threads", "engine", "devices", "precision",
    }  # fmt: skip
    assert (host["engine"], host["devices"]) == ("jax", "1")
    assert host["threads"] == os.environ["NPROC"]
    assert host["instructions"].startswith(platform.machine())


def test_products_of_matrices_are_precise_on_accelerators():
    trainer = make_trainer(oracles.RUN)
    with precise():
        text = trainer.jitted_run.lower(trainer.shapes, 1).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line]
    assert products and all("precision = [HIGHEST, HIGHEST]" in line for line in products)


def test_a_users_own_precision_wins():
    with jax.default_matmul_precision("tensorfloat32"), precise():
        assert this_host("jax")["precision"] == "tensorfloat32"


def test_fixed_starts_are_those_of_every_evaluation():
    fixed = dataclasses.replace(oracles.RUN, evaluation_starts="fixed")
    keys = {
        config.evaluation_starts: [prepare(config).evaluation_keys(steps) for steps in (200, 400)]
        for config in (fixed, oracles.RUN)
    }
    assert (keys["fixed"][0] == keys["fixed"][1]).all()
    assert (keys["fresh"][0] != keys["fresh"][1]).any()


# ----- resuming


@pytest.fixture(scope="module")
def resume(finished_run, tmp_path_factory):
    """resume(upto) → the folder of the run, cut off after that step and taken up; done once."""

    @functools.cache
    def resumed(upto: int) -> RunFolder:
        folder = oracles.copy_run(finished_run, tmp_path_factory.mktemp("cut") / "run", upto=upto)
        assert len(read_metrics(folder.metrics)) == 4
        run = take_up(folder.path)
        assert run.turn == upto // 4
        with pytest.raises(BlockingIOError, match="another process trains"):
            take_up(folder.path)  # locked from the look at its checkpoints on
        run.go()
        assert run.finished
        folder.lock().close()
        return folder

    return resumed


@pytest.mark.parametrize("upto", [64, 400, 0])
def test_resuming_equals_not_stopping(finished_run, resume, upto):
    """From a checkpoint between two evaluations, and at one; metrics are cut back to it.

    0: at no checkpoint at all, from the beginning. The trainer is a fresh one each time.
    """
    oracles.assert_same_run(resume(upto), finished_run)


def test_columns_that_depend_on_the_clock_say_so(finished_run, resume):
    """The same run again: all other columns are equal, to the last digit; these differ."""
    rows = zip(read_metrics(resume(0).metrics), read_metrics(finished_run.metrics), strict=True)
    for one, other in rows:
        clock = {k for k in one if k.endswith(oracles.CLOCK)}
        assert clock == {"steps_per_second", "updates_per_second", "seconds"}
        assert all(one[k] != other[k] for k in clock)


def test_seconds_go_on_where_they_stopped(finished_run, resume):
    before = read_metrics(finished_run.metrics)[1]["seconds"]
    seconds = [row["seconds"] for row in read_metrics(resume(400).metrics)]
    assert seconds == sorted(seconds)
    assert seconds[1] == before
    assert seconds[2] > before


def test_a_run_saved_without_its_replay_fills_it_before_it_learns(tmp_path, caplog):
    """And learns again when it has what the first update needed: in the turn of step 500."""
    config = dataclasses.replace(oracles.RUN, save_replay=False, steps=400, learning_starts=100)
    half = begin(config, tmp_path / "run")
    half.go()
    state = oracles.newest_state(half.folder)
    assert (int(state.replay.size), int(state.replay.position)) == (0, 0)
    assert not np.any(state.replay.data.steps.reward)
    updates = int(state.agent.learner.updates)
    take_up(half.folder.path, steps=504).go()
    a_turn = 4 * 0.5
    after = oracles.newest_state(half.folder)
    assert int(after.agent.learner.updates) == updates + 2 * a_turn  # of 500 and of 504
    assert "was saved without its replay" in caplog.text


def test_a_disk_without_room_for_the_checkpoints_is_refused(tmp_path, monkeypatch):
    program = begin(oracles.RUN, tmp_path / "run").program
    needed = disk.run_bytes(program.trainer)
    monkeypatch.setattr(disk, "free_bytes", lambda path: needed - 1)
    with pytest.raises(ValueError, match=r"the checkpoints can take .* choose .*--no-save-replay"):
        begin(oracles.RUN, tmp_path / "another")
    with pytest.raises(ValueError, match=r"the checkpoints can take .*; choose another disk"):
        take_up(tmp_path / "run")
    assert not (tmp_path / "another").exists()
    monkeypatch.setattr(disk, "free_bytes", lambda path: needed)
    begin(oracles.RUN, tmp_path / "another")


def test_a_finished_run_goes_further(finished_run, tmp_path):
    """n steps and n more equal 2 n, every leaf."""
    half = begin(dataclasses.replace(oracles.RUN, steps=400), tmp_path / "run")
    half.go()
    assert take_up(half.folder.path).finished
    further = take_up(half.folder.path, steps=800)
    assert not further.finished
    further.go()
    assert RunFolder.open(half.folder.path).config == oracles.RUN  # the new total is written down
    oracles.assert_same_run(further.folder, finished_run)


def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_serves(
    finished_run, tmp_path, caplog
):
    folder = oracles.copy_run(finished_run, tmp_path / "run")
    for file in (folder.checkpoints / "800").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    run = take_up(folder.path)
    (said,) = (record.getMessage() for record in caplog.records if "mapg" in record.name)
    assert re.search(r"800 is damaged .*; it is set aside as 800\.damaged$", said)
    assert 0 < run.turn < 200
    run.go()
    oracles.assert_same_run(folder, finished_run)


def test_hosts_that_see_different_checkpoints_go_on_with_none(finished_run, tmp_path, monkeypatch):
    """As on storage that shows one of them a new file late; nothing is set aside or removed."""
    folder = oracles.copy_run(finished_run, tmp_path / "run")
    steps = Checkpoints(folder.checkpoints).steps()
    another = steps[-2]

    def largest(ours):
        return np.maximum(ours, [another, -another]) if np.ndim(ours) else ours

    monkeypatch.setattr(hosts, "largest", largest)
    with pytest.raises(ValueError, match=r"the newest checkpoint .* is not the same \(here 800\)"):
        take_up(folder.path)
    assert Checkpoints(folder.checkpoints).steps() == steps


def test_rows_that_the_run_did_not_write_are_refused(finished_run, tmp_path):
    folder = oracles.copy_run(finished_run, tmp_path / "run", upto=400)
    text = folder.metrics.read_text()
    folder.metrics.write_text(text.replace(text.splitlines()[1].split(",")[2], "0.125"))
    with pytest.raises(ValueError, match=r"metrics\.csv is damaged: up to step 400 its rows"):
        take_up(folder.path)


def test_another_machine_is_said(finished_run, tmp_path, caplog):
    folder = oracles.copy_run(finished_run, tmp_path / "run", upto=400)
    take_up(folder.path)
    assert "bits can differ" not in caplog.text
    record = json.loads((folder.path / "config.json").read_text())
    record["history"][-1]["packages"]["jax"] = "0.1"
    record["history"][-1]["host"] = {"processor": "abacus", "devices": "4"}
    write_json(folder.path / "config.json", record)
    take_up(folder.path)
    assert re.search(r"run was trained by jax 0\.1, here .*; processor abacus, here ", caplog.text)
    assert "devices 4, here 1: bits can differ" in caplog.text


@pytest.mark.slow
def test_a_member_of_a_group_goes_on_in_the_program_of_all(tmp_path):
    """One of three is cut off after the others ended: it ends bit for bit as with them."""
    configs = [dataclasses.replace(oracles.RUN, seed=seed, heads=2) for seed in (0, 1, 2)]

    def go(folders, idle=()):
        run = Run(prepare(*configs), folders, idle=idle)
        run.restore()
        run.go()

    whole = [RunFolder.create(tmp_path / f"whole-{c.seed}", c) for c in configs]
    go(whole)
    cut = [oracles.copy_run(f, tmp_path / f"cut-{f.config.seed}") for f in whole]
    for checkpoint in (cut[1].checkpoints).iterdir():
        if int(checkpoint.name) > 400:
            shutil.rmtree(checkpoint)
    before = [oracles.newest_state(folder) for folder in whole]
    go(cut, idle=(0, 2))
    for folder, state in zip(cut, before, strict=True):
        oracles.assert_equal(oracles.newest_state(folder), state)


# ----- divergence


def test_divergence_stops_at_its_step(tmp_path):
    """A rate of 1e30: the second update of step 16 meets parameters near 1e30, and overflows."""
    run = begin(dataclasses.replace(oracles.RUN, critic_learning_rate=1e30), tmp_path / "run")
    with pytest.raises(DivergedError, match=r"finite at step 16 \(.+\); no checkpoint was due"):
        run.go()
    assert read_metrics(run.folder.metrics) == []
    assert Checkpoints(run.folder.checkpoints).newest() is None
    assert Checkpoints(run.folder.path / "diverged").newest() == run.env_steps


def test_divergence_keeps_the_last_checkpoint(finished_run, tmp_path):
    folder = oracles.copy_run(finished_run, tmp_path / "run", upto=64)
    good = oracles.newest_state(folder)
    hyper = good.agent.hyper.replace(critic_learning_rate=jnp.float32(1e30))
    bad = good.replace(agent=good.agent.replace(hyper=hyper))
    shutil.rmtree(folder.checkpoints / "64")
    member = Member(folder)
    member.begin_to_save(bad, 0.0)
    member.checkpoints.wait()
    with pytest.raises(DivergedError, match=r"at step 68 \(.+\); the checkpoint at step 64 stays"):
        take_up(folder.path).go()
    oracles.assert_equal(oracles.newest_state(folder), bad)
