"""The folder of a run: data only, nothing in it is executed or unpickled when it is read."""

import contextlib
import dataclasses
import datetime
import hashlib
import importlib.metadata
import json
import os
import pathlib
import platform
import shlex
import stat
import sys
from collections.abc import Mapping
from typing import Any

from mapg_jax.runs import locking
from mapg_jax.runs.whole_file import whole_file
from mapg_jax.training.config import Config, fields

FORMAT = 5
"""Of run folders; a default that changes begins a new one. Format 1 (no number in it) had one list
of fields for all algorithms; the states of format 2 know no head that is held, those of format 3
count no broken steps; the digest of format 4 was over all fields."""
BITS = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
"""Packages whose versions can change last bits."""
CONFIG_BYTES = 1_000_000
"""Of config.json, at most: a thousand resumptions take less."""
PACKAGES = ("mapg-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "brax", "mujoco",
            "mujoco-mjx", "gymnasium", "numpy")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Where a run keeps its configuration, metrics, checkpoints and evaluation."""

    path: pathlib.Path
    config: Config

    @property
    def metrics(self) -> pathlib.Path:
        return self.path / "metrics.csv"

    @property
    def checkpoints(self) -> pathlib.Path:
        return self.path / "checkpoints"

    @property
    def evaluation(self) -> pathlib.Path:
        return self.path / "evaluation.json"

    @property
    def curve(self) -> pathlib.Path:
        return self.path / "curve.png"

    @property
    def digest(self) -> str:
        """Of the configuration, without the steps, of which a run can be given more.

        Fields that have their defaults are left out: one that comes later changes nothing.
        """
        usual = {name: field.default for name, field in fields(type(self.config)).items()}
        values = {k: v for k, v in values_of(self.config).items() if v != usual[k]}
        said = {**values, "algorithm": self.config.algorithm, "steps": None}
        text = json.dumps(said, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @classmethod
    def create(cls, path: str | os.PathLike | None, config: Config) -> "RunFolder":
        """A new folder with the configuration in it.

        Args:
          path: must not exist, or be empty; None takes the next free number under `runs/`.
          config: of the run.

        Raises:
          ValueError: if the folder holds something or cannot be created.
        """
        path = _next_free(config) if path is None else pathlib.Path(path)
        make_folder(path)
        folder = cls(path, config)
        folder.write_config()
        return folder

    @classmethod
    def open(cls, path: str | os.PathLike) -> "RunFolder":
        """The folder of an earlier run.

        Raises:
          ValueError: if there is no run, or its configuration cannot be read.
        """
        path = pathlib.Path(path)
        file = path / "config.json"
        if not path.is_dir():
            raise ValueError(f"there is no run folder {path}")
        if not file.is_file():
            raise ValueError(f"{path} is not a run folder: it has no config.json")
        refuse_special_files(path)
        record = _read_record(file)
        try:
            found, values = record.get("format", 1), record["config"]
            config = parse_config(values) if found == FORMAT else None
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} is damaged: {error}") from None
        if config is None:
            raise ValueError(
                f"{path} is a run folder of format {found!r}, and this version reads format "
                f"{FORMAT}; use the version of mapg-jax that its config.json names"
            )
        return cls(path, config)

    def write_config(self) -> None:
        """Everything needed to run it again, and every command that went on with it."""
        file = self.path / "config.json"
        earlier = _read_record(file)["history"] if file.exists() else []
        history = [*earlier, this_process()]
        write_json(file, {"format": FORMAT, "config": values_of(self.config), "history": history})

    def write_host(self, host: Mapping[str, str]) -> None:
        """What this process, the last of the history, trains by; see `host.this_host`."""
        file = self.path / "config.json"
        record = _read_record(file)
        record["history"][-1]["host"] = dict(host)
        write_json(file, record)

    def differences(self, host: Mapping[str, str]) -> list[str]:
        """What the process that trained last had otherwise than this one, as far as bits go."""
        last = _read_record(self.path / "config.json")["history"][-1:]
        there, here = dict(*last), this_process()
        before = {"python": there.get("python"), **dict(there.get("packages") or {})}
        now = {"python": here["python"], **{name: here["packages"][name] for name in BITS}}
        recorded = dict(there.get("host") or {})
        before |= {name: recorded.get(name, value) for name, value in host.items()}
        now |= {name: value for name, value in host.items() if name != "commit"}
        return [
            f"{name} {before.get(name)}, here {value}"
            for name, value in now.items()
            if before.get(name) != value
        ]

    def scored_steps(self) -> int:
        """Environment steps behind the score in evaluation.json; -1 without one to be read.

        A policy can be scored while its run goes on, or after a crash. (Scores of the last policy
        alone were written before they said their step.)
        """
        try:
            return int(json.loads(self.evaluation.read_text()).get("env_steps", self.config.steps))
        except (AttributeError, OSError, TypeError, ValueError):
            return -1

    def lock(self, *, wait: bool = False) -> locking.Lock:
        """Held while the run is trained; see `locking.lock`."""
        refusal = f"another process trains {self.path}"
        return locking.lock(self.path / ".lock", refusal, wait=wait)


def this_process() -> dict[str, Any]:
    """The command, day and versions of what is running, as a run's history holds them."""
    return {
        "command": shlex.join(["mapg", *sys.argv[1:]]),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def make_folder(path: pathlib.Path) -> None:
    """A new folder.

    Raises:
      ValueError: if it exists with something in it, or cannot be created.
    """
    if not is_blank(path):
        raise ValueError(
            f"{path} exists already; choose another --out, or go on with: mapg resume {path}"
        )
    create_folder(path)


def create_folder(path: pathlib.Path) -> None:
    """A folder and its parents, where they are not there yet.

    Raises:
      ValueError: if it cannot be created; then none of its parents is left behind.
    """
    made = [p for p in (path, *path.parents) if not p.exists()]
    try:
        path.mkdir(parents=True, exist_ok=path.exists())
    except OSError as error:
        for parent in made:  # the parents that were made before it failed
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise ValueError(f"{path} cannot be created: {error.strerror}") from None


def is_blank(path: pathlib.Path) -> bool:
    """Whether there is no run yet: a process can end as soon as it has made the folder."""
    if not path.exists():
        return True
    return path.is_dir() and {file.name for file in path.iterdir()} <= {"config.partial"}


def refuse_nowhere(file: pathlib.Path) -> None:
    """Raises ValueError if a file cannot be written for want of a folder, or is one itself."""
    if not file.parent.is_dir():
        raise ValueError(f"there is no folder {file.parent} for {file.name}")
    if file.is_dir():
        raise ValueError(f"{file} is a folder; name a file in it")


def refuse_special_files(path: pathlib.Path) -> None:
    """Raises ValueError if a folder holds anything but folders and files of its own.

    What is written through a link lands elsewhere, and a pipe is waited for without end.
    """
    for folder, folders, files in os.walk(path):
        for file in (pathlib.Path(folder, name) for name in (*folders, *files)):
            with contextlib.suppress(FileNotFoundError):  # of a run that is being trained
                mode = file.lstat().st_mode
                if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
                    what = "a link" if stat.S_ISLNK(mode) else "no file"
                    raise ValueError(f"{file} is {what}; a run folder holds files of its own alone")
    for name in ("config.json", "metrics.csv", "evaluation.json", "curve.png", ".lock"):
        if (path / name).is_dir():
            raise ValueError(f"{path / name} is a folder, and should be a file")


def _read_record(file: pathlib.Path) -> dict[str, Any]:
    """config.json, of which nothing is believed."""
    try:
        if file.stat().st_size > CONFIG_BYTES:
            raise ValueError(f"it has more than {CONFIG_BYTES:,} bytes")
        record = json.loads(file.read_text("utf-8"))
        if type(record) is not dict or type(record.get("config")) is not dict:
            raise ValueError("it has no configuration")
        history = record.setdefault("history", [])
        if type(history) is not list or not all(type(entry) is dict for entry in history):
            raise ValueError("its history is no list of entries")
    except (OSError, RecursionError, ValueError) as error:
        raise ValueError(f"{file} is damaged: {error}") from None
    return record


def write_json(path: pathlib.Path, record: dict[str, Any]) -> None:
    """Writes the whole file or leaves the old one."""
    with whole_file(path) as file:
        file.write(json.dumps(record, indent=2) + "\n")


def _next_free(config: Config) -> pathlib.Path:
    heads = "" if config.heads == 1 else f"-m{config.heads}"
    stem = f"{config.env.replace(':', '-')}-{config.slug}{heads}"
    number = 1
    while (path := pathlib.Path("runs") / f"{stem}-{number}").exists():
        number += 1
    return path


def parse_config(values: dict[str, Any]) -> Config:
    """A configuration from JSON, which has no tuples.

    A field that came after the run has the default, as the run had.
    """
    return Config(**values)


def values_of(config: Config) -> dict[str, Any]:
    """The fields of a configuration that can be set, as JSON takes them."""
    return {name: getattr(config, name) for name in fields(type(config))}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
