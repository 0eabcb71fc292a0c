"""python -m mapg_jax.sweeps.worker FOLDER…: one process of a sweep, which does one group of runs.

What became of a run stands in its folder: evaluation.json where it finished, failure.txt where not.
"""

import argparse
import contextlib
import os
import pathlib
import signal
import threading
from collections.abc import Collection, Sequence

from mapg_jax.runs.finishing import finish
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.locking import Lock
from mapg_jax.runs.member import DivergedError
from mapg_jax.runs.memory import prepare
from mapg_jax.runs.run import Run
from mapg_jax.runs.signals import StoppedError, caught_signals, leave
from mapg_jax.training import plugins


def failure_file(path: pathlib.Path) -> pathlib.Path:
    """Where it is written why a run failed."""
    return path / "failure.txt"


def work(folders: Sequence[RunFolder], keep_replay: bool, idle: Collection[int] = ()) -> None:
    """Takes a group to its end; a run of it that fails does not stop the others.

    Args:
      folders: of the group.
      keep_replay: whether what finishes can be trained further.
      idle: the numbers of those that only keep their places in the program.
    """
    locks = [_lock(folder) for k, folder in enumerate(folders) if k not in idle]
    run = Run(prepare(*(folder.config for folder in folders)), folders, locks, idle)
    run.restore()
    if not run.finished:
        # The last one left raises; each member has its own failure.
        with contextlib.suppress(DivergedError), caught_signals() as signals:
            run.go(signals=signals)
    for member in (member for k, member in enumerate(run.members) if k not in idle):
        if member.failure is None:
            finish(member.folder, keep_replay)
            failure_file(member.folder.path).unlink(missing_ok=True)  # of an earlier process
        else:
            failure_file(member.folder.path).write_text(f"{member.failure}\n")


def _lock(folder: RunFolder) -> Lock:
    """Of a run; the worker of a sweep that was killed may still be about to save it."""
    try:
        return folder.lock()
    except BlockingIOError as error:
        print(f"{error}, and is waited for", flush=True)
        return folder.lock(wait=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--keep-replay", action="store_true")
    parser.add_argument("--idle", type=int, action="append", default=[])
    plugins.add_argument(parser)
    parser.add_argument("folders", nargs="+")
    arguments = parser.parse_args()
    threading.Thread(target=_stop_with_the_parent, daemon=True).start()
    plugins.load(arguments.imports)
    try:
        folders = [RunFolder.open(path) for path in arguments.folders]
        work(folders, arguments.keep_replay, arguments.idle)
    except StoppedError as stopped:
        leave(128 + stopped.number)


def _stop_with_the_parent() -> None:
    """Standard input is a pipe that the parent never writes to: it ends where the parent does."""
    while os.read(0, 1):  # not sys.stdin, whose lock would abort an exit while this waits
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
