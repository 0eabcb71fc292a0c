"""The folders of commands that carry out many runs: which, as data; and that of a sweep."""

import dataclasses
import json
import os
import pathlib
import typing
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from envs.values import fits
from mapg_jax.runs.folder import FORMAT, make_folder, write_json
from mapg_jax.sweeps import grid, launchers
from mapg_jax.sweeps.groups import Grouping, checked_workers
from mapg_jax.training.config import Config


@dataclasses.dataclass(frozen=True)
class FolderOfRuns:
    """Where many runs are kept, and a file that says which and how they are carried out."""

    FILE: ClassVar[str]

    path: pathlib.Path
    preset: str
    values: Mapping[str, Any]
    """Of the fields that are given; all others are the preset's."""
    _: dataclasses.KW_ONLY
    workers: int | None = None
    launcher: launchers.Name = "local"
    launcher_options: tuple[str, ...] = ()

    def __post_init__(self):
        """Refuses what no command line would give, as a damaged file does.

        Raises:
          ValueError: if a field is of another type, or there are no workers.
        """
        hints = typing.get_type_hints(type(self))
        for name in (field.name for field in dataclasses.fields(self)):
            value, hint = getattr(self, name), hints[name]
            if not fits(value, hint):
                expected = hint.__name__ if isinstance(hint, type) else hint
                raise ValueError(f"{name} must be {expected}, got {value!r}")
        checked_workers(self.workers)

    def check(self) -> None:
        """Raises ValueError if its runs cannot be configured."""
        raise NotImplementedError

    def create(self) -> None:
        """Makes the folder and writes the file into it.

        Raises:
          ValueError: if its runs cannot be configured, or the folder exists or cannot be created.
        """
        self.check()
        make_folder(self.path)
        record = {"format": FORMAT, **dataclasses.asdict(self)}
        del record["path"]
        write_json(self.path / self.FILE, record)

    @classmethod
    def is_one(cls, path: str | os.PathLike) -> bool:
        """Whether a folder is one of these."""
        return (pathlib.Path(path) / cls.FILE).is_file()

    @classmethod
    def open(cls, path: str | os.PathLike) -> Self:
        """The folder of an earlier command.

        Raises:
          ValueError: if its file cannot be read.
        """
        path = pathlib.Path(path)
        file = path / cls.FILE
        try:
            record = json.loads(file.read_text())
            if (found := record.pop("format", 1)) != FORMAT:
                raise ValueError(f"it is of format {found!r}, and this version reads {FORMAT}")
            folder = cls.of_record(path, _with_tuples(record))
            folder.check()
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{file} is damaged: {error}") from None
        return folder

    @classmethod
    def of_record(cls, path: pathlib.Path, record: dict[str, Any]) -> Self:
        """What the file holds, as it was."""
        return cls(path, **record)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepFolder(FolderOfRuns):
    """Where a sweep keeps its grid and its runs; several values a field."""

    FILE: ClassVar[str] = "sweep.json"

    group: Grouping = "auto"
    keep_replay: bool = False

    def runs(self) -> list[tuple[Config, pathlib.Path]]:
        """Each cell and its run folder.

        Raises:
          ValueError: if the grid is empty or a cell cannot be configured.
        """
        cells = grid.expand(self.preset, self.values)
        names = grid.names(cells, self.values)
        return [(cell, self.path / name) for cell, name in zip(cells, names, strict=True)]

    def check(self) -> None:
        self.runs()


def _with_tuples(value: Any) -> Any:
    """Of JSON, which has lists alone."""
    if isinstance(value, dict):
        return {name: _with_tuples(part) for name, part in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value
