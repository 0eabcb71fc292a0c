"""train and resume from Python: whole runs, quiet, and stopped by their callbacks alone."""

import contextlib
import dataclasses
import io
import json
import signal
from typing import NamedTuple

import oracles
import pytest

import mapg_jax
from mapg_jax.reports.results import UnfinishedError, read_run
from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics

SELDOM = dataclasses.replace(oracles.RUN, checkpoint_seconds=1e6)
"""No checkpoint is due before the run ends."""


def handlers():
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


class Seen(NamedTuple):
    """What a run from Python left, told and showed."""

    trained: mapg_jax.Trained
    folder: RunFolder
    events: list[mapg_jax.Event]
    shown: str
    handlers: list  # before it, and at every event


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    events, found, shown = [], [handlers()], io.StringIO()
    callbacks = [events.append, lambda event: found.append(handlers())]
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
        trained = mapg_jax.train(oracles.RUN, tmp_path_factory.mktemp("runs") / "run", callbacks)
    return Seen(trained, RunFolder.open(trained.path), events, shown.getvalue(), found)


def test_a_run_from_python_is_a_whole_run(seen, finished_run):
    oracles.assert_same_run(seen.folder, finished_run)
    assert seen.trained.config == oracles.RUN
    assert json.loads(seen.folder.evaluation.read_text()) == seen.trained.score
    assert (seen.trained.score["episodes"], seen.trained.score["env_steps"]) == (3, 800)
    assert seen.folder.curve.read_bytes()[1:4] == b"PNG"
    assert is_finished(seen.folder)
    assert read_run(seen.folder).return_mean == seen.trained.score["mean"]


def test_it_prints_nothing_and_leaves_signals_alone(seen):
    assert seen.shown == ""
    assert len(seen.handlers) == 1 + len(seen.events)
    assert all(found == seen.handlers[0] for found in seen.handlers)


def test_callbacks_are_told_of_every_evaluation_and_checkpoint(seen):
    assert {event.path for event in seen.events} == {seen.trained.path}
    assert [event.env_steps for event in seen.events] == sorted(e.env_steps for e in seen.events)
    evaluations = [event for event in seen.events if event.kind == "evaluation"]
    rows = read_metrics(seen.folder.metrics)
    assert [event.env_steps for event in evaluations] == [200, 400, 600, 800]
    for event, row in zip(evaluations, rows, strict=True):
        assert dict(event.row) == pytest.approx(row, rel=1e-8)  # nine digits
    kept = {int(path.name) for path in seen.folder.checkpoints.iterdir()}
    checkpoints = [event for event in seen.events if event.kind == "checkpoint"]
    assert {event.env_steps for event in checkpoints} == kept
    assert len(checkpoints) == len(kept) and not any(event.row for event in checkpoints)


def test_a_callback_stops_the_run_and_resuming_equals_not_stopping(seen, finished_run, tmp_path):
    """Saved and scored where it is, and not finished."""

    def stop(event):
        return event.kind == "evaluation" and event.env_steps >= 400

    stopped = mapg_jax.train(SELDOM, tmp_path / "run", [stop, lambda event: "go on"])
    folder = RunFolder.open(stopped.path)
    assert [path.name for path in folder.checkpoints.iterdir()] == ["400"]
    assert stopped.score["env_steps"] == 400 == folder.scored_steps()
    assert not is_finished(folder)
    with pytest.raises(UnfinishedError, match="400 of 800 steps"):
        read_run(folder)
    whole = mapg_jax.resume(stopped.path)
    oracles.assert_same_run(folder, finished_run)
    assert is_finished(folder)
    scores = [dict(trained.score) for trained in (whole, seen.trained)]
    for score in scores:
        del score["seal"]  # which holds what the clock said
    assert scores[0] == scores[1]


def test_a_run_stopped_before_its_first_evaluation_is_scored_too(tmp_path):
    stopped = mapg_jax.train(oracles.RUN, tmp_path / "run", [lambda event: True])
    folder = RunFolder.open(stopped.path)
    assert stopped.score["env_steps"] == 64
    assert read_metrics(folder.metrics) == [] and not folder.curve.exists()


def test_fewer_steps_than_are_done_are_refused(finished_run, tmp_path):
    folder = oracles.copy_run(finished_run, tmp_path / "run")
    before = {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}
    message = "run has 800 steps already, more than 400; --steps with a larger number"
    with pytest.raises(ValueError, match=message):
        mapg_jax.resume(folder.path, steps=400)
    before.setdefault(folder.path / ".lock", b"")
    assert before == {p: p.read_bytes() for p in folder.path.rglob("*") if p.is_file()}
