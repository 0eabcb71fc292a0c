"""Workers as jobs of Slurm, and the hosts of a run as the tasks of one."""

import dataclasses
import json
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
import submitit
from launched import LONG, RUN, assert_as_here, carry_out, searched

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps import sweep
from mapg_jax.sweeps.launchers import launcher
from mapg_jax.sweeps.pool import Worker
from mapg_jax.sweeps.slurm import Job, Queue


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
        ("timeout_min=2", "timeout_min=2 leaves a job no time: .* give at least 3"),
        ("slurm_signal_delay_s=x", "signal_delay_s must be a whole number of at least 0, got 'x'"),
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
SRUN = "#!/bin/sh"
SBATCH = """#!/bin/sh
test "$*" = --test-only && ! grep -q -- --partition=nowhere && exit
echo sbatch: error: Batch job submission failed: Invalid partition name specified >&2
exit 1
"""


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """Slurm's commands, for whom jobs are what the file `listed` says."""
    programs = {"squeue": SQUEUE, "scancel": SCANCEL, "srun": SRUN, "sbatch": SBATCH}
    for name, text in programs.items():
        file = tmp_path / name
        file.write_text(text.format(folder=tmp_path))
        file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def test_slurm_is_asked_whether_it_would_take_such_a_job(queue, monkeypatch):
    launcher("slurm", ["slurm_partition=somewhere"])
    with pytest.raises(ValueError, match=r"Slurm takes no such job: .*Invalid partition name"):
        launcher("slurm", ["slurm_partition=nowhere"])
    (queue / "sbatch").unlink()
    monkeypatch.setenv("PATH", str(queue))
    with pytest.raises(ValueError, match=r"Slurm takes no such job: .*'sbatch'"):
        launcher("slurm")


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


def test_why_a_job_has_no_result_stands_in_the_log(queue):
    """As of one that Slurm has killed for its memory: it wrote nothing but on its error stream."""
    (queue / "listed").write_text("")
    job = job_of(queue, "3")
    paths = job._job.paths
    for file, text in ((paths.stdout, ""), (paths.stderr, "slurmstepd: error: oom_kill\n")):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    assert job.wait() == 1
    assert "oom_kill" in (queue / "worker.log").read_text()


@pytest.mark.slow
def test_jobs_of_submitit_end_like_workers_of_this_machine(tmp_path):
    assert_as_here(
        carry_out(launcher("slurm", ["cluster=local"]), tmp_path, RUN), tmp_path / "here"
    )


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
        pytest.fail(f"there is no {missing[0]}: apt-get install slurm-wlm munge")
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
    """A step of `srun`, as jobs are by default, which is told after 45 to 75 s."""
    waiting: list[str] = []

    def hasten(*_):
        """What is queued again begins in ten seconds: by itself in two minutes, at once too soon.

        A node refuses a job that was requeued within the same second.
        """
        queued = subprocess.check_output(["squeue", "-ht", "PD", "-o", "%A"], text=True).split()
        for job in set(queued) - set(waiting):
            subprocess.run(["scontrol", "update", f"JobId={job}", "StartTime=now+10"], check=False)
        waiting[:] = queued

    longer = dataclasses.replace(LONG, steps=6_000_000, evaluate_every=600_000)
    limits = ["timeout_min=2", "slurm_signal_delay_s=45"]
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


@pytest.mark.cluster
def test_the_tasks_of_a_job_step_are_the_hosts_of_a_run(slurm, tmp_path):
    """Who is first, how many there are and where they meet, Slurm's environment says."""
    path = tmp_path / "run"
    flags = "--env pendulum --preset smoke --shards 2 --steps 1000 --coordinator slurm"
    train = [sys.executable, "-m", "mapg_jax", "train", *flags.split(), "--out", str(path)]
    step = subprocess.run(
        ["srun", "--ntasks=2", *train], env={**os.environ, "XLA_FLAGS": ""},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert step.returncode == 0, step.stderr[-3000:]
    assert step.stdout.count("run folder: ") == 1  # the first alone speaks
    (process,) = json.loads((path / "config.json").read_text())["history"]
    assert process["host"]["devices"] == "2"
    assert RunFolder.open(path).scored_steps() == 1000
