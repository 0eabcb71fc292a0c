"""What a job or a task of a cluster does: a worker, as often as it is asked to."""

import pathlib
import signal
import sys
import threading
import time

import pytest

from mapg_jax.sweeps import task as task_module
from mapg_jax.sweeps.task import Task

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
