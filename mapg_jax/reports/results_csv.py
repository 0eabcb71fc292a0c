"""Files of results: CSV, a row for each finished run."""

import functools
import itertools
import os
import pathlib
import typing
from collections.abc import Sequence
from typing import Any

from mapg_jax.algorithms import registry
from mapg_jax.reports.results import COLUMNS, HOST, Result, finite, merge
from mapg_jax.runs import csv_file

MOST_ROWS = 200_000
"""Of a file: a minute's reading."""
_HINTS = typing.get_type_hints(Result)


def read_csv(path: str | os.PathLike) -> list[Result]:
    """The rows of a results CSV; none if there is no file.

    Raises:
      ValueError: if a column is missing or unknown, or a number is not one.
    """
    path = pathlib.Path(path)
    if not path.exists():
        return []
    header, rows = csv_file.read(path)
    if len(rows) > MOST_ROWS:
        raise ValueError(
            f"{path} has {len(rows):,} rows, more than {MOST_ROWS:,}; make parts of it"
        )
    required = tuple(name for name in COLUMNS if name not in HOST)
    if tuple(header[: len(required)]) != required:
        raise ValueError(
            f"{path} is no CSV of results: its columns are {','.join(header)[:200]}, "
            f"not {','.join(required)}"
        )
    return [_parse(header, row, f"{path}, row {number}") for number, row in enumerate(rows, 2)]


def append_csv(path: str | os.PathLike, results: Sequence[Result]) -> None:
    """Adds those results that the file lacks: all of them or, if that fails, none.

    Raises:
      ValueError: if a run is there with another score, or the file is damaged.
    """
    path = pathlib.Path(path)
    rows = merge(itertools.chain(read_csv(path), results))
    path.parent.mkdir(parents=True, exist_ok=True)
    own = list(dict.fromkeys(name for result in rows for name in result.metrics))
    cells = (
        [*map(_as_text, result[:-1]), *(result.metrics.get(name, "") for name in own)]
        for result in rows
    )
    csv_file.write(path, [*COLUMNS, *own], cells)


def _as_text(cell: Any) -> Any:
    """A cell that a spreadsheet would take for a formula is marked as text."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell


def _parse(header: Sequence[str], row: Sequence[str], where: str) -> Result:
    """Texts as the types of the fields; further columns are numbers of some environment."""
    if len(row) != len(header):
        raise ValueError(f"{where} has {len(row)} cells, not {len(header)}")
    values: dict[str, Any] = {"metrics": {}}
    for name, text in zip(header, row, strict=True):
        try:
            if name in COLUMNS:
                kind = _HINTS[name]
                values[name] = finite(text) if kind is float else kind(text)
            elif text:
                values["metrics"][name] = finite(text)
        except ValueError:
            raise ValueError(f"{where}: {name} is no number: {text!r}") from None
    result = Result(**values)
    try:
        _known(result.algorithm, result.heads)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return result


_known = functools.cache(registry.of_slug)  # which asks installed packages
