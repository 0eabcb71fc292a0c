"""The folder of a sweep: its grid as data, and a run folder for each cell."""

import dataclasses
import json
import os
import pathlib
from typing import Any

from mapg_jax.runs.folder import FORMAT, make_folder, write_json
from mapg_jax.sweeps import grid, launchers
from mapg_jax.sweeps.groups import Grouping
from mapg_jax.training.config import Config


@dataclasses.dataclass(frozen=True)
class SweepFolder:
    """Where a sweep keeps its grid and its runs."""

    path: pathlib.Path
    preset: str
    values: grid.Values
    """Of the fields that are given; all others are the preset's."""
    group: Grouping = "auto"
    workers: int | None = None
    keep_replay: bool = False
    launcher: launchers.Name = "local"
    launcher_options: tuple[str, ...] = ()

    def runs(self) -> list[tuple[Config, pathlib.Path]]:
        """Each cell and its run folder.

        Raises:
          ValueError: if the grid is empty or a cell cannot be configured.
        """
        cells = grid.expand(self.preset, self.values)
        names = grid.names(cells, self.values)
        return [(cell, self.path / name) for cell, name in zip(cells, names, strict=True)]

    def create(self) -> None:
        """Makes the folder and writes the grid into it.

        Raises:
          ValueError: if the folder exists or cannot be created.
        """
        make_folder(self.path)
        record = {"format": FORMAT, **dataclasses.asdict(self)}
        del record["path"]
        write_json(self.path / "sweep.json", record)

    @classmethod
    def is_one(cls, path: str | os.PathLike) -> bool:
        """Whether a folder is that of a sweep."""
        return (pathlib.Path(path) / "sweep.json").is_file()

    @classmethod
    def open(cls, path: str | os.PathLike) -> "SweepFolder":
        """The folder of an earlier sweep.

        Raises:
          ValueError: if its grid cannot be read.
        """
        path = pathlib.Path(path)
        file = path / "sweep.json"
        try:
            record = json.loads(file.read_text())
            if (found := record.pop("format", 1)) != FORMAT:
                raise ValueError(f"it is of format {found!r}, and this version reads {FORMAT}")
            values = {k: tuple(map(_as_tuple, v)) for k, v in record.pop("values").items()}
            options = tuple(record.pop("launcher_options", ()))
            folder = cls(path, values=values, launcher_options=options, **record)
            folder.runs()
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{file} is damaged: {error}") from None
        return folder


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
