"""CSV files: read as text, and written whole or not at all."""

import csv
import io
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

from mapg_jax.runs.whole_file import whole_file


def read(path: pathlib.Path, *, cut_short: bool = False) -> tuple[list[str], list[list[str]]]:
    """The header and the rows; nothing and none if there is no file, or it is empty.

    Args:
      path: the file.
      cut_short: whether a process can have ended as it wrote a line, which is then left out.

    Raises:
      ValueError: if it is no CSV.
    """
    try:
        text = path.read_text("utf-8") if path.exists() else ""
        if cut_short:
            text = text[: text.rfind("\n") + 1]
        header, *rows = list(csv.reader(io.StringIO(text), strict=True)) or [[]]
    except (csv.Error, OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no CSV: {error}") from None
    if cut_short:
        rows = [row for row in rows if len(row) == len(header)]
    return header, rows


def write(path: pathlib.Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes the whole file, or leaves the old one."""
    with whole_file(path) as file:
        lines(file, [header, *rows])


def lines(file: Any, rows: Iterable[Sequence[Any]]) -> None:
    """Writes rows to an open file."""
    csv.writer(file, lineterminator="\n").writerows(rows)
