"""What a sweep tells while it goes: a live table on a terminal, a line an event elsewhere."""

import datetime
import pathlib
import statistics
import sys
from collections.abc import Sequence

import rich.console
import rich.live
import rich.table

from mapg_jax.grouping import Group, Job
from mapg_jax.run_folder import RunFolder
from mapg_jax.tracking import read_metrics


class SweepTable:
    """Progress as the run folders' metrics.csv tell it; on standard error."""

    def __init__(self, waiting: Sequence[Group], workers: int, enabled: bool = True):
        console = rich.console.Console(stderr=True)
        self._lines = enabled and not console.is_terminal
        self._live = rich.live.Live(console=console) if enabled and not self._lines else None
        self._groups = {group[0].path: group for group in waiting}
        self._total, self._workers = sum(map(len, waiting)), workers
        self._active: dict[pathlib.Path, RunFolder] = {}
        self._finished: list[RunFolder] = []
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
            self._finished.append(folder)
            text = f"finished, return {read_metrics(folder.metrics)[-1]['return_mean']:.1f}"
        else:
            self._failed.add(folder.path)
            self.failures.append(f"{folder.path}: {failure}")
            text = f"FAILED: {failure}"
        done = len(self._finished) + len(self.failures)
        self._say(f"{folder.path.name}: {text} ({done} of {self._total}, {self._left()} left)")

    def update(self) -> None:
        """Draws the table anew."""
        if self._live:
            self._live.update(self._table())

    def _say(self, line: str) -> None:
        if self._lines:
            print(line, file=sys.stderr, flush=True)

    def _table(self) -> rich.table.Table:
        done = len(self._finished) + len(self.failures)
        failed = f", {len(self.failures)} failed" if self.failures else ""
        caption = f"{done} of {self._total} runs done{failed}; {self._left()} left"
        titles = ("run", "progress", "return", "steps/s", "time left")
        table = rich.table.Table(*titles, caption=caption)
        for folder in self._active.values():
            rows, steps = read_metrics(folder.metrics), folder.config.steps
            if not rows:
                table.add_row(folder.path.name, "0 %", "-", "-", "-")
                continue
            last, seconds = rows[-1], _seconds_left(folder)
            table.add_row(
                folder.path.name,
                f"{last['env_steps'] / steps:.0%}",
                f"{last['return_mean']:.1f} ± {last['return_std']:.1f}",
                f"{last['steps_per_second']:,.0f}",
                "-" if seconds is None else _clock(seconds),
            )
        return table

    def _left(self) -> str:
        """Time left for all groups, at the mean pace so far; evaluations included."""
        known = (*self._finished, *self._active.values())
        paces = [pace for folder in known if (pace := _pace(folder)) is not None]
        if not paces:
            return "unknown time"
        ended = {folder.path for folder in self._finished} | self._failed
        seconds = 0.0
        for first, group in self._groups.items():
            if first in self._active:
                seconds += _seconds_left(self._active[first]) or 0.0
            elif first not in ended:
                seconds += group[0].config.steps * statistics.mean(paces)
        return _clock(seconds / self._workers)


def _pace(folder: RunFolder) -> float | None:
    """Seconds per environment step so far."""
    rows = read_metrics(folder.metrics)
    return rows[-1]["seconds"] / rows[-1]["env_steps"] if rows else None


def _seconds_left(folder: RunFolder) -> float | None:
    rows, pace = read_metrics(folder.metrics), _pace(folder)
    if pace is None:
        return None
    return max(0.0, folder.config.steps - rows[-1]["env_steps"]) * pace


def _clock(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))
