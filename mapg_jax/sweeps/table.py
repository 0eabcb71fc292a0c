"""What a sweep tells while it goes: a live table on a terminal, a line an event elsewhere."""

import datetime
import pathlib
import statistics
import sys
from collections.abc import Mapping, Sequence

import rich.console
import rich.live
import rich.table

from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import Row, read_metrics
from mapg_jax.sweeps.groups import Group, Job


class SweepTable:
    """Progress as the run folders' metrics.csv tell it; on standard error."""

    def __init__(self, waiting: Sequence[Group], workers: int, enabled: bool = True):
        console = rich.console.Console(stderr=True)
        self._lines = enabled and not console.is_terminal
        self._live = rich.live.Live(console=console) if enabled and not self._lines else None
        self._groups = {group[0].path: group for group in waiting}
        self._steps = {job.path: job.config.steps for group in waiting for job in group}
        self._workers = workers
        self._active: dict[pathlib.Path, RunFolder] = {}
        self._ended: dict[pathlib.Path, tuple[str, Row | None]] = {}
        """What became of a run, and its last evaluation, in the order in which they ended."""
        self.failures: list[str] = []

    def __enter__(self) -> "SweepTable":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_) -> None:
        if self._live:
            self._live.stop()

    def started(self, folders: Sequence[RunFolder]) -> None:
        """A group is under way."""
        for folder in folders:
            self._active[folder.path] = folder
            self._say(f"{folder.path.name}: under way")

    def retried(self, folder: RunFolder, failure: str) -> None:
        """The group of a run has failed, and the run is tried by itself."""
        del self._active[folder.path]
        self._groups[folder.path] = (Job(folder.config, folder.path),)
        self._say(f"{folder.path.name}: its group failed, to be tried by itself: {failure}")

    def ended(self, folder: RunFolder, failure: str | None) -> None:
        """A run is finished, or has failed."""
        del self._active[folder.path]
        if failure is None:
            last = read_metrics(folder.metrics)[-1]
            self._ended[folder.path] = "finished", last
            text = f"finished, return {last['return_mean']:.1f}"
        else:
            self._ended[folder.path] = "FAILED", None
            self.failures.append(f"{folder.path}: {failure}")
            text = f"FAILED: {failure}"
        self._say(f"{folder.path.name}: {text} ({self._summary(self._newest_rows())})")

    def update(self) -> None:
        """Draws the table anew."""
        if self._live:
            self._live.update(self.view())

    def view(self) -> rich.console.Group:
        """How far all are; a row a run under way, and then those that have ended, newest first.

        What does not fit the terminal is cut off below: the first that have ended.
        """
        newest = self._newest_rows()
        titles = ("run", "progress", "return", "steps/s", "time left")
        table = rich.table.Table(*titles)
        for path in self._active:
            steps, last = self._steps[path], newest.get(path)
            share, left = "0 %", "-"
            if last:
                share = f"{last['env_steps'] / steps:.0%}"
                left = _clock(_seconds_left(steps, last))
            table.add_row(path.name, share, *_scores(last), left)
        for path, (outcome, last) in reversed(self._ended.items()):
            table.add_row(path.name, outcome, *_scores(last), "")
        return rich.console.Group(self._summary(newest), table)

    def _say(self, line: str) -> None:
        if self._lines:
            print(line, file=sys.stderr, flush=True)

    def _newest_rows(self) -> dict[pathlib.Path, Row]:
        """The last evaluation of each run under way that has one."""
        rows = {path: read_metrics(folder.metrics) for path, folder in self._active.items()}
        return {path: of_run[-1] for path, of_run in rows.items() if of_run}

    def _summary(self, newest: Mapping[pathlib.Path, Row]) -> str:
        """How far all runs are, those under way counted by their steps."""
        failed = f", {len(self.failures)} failed" if self.failures else ""
        taken = sum(self._steps[path] for path in self._ended)
        taken += sum(min(self._steps[path], row["env_steps"]) for path, row in newest.items())
        share = taken / sum(self._steps.values())
        return (
            f"{len(self._ended)} of {len(self._steps)} runs done{failed}; "
            f"{share:.0%} of all steps; {self._left(newest)} left"
        )

    def _left(self, newest: Mapping[pathlib.Path, Row]) -> str:
        """Time left for all groups, at the mean pace so far; evaluations included."""
        rows = [*newest.values(), *(last for _, last in self._ended.values() if last)]
        if not rows:
            return "unknown time"
        pace = statistics.mean(map(_pace, rows))
        seconds = 0.0
        for first in self._groups.keys() - self._ended.keys():
            steps = self._steps[first]
            known = newest.get(first)
            seconds += _seconds_left(steps, known) if known else steps * pace
        return _clock(seconds / self._workers)


def _scores(last: Row | None) -> tuple[str, str]:
    """Return and pace of an evaluation."""
    if last is None:
        return "-", "-"
    return (
        f"{last['return_mean']:.1f} ± {last['return_std']:.1f}",
        f"{last['steps_per_second']:,.0f}",
    )


def _pace(last: Row) -> float:
    """Seconds per environment step so far."""
    return last["seconds"] / last["env_steps"]


def _seconds_left(steps: int, last: Row) -> float:
    return max(0.0, steps - last["env_steps"]) * _pace(last)


def _clock(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))
