"""Many runs in worker processes: each in its folder, skipped, resumed or reported."""

import dataclasses
import json
import pathlib
from typing import ClassVar
from unittest.mock import Mock

import oracles
import pytest

from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.train import take_up
from mapg_jax.sweeps import sweep, table, worker
from mapg_jax.sweeps.groups import Job, at_work
from mapg_jax.sweeps.launchers import Launcher, Local, Share
from mapg_jax.sweeps.pool import Worker
from mapg_jax.sweeps.worker import failure_file

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)


def files(folder: pathlib.Path) -> dict[pathlib.Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Two runs one after the other, the first of which diverges."""
    root = tmp_path_factory.mktemp("sweep")
    runs = [
        (dataclasses.replace(RUN, critic_learning_rate=1e30), root / "bad"),
        (dataclasses.replace(RUN, heads=1), root / "one"),
    ]
    told = []
    failures = sweep.run_all(runs, workers=1, on_finished=lambda f: told.append(f.path.name))
    return runs, failures, told


def test_a_run_that_fails_does_not_stop_the_others(swept):
    runs, failures, told = swept
    paths = [path for _, path in runs]
    assert failures == [
        f"{paths[0]}: numbers are no longer finite at step 16 (critic_loss); no checkpoint was due"
    ]
    assert told == ["one"]
    assert [is_finished(RunFolder.open(path)) for path in paths] == [False, True]
    score = json.loads((paths[1] / "evaluation.json").read_text())
    assert (score["episodes"], score["seed"]) == (3, 0)


def test_a_finished_run_keeps_no_replay_and_says_so(swept):
    _, (_, path) = swept[0]
    assert [p.name for p in (path / "checkpoints").glob("*/*") if p.is_dir()] == ["agent", "host"]
    before = files(path)
    with pytest.raises(ValueError, match="finished without keeping its replay"):
        take_up(path, steps=800)
    assert files(path) == before


def test_what_is_finished_is_left_alone(swept):
    runs = swept[0][1:]
    before = [files(path) for _, path in runs]
    assert sweep.run_all(runs) == []
    assert [files(path) for _, path in runs] == before


def test_a_run_that_finishes_is_no_failure(swept, monkeypatch):
    """As the worker has it that finds a run done, of which a process before it had despaired."""
    _, (config, path) = swept[0]
    failure_file(path).write_text("why\n")
    monkeypatch.setattr(worker, "finish", lambda *_: None)
    worker.work([RunFolder(path, config)], keep_replay=False)
    assert not failure_file(path).exists()


def test_a_folder_of_another_run_is_refused(swept):
    _, (config, path) = swept[0]
    with pytest.raises(ValueError, match="one holds a run of another configuration"):
        sweep.run_all([(dataclasses.replace(config, seed=7), path)])
    with pytest.raises(ValueError, match="two runs are to be written into new"):
        sweep.run_all([(config, pathlib.Path("new")), (RUN, pathlib.Path("new"))])


def test_a_run_that_was_given_more_steps_keeps_them(swept, tmp_path):
    """`mapg resume SWEEP/RUN --steps` does not shut out the rest of the sweep."""
    _, (config, path) = swept[0]
    longer = dataclasses.replace(config, steps=2 * config.steps)
    RunFolder.create(tmp_path / "longer", longer)
    assert sweep.unique_jobs([(config, tmp_path / "longer")]) == [Job(longer, tmp_path / "longer")]
    with pytest.raises(ValueError, match="another configuration"):
        sweep.unique_jobs([(dataclasses.replace(longer, steps=4 * config.steps), path)])


class CrashingTogether(Worker):
    """A worker that ends at once: a group of several crashes, and one named bad fails alone too."""

    started: ClassVar[list[tuple[list[str], int]]] = []

    def __init__(self, group, share, keep_replay, launcher):
        self.group, self.share = group, share
        self.folders = [RunFolder(job.path, job.config) for job in at_work(group)]
        self.started.append(([folder.path.name for folder in self.folders], len(group)))

    def running(self):
        return False

    def wait(self):
        pass

    stop = wait

    def crashed(self):
        return len(self.group) > 1 or self.group[0].path.name == "bad"

    def failures(self):
        return {job.path: "why" for job in self.group if self.crashed() and job.path.name != "one"}


def test_a_group_that_crashes_is_cut_into_its_runs(tmp_path, monkeypatch):
    """The run that had finished before the crash is not tried again. The others are: each in the
    program of the group, which leaves its numbers as they are, and then by itself."""
    monkeypatch.setattr(sweep, "Worker", CrashingTogether)
    monkeypatch.setattr(sweep, "POLL_SECONDS", 0.0)
    row = {"env_steps": 1.0, "return_mean": 0.0, "seconds": 1.0}
    monkeypatch.setattr(table, "read_metrics", lambda path: [row])
    names = ("one", "bad", "good")
    runs = [(dataclasses.replace(RUN, seed=k), tmp_path / n) for k, n in enumerate(names)]
    told = []
    failures = sweep.run_all(runs, group="all", on_finished=lambda f: told.append(f.path.name))
    assert CrashingTogether.started == [
        (["one", "bad", "good"], 3), (["bad"], 3), (["good"], 3), (["bad"], 1), (["good"], 1),
    ]  # fmt: skip
    assert failures == [f"{tmp_path / 'bad'}: why"]
    assert told == ["one", "good"]


def test_the_last_run_of_a_group_is_tried_again_in_its_program_first(tmp_path, monkeypatch):
    """The others are done when the sweep begins: a crash is its first one."""
    monkeypatch.setattr(sweep, "Worker", CrashingTogether)
    monkeypatch.setattr(sweep, "POLL_SECONDS", 0.0)
    monkeypatch.setattr(table, "read_metrics", lambda path: [])
    monkeypatch.setattr(CrashingTogether, "started", [])
    jobs = tuple(
        Job(dataclasses.replace(RUN, seed=k), tmp_path / n, idle=n != "bad")
        for k, n in enumerate(("one", "bad", "good"))
    )
    sweep.carry_out(sweep.Schedule([jobs], 1, False, Local()))
    assert CrashingTogether.started == [(["bad"], 3), (["bad"], 3), (["bad"], 1)]


class Refusing(Launcher):
    """Takes two workers, as a scheduler with a limit does; none of them ends unless it is asked."""

    here = True

    def __init__(self):
        self.taken: list[Mock] = []

    def shares(self, workers):
        return [Share()] * workers

    def start(self, command, log, share):
        if len(self.taken) == 2:
            raise OSError("no more than two")
        self.taken.append(Mock(running=lambda: True))
        return self.taken[-1]


def test_a_worker_that_is_refused_leaves_none_behind(tmp_path):
    limited = Refusing()
    cut = [(Job(dataclasses.replace(RUN, seed=k), tmp_path / f"s{k}"),) for k in range(4)]
    with pytest.raises(OSError, match="no more than two"):
        sweep.carry_out(sweep.Schedule(cut, 4, False, limited), progress=False)
    for taken in limited.taken:
        assert [name for name, *_ in taken.method_calls] == ["stop", "wait"]
