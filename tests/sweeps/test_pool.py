"""Worker processes: pinned to their cores, and never left behind."""

import dataclasses
import os
import signal

import oracles
import pytest

from mapg_jax.sweeps.groups import Job
from mapg_jax.sweeps.launchers import Local, Share, deal
from mapg_jax.sweeps.pool import Worker

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)


def test_cores_are_dealt_out():
    assert deal([0, 1, 2, 3], 2) == [[0, 2], [1, 3]]
    assert deal([0, 1], 3) == [[0], [1], [0]]
    assert deal([], 2) == [[], []]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the platform cannot pin")
def test_a_worker_is_pinned_and_one_that_dies_is_reported(tmp_path):
    core = min(os.sched_getaffinity(0))
    worker = Worker((Job(RUN, tmp_path / "run"),), Share((core,)), False, Local())
    pid = worker.launched.pid
    assert os.sched_getaffinity(pid) == {core}
    os.kill(pid, signal.SIGKILL)
    worker.wait()
    assert worker.crashed()
    assert worker.failures() == {tmp_path / "run": "killed by signal 9"}
