"""Two processes that make one run, over gloo on this machine."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import oracles
import pytest

from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics

pytestmark = pytest.mark.cluster

FLAGS = (
    "--env pendulum --preset smoke --shards 4 --environments 8 --hidden 8 8 --batch-size 32",
    "--replay-size 1000 --updates-per-step 0.25 --evaluate-every 400 --evaluation-episodes 2",
    "--final-episodes 3 --checkpoint-seconds 0.001 --checkpoints-kept 100 --steps 2000",
)


def start(*arguments, devices, hosts=1):
    """The command in each of its processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    meeting = ["--coordinator", f"127.0.0.1:{port}", "--hosts", str(hosts), "--host"]
    return [
        subprocess.Popen(
            [sys.executable, "-m", "mapg_jax", *map(str, arguments)]
            + ([*meeting, str(i)] if hosts > 1 else []),
            env={**os.environ, "XLA_FLAGS": flags},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for i in range(hosts)
    ]  # fmt: skip


def finish(processes, status=0):
    for process in processes:
        _, err = process.communicate(timeout=300)
        assert process.returncode == status, err[-3000:]
        assert "Traceback" not in err


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("hosts") / "run"
    finish(start("train", *" ".join(FLAGS).split(), "--out", path, devices=2, hosts=2))
    return RunFolder.open(path)


def test_two_hosts_make_the_run_of_one(whole, tmp_path):
    finish(start("train", *" ".join(FLAGS).split(), "--out", tmp_path / "run", devices=4))
    alone = read_metrics(tmp_path / "run" / "metrics.csv")
    together = read_metrics(whole.metrics)
    assert [row["env_steps"] for row in together] == [400, 800, 1200, 1600, 2000]
    for ours, theirs in zip(together, alone, strict=True):
        assert ours["updates"] == theirs["updates"]
        np.testing.assert_allclose(ours["return_mean"], theirs["return_mean"], rtol=1e-4)


def test_one_of_two_is_killed_and_both_resume(whole, tmp_path):
    """The one that is left ends by itself; resumed by two, it is the run that nobody killed."""
    path = tmp_path / "run"
    first, second = start("train", *" ".join(FLAGS).split(), "--out", path, devices=2, hosts=2)
    while not (path / "metrics.csv").exists():
        assert first.poll() is None
        time.sleep(0.05)
    second.send_signal(signal.SIGKILL)
    for process in (first, second):
        process.communicate(timeout=300)
    assert first.returncode != 0
    assert 0 < len(read_metrics(path / "metrics.csv")) < 5
    finish(start("resume", path, devices=2, hosts=2))
    oracles.assert_same_run(RunFolder.open(path), whole)


def test_a_run_goes_on_with_other_devices(whole, tmp_path):
    folder = oracles.copy_run(whole, tmp_path / "run", upto=1200)
    finish(start("resume", folder.path, devices=1))
    assert [row["env_steps"] for row in read_metrics(folder.metrics)][-1] == 2000


def test_a_refusal_of_the_first_is_that_of_all(whole):
    first, second = start(
        "train", *" ".join(FLAGS).split(), "--out", whole.path, devices=2, hosts=2
    )
    assert "exists already; choose another --out" in first.communicate(timeout=100)[1]
    assert "the first process of this run was refused" in second.communicate(timeout=100)[1]
    assert (first.returncode, second.returncode) == (2, 2)
