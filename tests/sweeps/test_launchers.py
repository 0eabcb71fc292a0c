"""Where workers run: a sweep ends alike, whoever starts them."""

import dataclasses
import importlib
import pathlib
import signal
import time

import oracles
import pytest

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps import launchers, sweep
from mapg_jax.sweeps.launchers import Local, launcher
from mapg_jax.sweeps.pool import Worker

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)
LONG = dataclasses.replace(RUN, steps=40_000, evaluate_every=4_000, checkpoint_seconds=1e-3)
pytestmark = pytest.mark.usefixtures("quick_compilation")


def carry_out(launched_by, root: pathlib.Path, run=RUN, seeds=(0, 1)) -> list[RunFolder]:
    """A sweep over seeds, a group each."""
    runs = [(dataclasses.replace(run, seed=seed), root / f"s{seed}") for seed in seeds]
    schedule = sweep.make_schedule(runs, group="one", keep_replay=True, launcher=launched_by)
    assert sweep.carry_out(schedule, progress=False) == []
    return [RunFolder(path, config) for config, path in runs]


@pytest.fixture(scope="module")
def local(tmp_path_factory, quick_compilation):
    return carry_out(Local(), tmp_path_factory.mktemp("local"))


def test_each_worker_sees_one_gpu(monkeypatch):
    monkeypatch.setattr(launchers, "visible_gpus", lambda: [2, 5])
    shares = Local().shares(3)
    assert [share.gpu for share in shares] == [2, 5, 2]
    seen = [launchers._one_gpu(share) for share in shares]
    assert seen[1] == {"CUDA_VISIBLE_DEVICES": "5"}
    monkeypatch.setattr(launchers, "visible_gpus", lambda: [2])
    assert launchers._one_gpu(Local().shares(1)[0]) == {}  # as this process sees it


def test_what_is_wrong_is_said(monkeypatch):
    with pytest.raises(ValueError, match="the launcher local has no options"):
        launcher("local", ["a=1"])
    with pytest.raises(ValueError, match="written name=value, got 'partition'"):
        launcher("slurm", ["partition"])
    with pytest.raises(ValueError, match=r"Slurm cannot be used as asked: .*nonsense"):
        launcher("slurm", ["cluster=local", "nonsense=1"])

    def missing(name):
        raise ImportError("no", name="ray")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ValueError, match=r"\(ray\); pip install 'mapg-jax\[ray\]'"):
        launcher("ray")


def test_jobs_of_submitit_end_like_workers_of_this_machine(local, tmp_path):
    jobs = carry_out(launcher("slurm", ["cluster=local"]), tmp_path)
    for ours, theirs in zip(jobs, local, strict=True):
        oracles.assert_same_run(ours, theirs)


def test_a_job_that_is_asked_to_end_saves(tmp_path):
    started_by = launcher("slurm", ["cluster=local"])
    (share,) = started_by.shares(1)
    worker = Worker((sweep.Job(LONG, tmp_path / "run"),), share, True, started_by)
    while not (tmp_path / "run" / "metrics.csv").exists():
        assert worker.running()
        time.sleep(0.1)
    worker.stop()
    worker.wait()
    assert worker.crashed()  # it has not finished
    assert "128" in worker.failures()[tmp_path / "run"] or signal.SIGTERM
    assert list((tmp_path / "run" / "checkpoints").iterdir())
