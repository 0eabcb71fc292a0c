"""Several processes that make one run: here two, over gloo on this machine."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import oracles
import pytest

from mapg_jax.runs import hosts
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.train import begin
from mapg_jax.training.config import Config

cluster = pytest.mark.cluster

FLAGS = (
    "--env pendulum --preset smoke --shards 4 --environments 8 --hidden 8 8 --batch-size 32",
    "--replay-size 1000 --updates-per-step 0.25 --evaluate-every 400 --evaluation-episodes 2",
    "--final-episodes 3 --checkpoint-seconds 0.001 --checkpoints-kept 100 --steps 2000",
)


def start(*arguments, devices, processes=1, program=("-m", "mapg_jax")):
    """The command in each of its processes, or another program of Python's."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    meeting = ["--coordinator", f"127.0.0.1:{port}", "--hosts", str(processes), "--host"]
    return [
        subprocess.Popen(
            [sys.executable, *program, *map(str, arguments)]
            + ([*meeting, str(i)] if processes > 1 else []),
            env={**os.environ, "XLA_FLAGS": flags},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for i in range(processes)
    ]  # fmt: skip


def finish(processes, status=0):
    for process in processes:
        _, err = process.communicate(timeout=300)
        assert process.returncode == status, err[-3000:]
        assert "Traceback" not in err


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("hosts") / "run"
    finish(start("train", *" ".join(FLAGS).split(), "--out", path, devices=2, processes=2))
    return RunFolder.open(path)


@cluster
def test_two_hosts_make_the_run_of_one(whole, tmp_path):
    finish(start("train", *" ".join(FLAGS).split(), "--out", tmp_path / "run", devices=4))
    alone = read_metrics(tmp_path / "run" / "metrics.csv")
    together = read_metrics(whole.metrics)
    assert [row["env_steps"] for row in together] == [400, 800, 1200, 1600, 2000]
    for ours, theirs in zip(together, alone, strict=True):
        assert ours["updates"] == theirs["updates"]
        np.testing.assert_allclose(ours["return_mean"], theirs["return_mean"], rtol=1e-4)


@cluster
def test_one_of_two_is_killed_and_both_resume(whole, tmp_path):
    """The one that is left ends by itself; resumed by two, it is the run that nobody killed."""
    path = tmp_path / "run"
    first, second = start("train", *" ".join(FLAGS).split(), "--out", path, devices=2, processes=2)
    while not (path / "metrics.csv").exists():
        assert first.poll() is None
        time.sleep(0.05)
    second.send_signal(signal.SIGKILL)
    said = first.communicate(timeout=300)[1]
    second.communicate(timeout=30)
    assert first.returncode == 1
    assert "Traceback" not in said
    assert "mapg: a process of this run is lost (" in said.splitlines()[-1]
    assert 0 < len(read_metrics(path / "metrics.csv")) < 5
    finish(start("resume", path, devices=2, processes=2))
    oracles.assert_same_run(RunFolder.open(path), whole)


@cluster
def test_one_that_fails_alone_is_not_waited_for_long(tmp_path, monkeypatch):
    """The disk is full as the first host writes a row, which the other does not."""
    (tmp_path / "full.py").write_text(
        "from mapg_jax.runs import metrics\n"
        "def write(*_):\n"
        "    raise OSError(28, 'No space left on device')\n"
        "metrics.MetricsFile.write = write\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    flags = [*" ".join(FLAGS).split(), "--import", "full", "--out", tmp_path / "run"]
    first, second = start("train", *flags, devices=2, processes=2)
    said = first.communicate(timeout=150)[1]  # to compile, and LEAVING_SECONDS
    second.communicate(timeout=30)
    assert first.returncode != 0 and second.returncode != 0
    assert "No space left on device" in said


@cluster
def test_from_python_the_first_scores_and_all_have_the_score(whole, tmp_path):
    code = (
        "import sys; from mapg_jax.runs import hosts\n"
        "path, _, address, _, count, _, index = sys.argv[1:]\n"
        "hosts.join(address, int(count), int(index))\n"
        "import mapg_jax; from mapg_jax.runs.folder import RunFolder\n"
        f"config = RunFolder.open({str(whole.path)!r}).config\n"
        "print(mapg_jax.train(config, path).score['mean'])"
    )
    processes = start(tmp_path / "run", devices=2, processes=2, program=("-c", code))
    ends = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], ends
    score = json.loads(whole.evaluation.read_text())["mean"]
    assert [out.split()[-1] for out, _ in ends] == [str(score)] * 2  # gloo speaks before it


@cluster
def test_a_run_goes_on_with_other_devices(whole, tmp_path):
    folder = oracles.copy_run(whole, tmp_path / "run", upto=1200)
    finish(start("resume", folder.path, devices=1))
    assert [row["env_steps"] for row in read_metrics(folder.metrics)][-1] == 2000


@cluster
def test_two_hosts_go_on_with_what_one_has_saved(tmp_path):
    """What was not filled of the replay is zeros; a damaged checkpoint is set aside."""
    flags = [*" ".join(FLAGS).split(), "--replay-size", "4000", "--checkpoint-seconds", "1e9"]
    path = tmp_path / "run"
    finish(start("train", *flags, "--out", path, devices=4))
    half = oracles.newest_state(RunFolder.open(path))
    finish(start("resume", path, "--steps", 2400, devices=2, processes=2))
    more = oracles.newest_state(RunFolder.open(path))
    held = half.replay.size[0]
    assert half.replay.size.tolist() == [500] * 4 and more.replay.size.tolist() == [600] * 4
    ours, theirs = more.replay.data.steps.reward, half.replay.data.steps.reward
    np.testing.assert_array_equal(ours[:, :held], theirs[:, :held])
    assert not ours[:, 600:].any()
    file = max((path / "checkpoints/2400/rest").rglob("d/*"), key=lambda x: x.stat().st_size)
    file.write_bytes(file.read_bytes()[::-1])
    for process in start("resume", path, "--steps", 2800, devices=2, processes=2):
        err = process.communicate(timeout=300)[1]
        assert process.returncode == 0 and "is set aside as 2400.damaged" in err
        assert "Traceback" not in err
    assert (path / "checkpoints/2400.damaged").exists()
    assert oracles.newest_state(RunFolder.open(path)).replay.size.tolist() == [700] * 4


@cluster
def test_two_hosts_that_leave_the_replay_out_begin_it_anew(tmp_path):
    flags = [*" ".join(FLAGS).split(), "--no-save-replay", "--checkpoint-seconds", "1e9"]
    path = tmp_path / "run"
    finish(start("train", *flags, "--out", path, devices=2, processes=2))
    finish(start("resume", path, "--steps", 2400, devices=2, processes=2))
    written = json.loads((path / "checkpoints/2400/host/metadata").read_text())["leaves"]["rest"]
    assert ".replay.size" in written
    assert not [name for name in written if name.startswith(".replay.data")]
    assert oracles.newest_state(RunFolder.open(path)).replay.size.tolist() == [0] * 4


@cluster
def test_a_refusal_of_the_first_is_that_of_all(whole):
    first, second = start(
        "train", *" ".join(FLAGS).split(), "--out", whole.path, devices=2, processes=2
    )
    assert "exists already; choose another --out" in first.communicate(timeout=100)[1]
    assert "the first process of this run was refused" in second.communicate(timeout=100)[1]
    assert (first.returncode, second.returncode) == (2, 2)


@cluster
def test_a_host_without_a_device_of_the_run_is_refused(tmp_path):
    """Both say so, nothing is written, and neither waits for the other."""
    flags = ["--env", "pendulum", "--preset", "smoke", "--shards", "2", "--out"]
    for process in start("train", *flags, tmp_path / "run", devices=2, processes=2):
        err = process.communicate(timeout=100)[1]
        assert "takes 2 of 4 devices, and 1 of 2 hosts have one of them; choose --shards 4" in err
        assert process.returncode == 2 and "Traceback" not in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("env", "remedy"), [("pendulum", "--shards 1, or a multiple"), ("hopper", "--hosts 1: hopper")]
)
def test_a_run_without_a_device_on_every_host_makes_no_folder(env, remedy, tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(hosts, "largest", lambda ours: ours)  # the other one's are the same
    with pytest.raises(ValueError, match=f"1 of 2 hosts have one of them; choose {remedy}"):
        begin(Config(env=env, steps=1_000), tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_the_refusal_of_one_is_that_of_all(monkeypatch):
    def refused():
        raise KeyError("ours")

    assert hosts.by_all(lambda: 3) == 3
    with pytest.raises(KeyError, match="ours"):
        hosts.by_all(refused, KeyError("theirs"))
    monkeypatch.setattr(hosts, "largest", lambda ours: True)  # another is refused
    with pytest.raises(ValueError, match="another process of this run was refused"):
        hosts.by_all(lambda: 3)
    with pytest.raises(KeyError, match="theirs"):
        hosts.by_all(lambda: 3, KeyError("theirs"))
    with pytest.raises(KeyError, match="ours"):
        hosts.by_all(refused, KeyError("theirs"))


@pytest.mark.parametrize("address", ["localhost", "localhost:", ":1234", "localhost:http"])
def test_an_address_without_a_port_is_refused(address):
    with pytest.raises(
        ValueError, match=f"--coordinator must be HOST:PORT or slurm, got '{address}'"
    ):
        hosts.join(address, 1, 0)


@pytest.mark.parametrize(
    ("count", "index", "said"),
    [
        (0, 0, "--hosts must be at least 1, got 0"),
        (2, 2, "--host must be from 0 to 1 of --hosts 2, got 2"),
        (2, -1, "--host must be from 0 to 1 of --hosts 2, got -1"),
    ],
)
def test_a_process_that_a_run_does_not_have_is_refused(count, index, said):
    with pytest.raises(ValueError, match=said):
        hosts.join("localhost:1234", count, index)
