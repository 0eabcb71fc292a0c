"""SIGINT and SIGTERM as requests to stop, obeyed once the state is saved."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import NoReturn


class StoppedError(Exception):
    """A signal asked to stop; all state is saved."""

    def __init__(self, number: int, command: str):
        super().__init__(f"stopped by {signal.Signals(number).name}; go on with: {command}")
        self.number = number


ABANDONED = "abandoned by a signal"
"""Name of a thread that nobody waits for."""


def leave(status: int) -> NoReturn:
    """Ends the process; a thread inside of XLA, which does not look up, would hold up an exit."""
    if any(thread.name == ABANDONED for thread in threading.enumerate()):
        leave_at_once(status)
    sys.exit(status)


def leave_at_once(status: int) -> NoReturn:
    """Ends the process, waiting for no thread and no other process."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


@contextlib.contextmanager
def caught_signals() -> Iterator[list[int]]:
    """SIGINT and SIGTERM in a list instead of an exception; a second one acts as usual.

    One that is ignored, as SIGINT is in a shell's background jobs, stays ignored.
    """
    caught: list[int] = []
    previous = {}

    def handle(number, _frame):
        caught.append(number)
        signal.signal(number, previous[number])

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, handle)
    try:
        yield caught
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
