"""What is measured on finished runs, as rows of CSV files beside the scores."""

import csv
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from mapg_jax.reports.results import Result, settings
from mapg_jax.training.config import Config

Row = Mapping[str, Any]
COLUMNS = ("env", "algorithm", "heads", "seed", "steps", "settings")
"""Say which run a row is of."""
DIVERGED = "diverged.csv"


def identity(config: Config) -> dict[str, str]:
    """COLUMNS of a run; text, as a CSV file gives it back."""
    return {
        "env": config.env,
        "algorithm": config.slug,
        "heads": str(config.heads),
        "seed": str(config.seed),
        "steps": str(config.steps),
        "settings": settings(config),
    }


def identity_of(result: Result) -> dict[str, str]:
    """The same columns of a result."""
    return {k: str(getattr(result, k)) for k in COLUMNS}


def read(path: pathlib.Path) -> list[dict[str, str]]:
    """The rows of a file; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        found = list(csv.DictReader(file))
    if any(None in row or None in row.values() for row in found):
        raise ValueError(f"{path} is damaged: a row has other columns than the header")
    return found


def holds(path: pathlib.Path, key: Row) -> bool:
    """Whether a file has rows of that run."""
    return any(all(row.get(k) == v for k, v in key.items()) for row in read(path))


def append(path: pathlib.Path, new: Sequence[Row]) -> None:
    """Adds rows to a file, all or none, with a header if it is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(new[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows([*read(path), *new])
    partial.replace(path)


def of(path: pathlib.Path, runs: Sequence[Config]) -> list[dict[str, str]]:
    """The rows of those runs."""
    keys = [identity(config) for config in runs]
    found = read(path)
    if found and (lacking := set(COLUMNS) - set(found[0])):
        raise ValueError(f"{path} is damaged: it has no column {', '.join(sorted(lacking))}")
    return [row for row in found if {k: row[k] for k in COLUMNS} in keys]


def missing(runs: Sequence[Config]) -> str:
    """What a section says that has nothing to show yet."""
    return f"Missing: none of its {len(set(runs))} runs has finished."
