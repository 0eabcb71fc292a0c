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


def read(path: pathlib.Path) -> list[dict[str, str]]:
    """The rows of a file; none if there is no file."""
    if not path.exists():
        return []
    state = path.stat()
    return _read(path, (state.st_ino, state.st_mtime_ns, state.st_size))


@functools.lru_cache(maxsize=16)
def _read(path: pathlib.Path, state: tuple[int, ...]) -> list[dict[str, str]]:
    """Once while the file stays as it is: a page asks for the same rows many times."""
    header, found = csv_file.read(path)
    if any(len(row) != len(header) for row in found):
        raise ValueError(f"{path} is damaged: a row has other columns than the header")
    return [dict(zip(header, row, strict=True)) for row in found]


def holds(path: pathlib.Path, key: Row) -> bool:
    """Whether a file has rows of that run."""
    return any(all(row.get(k) == v for k, v in key.items()) for row in read(path))


def append(path: pathlib.Path, new: Sequence[Row]) -> None:
    """Adds rows to a file, all or none, with a header if it is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = list(new[0])
    csv_file.write(path, header, ([row[name] for name in header] for row in [*read(path), *new]))


def of(path: pathlib.Path, runs: Sequence[Config]) -> list[dict[str, str]]:
    """The rows of those runs."""
    keys = {tuple(identity(config).values()) for config in runs}
    found = read(path)
    if found and (lacking := set(COLUMNS) - set(found[0])):
        raise ValueError(f"{path} is damaged: it has no column {', '.join(sorted(lacking))}")
    return [row for row in found if tuple(row[k] for k in COLUMNS) in keys]


def missing(runs: Sequence[Config]) -> str:
    """What a section says that has nothing to show yet."""
    return f"Missing: none of its {len(set(runs))} runs has finished."
