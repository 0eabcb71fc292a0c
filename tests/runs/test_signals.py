"""Signals are requests to stop, obeyed once the state is saved."""

import dataclasses
import os
import signal
import time

import oracles
import pytest

from mapg_jax.runs import hosts, signals
from mapg_jax.runs.progress import Progress
from mapg_jax.runs.run import _Watch
from mapg_jax.runs.signals import StoppedError
from mapg_jax.runs.train import begin, take_up


@pytest.fixture
def interrupts():
    """Sets what SIGINT does, whatever the tests were started with, and sets it back."""
    before = signal.getsignal(signal.SIGINT)
    yield lambda handler: signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGINT, before)


def test_a_second_signal_acts_as_usual(interrupts):
    interrupts(signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), signals.caught_signals() as caught:
        os.kill(os.getpid(), signal.SIGINT)
        assert caught == [signal.SIGINT]
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_signal_stays_ignored(interrupts):
    interrupts(signal.SIG_IGN)
    with signals.caught_signals() as caught:
        os.kill(os.getpid(), signal.SIGINT)
    assert caught == []
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_signal_between_two_questions_waits_for_the_next(monkeypatch):
    """Hosts ask each other once, whatever comes meanwhile to one of them alone."""
    caught, asked = [], []

    def largest(ours):
        asked.append(list(ours))
        caught.append(signal.SIGTERM)  # after what was asked
        return ours

    monkeypatch.setattr(hosts, "largest", largest)
    watch = _Watch({}, Progress(1, False), (), caught, "mapg resume run")
    assert not watch.agreed_to_stop()
    watch.obey()
    assert asked == [[0, 0]]
    assert watch.agreed_to_stop()
    with pytest.raises(StoppedError, match="by SIGTERM"):
        watch.obey()


def test_a_signal_to_another_host_is_obeyed(monkeypatch):
    monkeypatch.setattr(hosts, "largest", lambda ours: [signal.SIGINT, 0])
    watch = _Watch({}, Progress(1, False), (), [], "mapg resume run")
    assert watch.agreed_to_stop()
    with pytest.raises(StoppedError, match="by SIGINT"):
        watch.obey()


def test_a_signal_saves_and_resuming_equals_not_stopping(finished_run, tmp_path, monkeypatch):
    path = tmp_path / "run"
    run = begin(dataclasses.replace(oracles.RUN, checkpoint_seconds=1e6), path)
    with monkeypatch.context() as patch, signals.caught_signals() as caught:
        kill = lambda *_: os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
        patch.setattr(Progress, "evaluated", kill)
        with pytest.raises(StoppedError, match=f"by SIGTERM; go on with: mapg resume {path}"):
            run.go(signals=caught)
    assert [checkpoint.name for checkpoint in (path / "checkpoints").iterdir()] == ["200"]
    run = take_up(path)
    run.go()
    oracles.assert_same_run(run.folder, finished_run)
