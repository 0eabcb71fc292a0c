"""What runs on another machine: the worker as a process, until it is done or another is appointed.

The storage is what all machines share: a file beside the log names the task that is to do the work.
"""

import copy
import os
import pathlib
import signal
import socket
import subprocess
import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

POLL_SECONDS = 0.5
GRACE_SECONDS = 60.0
TAKEN_AWAY = (-signal.SIGTERM, 128 + signal.SIGTERM)
"""Exit statuses of a worker that was told to end, before and while it minded signals."""
NOBODY = "nobody"


def appoint(log: pathlib.Path, name: str) -> None:
    """Names the task that is to do the work of a log; any other that does it saves and ends.

    The file is never removed: nodes may believe for a minute that it is still as it was.
    """
    _appointed(log).write_text(name)


def report(log: pathlib.Path, error: Exception) -> None:
    """Writes behind what a worker has said why its task has no status."""
    with log.open("a") as file:
        file.write(f"{str(error).strip()}\n")


def dismiss(log: pathlib.Path) -> None:
    """Asks the task of a log to save and to end."""
    appoint(log, NOBODY)


class Task:
    """Starts a worker and waits for it; nothing of JAX is pickled with it."""

    def __init__(self, command: Sequence[str], log: pathlib.Path, environ: Mapping[str, str]):
        """A task that is appointed: one of an earlier sweep, which was killed, makes room."""
        self.command, self.log, self.environ = list(command), log.absolute(), dict(environ)
        self.folder, self.name = os.getcwd(), uuid.uuid4().hex
        self._process: subprocess.Popen | None = None
        appoint(log, self.name)

    def __call__(self) -> int:
        """The exit status of the worker, once it has done what it can or is asked to end.

        A scheduler that takes the machine away tells the worker to end, too. Then this process will
        be killed and its job queued again; if that does not happen, the worker is started again.
        """
        status = -signal.SIGTERM
        while not self._dismissed():
            status = self._carry()
            if status not in TAKEN_AWAY:
                break
            deadline = time.monotonic() + GRACE_SECONDS
            while time.monotonic() < deadline and not self._dismissed():
                time.sleep(POLL_SECONDS)
        return status

    def _dismissed(self) -> bool:
        """Whether another task is appointed, or none; a file that is being written says nothing."""
        file = _appointed(self.log)
        return (file.read_text() if file.exists() else "") not in ("", self.name)

    def _carry(self) -> int:
        with open(self.log, "ab", buffering=0) as log:
            log.write(f"{socket.gethostname()}: task {self.name}\n".encode())
            self._process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,  # its end tells the worker to save, however this one ends
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environ},
                cwd=self.folder,
                start_new_session=True,
            )
        while (status := self._process.poll()) is None:
            if self._dismissed():
                self.end()
            time.sleep(POLL_SECONDS)
        self.end()  # its input is ours to close
        return status

    def begun(self) -> bool:
        """Whether it has started a worker, on whatever machine."""
        return self.log.exists() and self.name in self.log.read_text(errors="replace")

    def end(self) -> None:
        """The worker saves and ends."""
        if self._process and self._process.stdin:
            self._process.stdin.close()
            self._process.wait()

    def checkpoint(self) -> Any:
        """What Slurm is given to queue again when it takes the machine away."""
        import submitit

        self.end()
        again = copy.copy(self)
        again._process = None
        return submitit.helpers.DelayedSubmission(again)


def _appointed(log: pathlib.Path) -> pathlib.Path:
    return log.with_name("worker.task")
