"""What runs on another machine: the worker as a process, stopped by a file beside its log."""

import os
import pathlib
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from typing import Any

POLL_SECONDS = 0.5
GRACE_SECONDS = 60.0


class Task:
    """Starts a worker and waits for it; nothing of JAX is pickled with it."""

    def __init__(self, command: Sequence[str], log: pathlib.Path, environ: Mapping[str, str]):
        self.command, self.log, self.environ = list(command), str(log.absolute()), dict(environ)
        self.folder = os.getcwd()
        self._process: subprocess.Popen | None = None

    def __call__(self) -> int:
        """The exit status of the worker, once it has done what it can or is asked to end.

        A scheduler that takes the machine away tells the worker to end, too. Then this process will
        be killed and its job queued again; if that does not happen, the worker is started again.
        """
        while True:
            status = self._carry()
            if status != 128 + signal.SIGTERM or stop_file(pathlib.Path(self.log)).exists():
                return status
            time.sleep(GRACE_SECONDS)

    def _carry(self) -> int:
        with open(self.log, "ab") as log:
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
            if stop_file(pathlib.Path(self.log)).exists():
                self.end()
            time.sleep(POLL_SECONDS)
        return status

    def end(self) -> None:
        """The worker saves and ends."""
        if self._process and self._process.stdin:
            self._process.stdin.close()
            self._process.wait()

    def checkpoint(self) -> Any:
        """What Slurm is given to queue again when it takes the machine away."""
        import submitit

        self.end()
        again = Task(self.command, pathlib.Path(self.log), self.environ)
        again.folder = self.folder
        return submitit.helpers.DelayedSubmission(again)


def stop_file(log: pathlib.Path) -> pathlib.Path:
    """That asks the worker of a log to end: the storage is what all machines share."""
    return log.with_name("worker.stop")
