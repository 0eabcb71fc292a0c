"""`--config FILE`: flags that stand in a YAML file, and a configuration as such a file."""

import argparse
import pathlib
from collections.abc import Mapping
from typing import Any

import yaml

from mapg_jax.cli.parser import Parser
from mapg_jax.runs.folder import values_of
from mapg_jax.training.config import Config, owners_of

MOST_BYTES = 1_000_000


def add_argument(command: argparse.ArgumentParser) -> None:
    """`--config`, which `expand` has replaced before the command sees it."""
    command.add_argument(
        "--config",
        metavar="FILE",
        help="Flags from a YAML file (steps: 100000); those of the command line win.",
    )


def expand(flags: list[str], several: bool = False) -> list[str]:
    """Flags of the files behind `--config` before those of the command line, which win.

    Args:
      flags: of the command line.
      several: whether the flag of a field takes any number of values, true and false among them.

    Raises:
      ValueError: if a file is none of YAML, or no mapping of flags to values.
    """
    first = Parser(add_help=False)
    first.add_argument("--config", action="append", default=[])
    known, rest = first.parse_known_args(flags)
    return [flag for file in known.config for flag in _flags(file, several)] + rest


def dump(config: Config) -> str:
    """A configuration as YAML that `expand` reads."""
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in values_of(config).items()}
    return yaml.safe_dump(values, sort_keys=False)


def _flags(file: str, several: bool) -> list[str]:
    try:
        path = pathlib.Path(file)
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES:,} bytes")
        values = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, RecursionError, ValueError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ValueError(f"--config {file} cannot be read: {reason}") from None
    if not isinstance(values, Mapping):
        raise ValueError(f"--config {file} must hold flags and values, as in steps: 100000")
    if "config" in values:
        raise ValueError(
            f"--config {file} names another file, which no file can; give both: --config {file} "
            f"--config {_text(values['config'])}"
        )
    return [part for name, value in values.items() for part in _flag(str(name), value, several)]


def _flag(name: str, value: Any, several: bool) -> list[str]:
    name = name.replace("_", "-")
    a_field = bool(owners_of(name.replace("-", "_")))
    if value is None and not a_field:  # as if the line were not there
        return []
    if isinstance(value, bool) and not (several and a_field):
        return [f"--{name}"] if value else [f"--no-{name}"] if a_field else []
    if isinstance(value, Mapping) and not (several and a_field):
        return [f"--{name}", *_named(value)]
    if isinstance(value, list):
        return [f"--{name}", *map(_text, value)]
    return [f"--{name}={_text(value)}"]


def _named(values: Mapping) -> list[str]:
    """Options of an environment, say."""
    return [f"{name}={_text(value)}" for name, value in values.items()]


def _text(value: Any) -> str:
    """A value as the command line has it."""
    if isinstance(value, Mapping):
        return ",".join(_named(value))
    if isinstance(value, list):
        return f"[{','.join(map(_text, value))}]"
    return "none" if value is None else str(value)
