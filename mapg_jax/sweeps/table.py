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
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.sweeps.groups import Group, Job


class SweepTable:
    """Progress as the run folders' metrics.csv tell it; on standard error."""

    def __init__(self, waiting: Sequence[Group], workers: int, enabled: bool = True):
        console = rich.console.Console(stderr=True)
        self._lines = enabled and not console.is_terminal
        self._live = rich.live.Live(console=console) if enabled and not self._lines else None
        self._groups = {group[0].path: group for group in waiting}
        self._total, self._workers = sum(map(len, waiting)), workers
        self._active: dict[pathlib.Path, RunFolder] = {}
        self._finished: set[pathlib.Path] = set()
        self._paces: list[float] = []  # of the finished ones
        self._failed: set[pathlib.Path] = set()
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
            self._finished.add(folder.path)
            self._paces.append(_pace(last))
            text = f"finished, return {last['return_mean']:.1f}"
        else:
            self._failed.add(folder.path)
            self.failures.append(f"{folder.path}: {failure}")
            text = f"FAILED: {failure}"
        done = len(self._finished) + len(self.failures)
        left = self._left(self._newest_rows())
        self._say(f"{folder.path.name}: {text} ({done} of {self._total}, {left} left)")

    def update(self) -> None:
        """Draws the table anew."""
        if self._live:
            self._live.update(self._table())

    def _say(self, line: str) -> None:
        if self._lines:
            print(line, file=sys.stderr, flush=True)

    def _newest_rows(self) -> dict[pathlib.Path, dict[str, float]]:
        """The last evaluation of each run under way that has one."""
        rows = {path: read_metrics(folder.metrics) for path, folder in self._active.items()}
        return {path: of_run[-1] for path, of_run in rows.items() if of_run}

    def _table(self) -> rich.table.Table:
        newest = self._newest_rows()
        done = len(self._finished) + len(self.failures)
        failed = f", {len(self.failures)} failed" if self.failures else ""
        caption = f"{done} of {self._total} runs done{failed}; {self._left(newest)} left"
        titles = ("run", "progress", "return", "steps/s", "time left")
        table = rich.table.Table(*titles, caption=caption)
        for path, folder in self._active.items():
            if path not in newest:
                table.add_row(path.name, "0 %", "-", "-", "-")
                continue
            last = newest[path]
            table.add_row(
                path.name,
                f"{last['env_steps'] / folder.config.steps:.0%}",
                f"{last['return_mean']:.1f} ± {last['return_std']:.1f}",
                f"{last['steps_per_second']:,.0f}",
                _clock(_seconds_left(folder.config.steps, last)),
            )
        return table

    def _left(self, newest: Mapping[pathlib.Path, Mapping[str, float]]) -> str:
        """Time left for all groups, at the mean pace so far; evaluations included."""
        paces = [*self._paces, *map(_pace, newest.values())]
        if not paces:
            return "unknown time"
        seconds = 0.0
        for first, group in self._groups.items():
            steps = group[0].config.steps
            if first in newest:
                seconds += _seconds_left(steps, newest[first])
            elif first not in self._finished | self._failed | set(self._active):
                seconds += steps * statistics.mean(paces)
        return _clock(seconds / self._workers)


def _pace(last: Mapping[str, float]) -> float:
    """Seconds per environment step so far."""
    return last["seconds"] / last["env_steps"]


def _seconds_left(steps: int, last: Mapping[str, float]) -> float:
    return max(0.0, steps - last["env_steps"]) * _pace(last)


def _clock(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))
