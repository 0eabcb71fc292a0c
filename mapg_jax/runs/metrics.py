"""The rows of a run: metrics.csv and TensorBoard, one row an evaluation."""

import contextlib
import hashlib
import json
import math
import os
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from mapg_jax.runs import csv_file

Row = Mapping[str, int | float]
_START = {"status": 1}  # SessionLog.START: events of later steps, written before, are dropped


class MetricsFile:
    """metrics.csv and TensorBoard, one row an evaluation.

    Columns that depend on the clock, and only those, end in `seconds` or `per_second`.
    """

    def __init__(self, path: pathlib.Path, env_steps: int = 0):
        """Goes on after `env_steps`; TensorBoard drops what it was told of later ones."""
        from tensorboardX import event_file_writer  # slow to import, and needed once a run

        self.path = path
        # Without tensorboardX's thread and queue a row is on the disk when it has been written.
        self._events = event_file_writer.EventsWriter(str(path.parent / "events"))
        self._tell(env_steps + 1, session_log=_START)

    def write(self, row: Row) -> None:
        """Appends a row, `env_steps` first; the first one writes the header."""
        from tensorboardX import summary

        new = not self.path.exists()
        with self.path.open("a", newline="") as file:
            values = [_text(value) for value in row.values()]
            csv_file.lines(file, [list(row), values] if new else [values])
            file.flush()
            os.fsync(file.fileno())
        for name, value in row.items():
            if name != "env_steps" and not math.isnan(value):  # it would warn at each
                self._tell(int(row["env_steps"]), summary=summary.scalar(name, value))
        self._events.flush()

    def _tell(self, step: int, **what: Any) -> None:
        from tensorboardX.proto import event_pb2

        proto: Any = event_pb2  # whose classes protobuf makes at run time
        event = proto.Event(step=step, wall_time=time.time(), **what)
        self._events.write_event(event)

    def close(self) -> None:
        """A row that does not fit the disk is lost to TensorBoard alone."""
        with contextlib.suppress(OSError):
            self._events.close()


def read_metrics(path: pathlib.Path) -> list[dict[str, float]]:
    """The rows of a metrics.csv; none if there is no file.

    Raises:
      ValueError: if it is no such file.
    """
    header, rows = csv_file.read(path, cut_short=True)
    try:
        return [dict(zip(header, map(float, row), strict=True)) for row in rows]
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from None


def cut_metrics(path: pathlib.Path, env_steps: int) -> None:
    """Drops the rows after `env_steps`: those that a resumed run will write again.

    A last line that was cut short is dropped too, and a file left without rows is removed, so that
    the next row writes a whole header.
    """
    header, kept = _until(path, env_steps)
    if kept:
        csv_file.write(path, header, kept)
    else:
        path.unlink(missing_ok=True)


def rows_digest(path: pathlib.Path, env_steps: int) -> str:
    """Of the header and the rows up to `env_steps`: of what `cut_metrics` leaves."""
    header, kept = _until(path, env_steps)
    text = json.dumps([header, *kept] if kept else [])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _until(path: pathlib.Path, env_steps: int) -> tuple[list[str], list[list[str]]]:
    header, rows = csv_file.read(path, cut_short=True)
    return header, [row for row in rows if _step(row) <= env_steps]


def _step(row: list[str]) -> float:
    """Of a row; one that has none is after every step."""
    return int(row[0]) if row[0].isascii() and row[0].isdigit() else math.inf


def _text(value: int | float) -> str:
    """Nine digits: a float32 reads back the same."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"
