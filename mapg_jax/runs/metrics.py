"""What a run tells while it goes: metrics.csv, TensorBoard and the progress line."""

import csv
import math
import os
import pathlib
import sys
from collections.abc import Mapping

import rich.console
import rich.progress
import tensorboardX

Row = Mapping[str, int | float]


class MetricsFile:
    """metrics.csv and TensorBoard, one row an evaluation.

    Columns that depend on the clock, and only those, end in `seconds` or `per_second`.
    """

    def __init__(self, path: pathlib.Path, env_steps: int = 0):
        """Goes on after `env_steps`; TensorBoard drops what it was told of later ones."""
        self.path = path
        self._writer = tensorboardX.SummaryWriter(str(path.parent), purge_step=env_steps + 1)

    def write(self, row: Row) -> None:
        """Appends a row, `env_steps` first; the first one writes the header."""
        new = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(row)
            writer.writerow(_text(value) for value in row.values())
            file.flush()
            os.fsync(file.fileno())
        for name, value in row.items():
            if name != "env_steps" and not math.isnan(value):  # it would warn at each
                self._writer.add_scalar(name, value, int(row["env_steps"]))

    def close(self) -> None:
        self._writer.close()


def read_metrics(path: pathlib.Path) -> list[dict[str, float]]:
    """The rows of a metrics.csv; none if there is no file."""
    header, *rows = _table(path)
    return [dict(zip(header, map(float, row), strict=True)) for row in rows]


def cut_metrics(path: pathlib.Path, env_steps: int) -> None:
    """Drops the rows after `env_steps`: those that a resumed run will write again.

    A last line that was cut short is dropped too, and a file left without rows is removed, so that
    the next row writes a whole header.
    """
    header, *rows = _table(path)
    kept = [row for row in rows if row[0].isdigit() and int(row[0]) <= env_steps]
    if not kept:
        path.unlink(missing_ok=True)
        return
    partial = path.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        csv.writer(file).writerows([header, *kept])
    partial.replace(path)


def _table(path: pathlib.Path) -> list[list[str]]:
    """The header and the rows, but for a line that was cut short as it was written."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    header, *rows = list(csv.reader(line for line in lines if line.endswith("\n"))) or [[]]
    return [header, *(row for row in rows if len(row) == len(header))]


def _text(value: int | float) -> str:
    """Nine digits: a float32 reads back the same."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"


class Progress:
    """A bar on a terminal, a line an evaluation elsewhere; both on standard error."""

    def __init__(self, total_steps: int, enabled: bool = True):
        console = rich.console.Console(stderr=True)
        self._lines = enabled and not console.is_terminal
        self._total = total_steps
        self._bar = rich.progress.Progress(
            rich.progress.BarColumn(bar_width=None),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TextColumn("return {task.fields[episode_return]}"),
            rich.progress.TextColumn("{task.fields[rate]} steps/s"),
            rich.progress.TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            disable=not enabled or self._lines,
        )
        self._task = self._bar.add_task("", total=total_steps, episode_return="-", rate="-")

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()

    def advance(self, env_steps: int, steps_per_second: float) -> None:
        """Moves the bar."""
        self._bar.update(self._task, completed=env_steps, rate=f"{steps_per_second:,.0f}")

    def learning(self) -> None:
        """Says that the first updates are made: everything is compiled."""
        if self._lines:
            print("learning", file=sys.stderr, flush=True)

    def evaluated(self, row: Row, seconds_left: float) -> None:
        """Shows an evaluation's return."""
        text = f"{row['return_mean']:.1f} ± {row['return_std']:.1f}"
        self._bar.update(self._task, episode_return=text)
        if self._lines:
            print(
                f"step {int(row['env_steps']):,} of {self._total:,}: return {text}, "
                f"{row['steps_per_second']:,.0f} steps/s, {seconds_left:,.0f} s left",
                file=sys.stderr,
                flush=True,
            )
