"""What is measured on finished runs, as rows of CSV files beside the scores."""

import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from mapg_jax.reports.results import RunKey, run_key
from mapg_jax.runs import csv_file
from mapg_jax.training.config import Config

Row = Mapping[str, Any]
COLUMNS = RunKey._fields
"""Say which run a row is of."""
DIVERGED = "diverged.csv"


def identity(config: Config) -> dict[str, str]:
    """COLUMNS of a run; text, as a CSV file gives it back."""
    return {name: str(value) for name, value in run_key(config)._asdict().items()}


def keys(runs: Sequence[Config]) -> set[tuple[str, ...]]:
    """COLUMNS of each of those runs."""
    return {tuple(identity(config).values()) for config in runs}


def read(path: pathlib.Path, columns: Sequence[str] = ()) -> list[dict[str, str]]:
    """The rows of a file; none if there is no file.

    Raises:
      ValueError: if it is damaged, or lacks one of the columns.
    """
    if not path.exists():
        return []
    state = path.stat()
    header, found = _read(path, (state.st_ino, state.st_mtime_ns, state.st_size))
    if lacking := [name for name in columns if name not in header]:
        raise ValueError(f"{path} is damaged: it has no column {', '.join(lacking)}")
    return found


@functools.lru_cache(maxsize=16)
def _read(path: pathlib.Path, state: tuple[int, ...]) -> tuple[list[str], list[dict[str, str]]]:
    """Once while the file stays as it is: a page asks for the same rows many times."""
    header, found = csv_file.read(path)
    if any(len(row) != len(header) for row in found):
        raise ValueError(f"{path} is damaged: a row has other columns than the header")
    return header, [dict(zip(header, row, strict=True)) for row in found]


def holds(path: pathlib.Path, key: Row) -> bool:
    """Whether a file has rows of that run."""
    return any(all(row.get(k) == v for k, v in key.items()) for row in read(path))


def append(path: pathlib.Path, new: Sequence[Row]) -> None:
    """Adds rows to a file, all or none, with a header if it is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = list(new[0])
    csv_file.write(path, header, ([row[name] for name in header] for row in [*read(path), *new]))


def of(
    path: pathlib.Path, runs: Sequence[Config], numbers: Sequence[str] = (), each: str = ""
) -> list[dict[str, Any]]:
    """The rows of those runs.

    Args:
      path: of the file.
      runs: whose rows are wanted.
      numbers: columns that are read as numbers.
      each: the column that tells the rows of a run apart, where it has several.

    Raises:
      ValueError: if the file is damaged: a column is missing, a number is none, or a row is double.
    """
    wanted = keys(runs)
    apart = (*COLUMNS, each) if each else COLUMNS
    found: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in read(path, (*apart, *numbers)):
        if tuple(row[k] for k in COLUMNS) not in wanted:
            continue
        key = tuple(row[k] for k in apart)
        if key in found:
            run = f"{row['env']}, {row['algorithm']}, M = {row['heads']}, seed {row['seed']}"
            raise ValueError(f"{path} holds {run} twice; leave one out")
        found[key] = {**row, **{name: _number(path, row, name) for name in numbers}}
    return list(found.values())


def runs_in(path: pathlib.Path, runs: Sequence[Config]) -> set[tuple[str, ...]]:
    """Which of those runs have rows, by their COLUMNS."""
    return keys(runs) & {tuple(row[k] for k in COLUMNS) for row in read(path, COLUMNS)}


def _number(path: pathlib.Path, row: Mapping[str, str], name: str) -> float:
    try:
        return float(row[name])
    except ValueError:
        raise ValueError(
            f"{path} is damaged: {name} of {row['env']}, seed {row['seed']} is {row[name]!r}"
        ) from None


def missing(runs: Sequence[Config]) -> str:
    """What a section says that has nothing to show yet."""
    return f"Missing: none of its {len(set(runs))} runs has finished."
