"""Where workers run: a sweep ends alike, whoever starts them."""

import dataclasses
import importlib
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import oracles
import pytest
import submitit

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps import launchers, search, sweep
from mapg_jax.sweeps import task as task_module
from mapg_jax.sweeps import worker as worker_module
from mapg_jax.sweeps.launchers import Local, launcher
from mapg_jax.sweeps.pool import Worker
from mapg_jax.sweeps.slurm import Job, Queue
from mapg_jax.sweeps.task import Task

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)
LONG = dataclasses.replace(RUN, steps=40_000, evaluate_every=4_000, checkpoint_seconds=1e-3)


def carry_out(launched_by, root: pathlib.Path, run=RUN, seeds=(0, 1)) -> list[RunFolder]:
    """A sweep over seeds, a group each."""
    runs = [(dataclasses.replace(run, seed=seed), root / f"s{seed}") for seed in seeds]
    schedule = sweep.make_schedule(runs, group="one", keep_replay=True, launcher=launched_by)
    assert sweep.carry_out(schedule, progress=False) == []
    return [RunFolder(path, config) for config, path in runs]


UNTIL_ASKED = [sys.executable, "-c", "import sys; sys.stdin.read(); print('saved')"]


def under_way(folder: pathlib.Path) -> tuple[Task, threading.Thread]:
    """A task whose worker waits for its input to end."""
    task = Task(UNTIL_ASKED, folder / "worker.log", {})
    thread = threading.Thread(target=task)
    thread.start()
    while task._process is None:
        time.sleep(0.01)
    return task, thread


def lines(folder: pathlib.Path) -> list[str]:
    """Of the log: where a task was started, and what its worker says."""
    return (folder / "worker.log").read_text().splitlines()


def assert_as_here(found: list[RunFolder], root: pathlib.Path) -> None:
    """Runs of seeds 0, 1, …, to the last bit as workers of this machine make them."""
    here = carry_out(Local(), root, found[0].config, range(len(found)))
    for ours, theirs in zip(found, here, strict=True):
        oracles.assert_same_run(ours, theirs)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    return carry_out(Local(), tmp_path_factory.mktemp("local"))


def test_each_worker_sees_one_gpu(monkeypatch):
    monkeypatch.setattr(launchers.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(launchers.jax, "local_device_count", lambda: 2)
    for visible, names in (("", "01"), ("2, 5", "25"), ("GPU-a,GPU-b", ["GPU-a", "GPU-b"])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        shares = Local().shares(3)
        assert [share.gpu for share in shares] == [*names, names[0]]
        assert launchers._one_gpu(shares[1]) == {"CUDA_VISIBLE_DEVICES": names[1]}
    monkeypatch.setattr(launchers.jax, "local_device_count", lambda: 1)
    assert launchers._one_gpu(Local().shares(1)[0]) == {}  # as this process sees it


def test_the_memory_of_a_gpu_is_left_to_workers(monkeypatch):
    monkeypatch.setenv(launchers.PREALLOCATE, "true")
    launcher("local")
    assert os.environ[launchers.PREALLOCATE] == "false"
    assert launchers.environment()[launchers.PREALLOCATE] == "true"


def test_workers_of_a_checkout_need_no_installation():
    """Whatever folder they are started in, and by a Python that knows no packages."""
    find = "import importlib.util as u; print(u.find_spec('mapg_jax').origin)"
    found = subprocess.run(
        [sys.executable, "-P", "-S", "-c", find],
        env={**os.environ, **launchers.environment()},
        capture_output=True,
        text=True,
        check=True,
    )
    assert pathlib.Path(found.stdout.strip()) == launchers.CHECKOUT / "mapg_jax/__init__.py"


def test_what_is_wrong_is_said(monkeypatch):
    with pytest.raises(ValueError, match="the launcher local has no options"):
        launcher("local", ["a=1"])
    with pytest.raises(ValueError, match="written name=value, got 'partition'"):
        launcher("slurm", ["partition"])
    with pytest.raises(ValueError, match="the launcher's option a is given twice; leave one out"):
        launcher("slurm", ["a=1", "a=2"])
    with pytest.raises(ValueError, match="written name=value, got 1"):
        launcher("slurm", [1])
    with pytest.raises(ValueError, match="a launcher is local, slurm or ray, got 'foo'"):
        launcher("foo")

    def missing(name):
        raise ImportError("no", name="ray")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ValueError, match=r"\(ray\); pip install 'mapg-jax\[ray\]'"):
        launcher("ray")


@pytest.mark.parametrize(
    ("option", "refusal"),
    [
        ("nonsense=1", r"Slurm cannot be used as asked: .*nonsense"),
        ("timeout_min=abc", "timeout_min must be a whole number of at least 1, got 'abc'"),
        ("timeout_min=1.5", "timeout_min must be a whole number of at least 1, got 1.5"),
        ("timeout_min=-5", "timeout_min must be a whole number of at least 1, got -5"),
        ("timeout_min=²", "timeout_min must be a whole number of at least 1, got '²'"),
        ("cpus_per_task=x", "cpus_per_task must be a whole number of at least 1, got 'x'"),
        ("mem_gb=0", "mem_gb must be a number above 0, got 0"),
        ("nodes=2", "a group is one task on one node; leave nodes out"),
        ("slurm_nodes=2", "a group is one task on one node; leave nodes out"),
        ("slurm_ntasks_per_node=2", "a group is one task on one node; leave ntasks_per_node out"),
        ("slurm_timeout_min=-5", "timeout_min must be a whole number of at least 1, got -5"),
        ("slurm_time=-5", "leave slurm_time out; give timeout_min, in minutes"),
        ("timeout_min=1:30", "timeout_min must be a whole number of at least 1, got '1:30'"),
        ("gpus_per_node=a100:x", "Slurm cannot be used as asked: .*gpus_per_node"),
        ("slurm_mem=x", "leave slurm_mem out; give mem_gb"),
        ("stderr_to_stdout=maybe", "Slurm cannot be used as asked: .*stderr_to_stdout"),
    ],
)
def test_a_job_that_cannot_be_is_refused_in_one_line(option, refusal):
    with pytest.raises(ValueError, match=refusal) as error:
        launcher("slurm", ["cluster=local", option])
    assert "\n" not in str(error.value)


def test_slurm_may_be_asked_for_gpus_of_a_kind():
    launcher("slurm", ["cluster=local", "slurm_gpus_per_node=a100:1"])


SQUEUE = """#!/bin/sh
cat {folder}/listed
"""
SCANCEL = """#!/bin/sh
echo $* >> {folder}/cancelled
"""


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """Slurm's commands, for whom jobs are what the file `listed` says."""
    for name, text in (("squeue", SQUEUE), ("scancel", SCANCEL)):
        file = tmp_path / name
        file.write_text(text.format(folder=tmp_path))
        file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def job_of(folder: pathlib.Path, number: str) -> Job:
    job = submitit.SlurmJob(folder, number)
    job.watcher = Queue(delay_s=0)
    return Job(job, folder / "worker.log")


def test_what_became_of_jobs_is_known_without_accounting(queue):
    """One that died has no result and is listed no more; without an answer, nothing is believed."""
    waiting, dead = job_of(queue, "1"), job_of(queue, "22")
    assert waiting.running()
    assert dead.running()
    (queue / "listed").write_text("1 CONFIGURING\n2 RUNNING\n")
    time.sleep(0.01)
    assert (waiting.running(), dead.running()) == (True, False)
    assert dead.wait() == 1


def test_only_a_job_in_its_queue_is_cancelled(queue):
    (queue / "listed").write_text("1 PENDING\n2 RUNNING\n")
    for job in (pending := job_of(queue, "1"), job_of(queue, "2")):
        job.stop()
    assert (queue / "cancelled").read_text() == "--state=PENDING 1\n"
    (queue / "listed").write_text("")
    assert pending.wait() == 1


@pytest.mark.slow
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
    assert f"exit status {128 + signal.SIGTERM}" in worker.failures()[tmp_path / "run"]
    assert list((tmp_path / "run" / "checkpoints").iterdir())


def test_a_job_that_runs_out_of_time_is_queued_again_once_it_has_saved(tmp_path):
    """What submitit calls then, beside the worker that waits for its input to end."""
    task, thread = under_way(tmp_path)
    again = task.checkpoint()
    thread.join()
    assert lines(tmp_path)[1:] == ["saved"]
    assert again.function.command == task.command
    assert (again.function.name, again.function._process) == (task.name, None)


def test_a_task_makes_room_for_that_of_a_later_sweep(tmp_path):
    """Its sweep was killed outright, and could not ask it to end; nor another, in a queue."""
    queued = Task(UNTIL_ASKED, tmp_path / "worker.log", {})
    task, thread = under_way(tmp_path)
    later = Task(UNTIL_ASKED, tmp_path / "worker.log", {})
    thread.join()
    assert queued() == -signal.SIGTERM
    assert [each.begun() for each in (queued, task, later)] == [False, True, False]
    assert lines(tmp_path)[1:] == ["saved"]


@pytest.mark.parametrize("ends", ["os.kill(os.getpid(), 15)", "sys.exit(143)"])
def test_a_worker_that_is_terminated_is_started_again(tmp_path, monkeypatch, ends):
    """Whether it minded signals already, or was still about to import JAX."""
    monkeypatch.setattr(task_module, "GRACE_SECONDS", 0.0)
    mark = tmp_path / "mark"
    program = f"import os, sys; os.path.exists({str(mark)!r}) or (open({str(mark)!r}, 'w'), {ends})"
    assert Task([sys.executable, "-c", program], tmp_path / "worker.log", {})() == 0
    assert mark.exists()


def test_a_run_that_another_process_trains_is_waited_for(tmp_path, capsys):
    folder = RunFolder.create(tmp_path / "run", RUN)
    taken = []
    waiting = threading.Thread(target=lambda: taken.append(worker_module._lock(folder)))
    with folder.lock():
        waiting.start()
        waiting.join(0.2)
        assert not taken
    waiting.join()
    taken[0].close()
    assert capsys.readouterr().out == f"another process trains {folder.path}, and is waited for\n"


def searched(path: pathlib.Path, name: str, *options: str) -> list[str]:
    """What a search says, in which each trial's values depend on the scores of those before."""
    folder = search.SearchFolder(
        path,
        "smoke",
        {"steps": 400},
        space={"discount": search.Dimension(low=0.5, high=0.99)},
        trials=3,
        workers=1,
        launcher=name,
        launcher_options=options,
    )
    folder.create()
    lines = []
    assert search.carry_out(search.make_plan(folder), lines.append)
    return lines


@pytest.fixture
def ray_cluster():
    """Two nodes with room for one worker each, beside the head."""
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield cluster
    finally:
        importlib.import_module("ray").shutdown()
        cluster.shutdown()


@pytest.mark.cluster
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Ray forks
def test_tasks_of_ray_search_and_one_whose_node_is_lost_ends_on_another(ray_cluster, tmp_path):
    """The node is lost while both train."""
    address = f"address={ray_cluster.address}"
    assert searched(tmp_path / "tasks", "ray", address) == searched(tmp_path / "local", "local")
    lost = []

    def lose_one(*_):
        if not lost and all((tmp_path / f"s{k}" / "metrics.csv").exists() for k in (0, 1)):
            node = next(iter(ray_cluster.worker_nodes))
            lost.append(ray_cluster.remove_node(node, allow_graceful=False))
            ray_cluster.add_node(num_cpus=1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep.SweepTable, "update", lose_one)
        together = carry_out(launcher("ray", [address]), tmp_path, LONG)
    assert lost
    assert_as_here(together, tmp_path / "alone")


SLURM_CONF = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/munge
SlurmUser=root
SlurmdUser=root
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
ReturnToService=2
JobRequeue=1
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmdSpoolDir={folder}/spool
StateSaveLocation={folder}/state
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Slurm with one node, of this machine."""
    programs = ("munged", "slurmctld", "slurmd")
    if missing := [name for name in programs if not shutil.which(name)]:
        pytest.skip(f"there is no {missing[0]}: apt-get install slurm-wlm munge")
    folder = tmp_path / "slurm"
    for name in ("spool", "state"):
        (folder / name).mkdir(parents=True)
    conf = folder / "slurm.conf"
    conf.write_text(SLURM_CONF.format(host=socket.gethostname().split(".")[0], folder=folder))
    monkeypatch.setenv("SLURM_CONF", str(conf))
    os.makedirs("/run/munge", exist_ok=True)
    shutil.chown("/run/munge", "munge")
    munge = ["runuser", "-u", "munge", "--", "munged", "--foreground", "--force"]
    daemons = [subprocess.Popen(munge, stderr=subprocess.DEVNULL)]
    try:
        time.sleep(1)
        for name in programs[1:]:
            daemons.append(subprocess.Popen([name, "-D"], stderr=subprocess.DEVNULL))
        subprocess.run(["srun", "--immediate=60", "hostname"], check=True, timeout=90)
        yield
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait()


@pytest.mark.cluster
def test_a_job_of_slurm_that_is_requeued_ends_like_one_that_is_not(slurm, tmp_path):
    """Two jobs; the first is taken off its node while it trains, and queued again."""
    requeued = []

    def requeue_one(*_):
        if not requeued and (tmp_path / "s0" / "metrics.csv").exists():
            text = subprocess.check_output(["squeue", "-h", "-o", "%A"], text=True)
            requeued.append(min(text.split(), key=int))
            subprocess.run(["scontrol", "requeue", requeued[0]], check=True)

    started_by = launcher("slurm", ["slurm_use_srun=0"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep.SweepTable, "update", requeue_one)
        together = carry_out(started_by, tmp_path, LONG)
    assert requeued
    assert_as_here(together, tmp_path / "alone")


@pytest.mark.cluster
def test_a_job_of_slurm_that_reaches_its_time_limit_ends_like_one_that_does_not(slurm, tmp_path):
    """A step of `srun`, as jobs are by default, which is told in half a minute."""

    def hasten(*_):
        """What is queued again begins now, and not two minutes later."""
        for job in subprocess.check_output(["squeue", "-ht", "PD", "-o", "%A"], text=True).split():
            subprocess.run(["scontrol", "update", f"JobId={job}", "StartTime=now"], check=False)

    limits = ["timeout_min=1", "slurm_signal_delay_s=50"]
    longer = dataclasses.replace(LONG, steps=4_000_000, evaluate_every=400_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep.SweepTable, "update", hasten)
        limited = carry_out(launcher("slurm", limits), tmp_path, longer, seeds=(0,))
    jobs = subprocess.check_output(["scontrol", "show", "job"], text=True)
    assert max(map(int, re.findall(r"Restarts=(\d+)", jobs))) > 0
    assert_as_here(limited, tmp_path / "alone")


@pytest.mark.cluster
def test_jobs_of_slurm_search_like_workers_of_this_machine(slurm, tmp_path):
    assert searched(tmp_path / "jobs", "slurm") == searched(tmp_path / "local", "local")


@pytest.mark.cluster
def test_what_slurm_would_not_take_is_refused_before_anything_is_written(slurm, tmp_path):
    for option in ("slurm_partition=nowhere", "cpus_per_task=64", "gpus_per_node=1"):
        with pytest.raises(ValueError, match="Slurm takes no such job: ") as refusal:
            launcher("slurm", [option])
        assert "\n" not in str(refusal.value)
    launcher("slurm", ["slurm_partition=all"])
    assert subprocess.check_output(["squeue", "-h"]) == b""  # nothing was submitted
