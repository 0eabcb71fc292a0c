"""Trackers are told of every evaluation and of the end; one that fails is left out with a line."""

import shutil
import sys
import threading
import time
import types

import pytest

from mapg_jax.cli import train
from mapg_jax.runs import trackers
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.run import Event
from mapg_jax.runs.train import take_up


class Recorder:
    """What a tracker was told."""

    def __init__(self, folder, config):
        self.config, self.rows, self.files = config, [], None
        made.append(self)

    def log(self, numbers, step):
        if step == fails_at:
            raise ConnectionError("no network\nand more")
        self.rows.append((step, numbers))

    def close(self, files):
        self.files = [file.name for file in files]


made: list[Recorder] = []
fails_at = None


@pytest.fixture
def recorder(monkeypatch):
    made.clear()
    monkeypatch.setattr(trackers, "TRACKERS", {"wandb": Recorder, "mlflow": Recorder})
    return made


def told(folder, names):
    with trackers.tracking(folder, names) as callbacks:
        for row in read_metrics(folder.metrics):
            for callback in callbacks:
                callback(Event("evaluation", folder.path, int(row["env_steps"]), row))
                callback(Event("checkpoint", folder.path, int(row["env_steps"]), {}))


def test_every_evaluation_is_told_once(recorder, finished_run):
    told(finished_run, ["tensorboard", "wandb", "mlflow", "wandb"])
    rows = read_metrics(finished_run.metrics)
    assert len(recorder) == 2
    for tracker in recorder:
        assert [step for step, _ in tracker.rows] == [row["env_steps"] for row in rows]
        assert all(numbers["return_mean"] == row["return_mean"]
                   for (_, numbers), row in zip(tracker.rows, rows, strict=True))  # fmt: skip
        assert tracker.config["heads"] == finished_run.config.heads
        assert tracker.config["command"].startswith("mapg")
        assert tracker.files is not None


@pytest.mark.parametrize("drawable", [True, False])
def test_a_tracked_run_ends_with_its_video(drawable, recorder, finished_run, tmp_path, monkeypatch):
    run = take_up(shutil.copytree(finished_run.path, tmp_path / "run"))

    def film(folder):
        if not drawable:
            raise OSError("no renderer")
        (folder.path / "video.gif").write_bytes(b"")

    monkeypatch.setattr(train, "film", film)
    monkeypatch.setattr(train, "finish", lambda folder: {})
    monkeypatch.setattr(train, "print_score", lambda score, out: None)
    with open(tmp_path / "out", "w+") as out:
        train.take_to_the_end(run, out, ["wandb"])
    assert ("video.gif" in recorder[0].files) == drawable
    assert "curve.png" not in recorder[0].files  # `finish` draws it


def test_one_that_fails_stops_nothing(recorder, finished_run, caplog, monkeypatch):
    steps = [int(row["env_steps"]) for row in read_metrics(finished_run.metrics)]
    monkeypatch.setattr(sys.modules[__name__], "fails_at", steps[1])
    told(finished_run, ["wandb"])
    assert [step for step, _ in recorder[0].rows] == steps[:1]
    (said,) = caplog.records
    assert said.getMessage() == "wandb is told no more of the run: no network"


def test_one_that_does_not_answer_holds_nothing_up(finished_run, caplog, monkeypatch):
    """Neither the run, which is told nothing of it, nor for long its end."""
    answer = threading.Event()
    monkeypatch.setattr(trackers, "TRACKERS", {"mlflow": lambda *_: answer.wait(60)})
    monkeypatch.setattr(trackers, "PATIENCE", 0.2)
    began = time.monotonic()
    told(finished_run, ["mlflow"])
    assert time.monotonic() - began < 10
    answer.set()
    (said,) = caplog.records
    assert said.getMessage() == "mlflow is told no more of the run: it has not answered for 0.2 s"


def test_weights_and_biases_is_called_as_it_asks(finished_run, monkeypatch):
    """Against a module of the same form; `make test-trackers` has the real ones."""
    calls = []
    run = types.SimpleNamespace(
        log=lambda numbers, step=None: calls.append((step, numbers)),
        finish=lambda: calls.append("finished"),
    )
    module = types.SimpleNamespace(
        init=lambda **options: calls.append(options) or run,
        Settings=lambda **options: options,
        Image=str,
        Video=str,
    )
    monkeypatch.setitem(sys.modules, "wandb", module)
    told(finished_run, ["wandb"])
    assert calls[0]["config"]["seed"] == finished_run.config.seed
    assert calls[1][0] == 200 and calls[-1] == "finished"


@pytest.mark.parametrize(
    ("name", "message"),
    [("neptune", "among tensorboard, wandb, mlflow, got"), ("wandb", r"pip install .*\[wandb\]")],
)
def test_unknown_and_missing_ones_are_refused(name, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ValueError, match=message):
        trackers.refuse_missing([name])


@pytest.mark.trackers
@pytest.mark.filterwarnings("ignore")
def test_a_server_that_is_not_there_is_named_soon(finished_run, monkeypatch, caplog):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setattr(trackers, "PATIENCE", 60.0)
    told(finished_run, ["mlflow"])
    (said,) = (record for record in caplog.records if record.name.startswith("mapg_jax"))
    assert "http://127.0.0.1:9" in said.getMessage()


@pytest.mark.trackers
@pytest.mark.filterwarnings("ignore")
def test_the_real_ones_write_without_a_network(finished_run, tmp_path, monkeypatch, caplog):
    import mlflow

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    told(finished_run, ["wandb", "mlflow"])
    assert not [record for record in caplog.records if record.name.startswith("mapg_jax")]
    (run,) = mlflow.search_runs(search_all_experiments=True, output_format="list")
    rows = read_metrics(finished_run.metrics)
    assert run.data.metrics["return_mean"] == pytest.approx(rows[-1]["return_mean"])
    assert run.data.params["heads"] == str(finished_run.config.heads)
    assert list(finished_run.path.rglob("*.wandb"))
