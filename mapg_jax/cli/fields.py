"""The fields of a configuration as flags: which there are, and what those given make."""

import dataclasses
import typing
from collections.abc import Sequence
from typing import Any

from mapg_jax.algorithms import registry
from mapg_jax.cli import completion
from mapg_jax.cli.parser import Parser, add_fields
from mapg_jax.training import plugins
from mapg_jax.training.config import PRESETS, Config, config_type, fields, owners_of, preset


def settle(flags: list[str]) -> tuple[str, list[str]]:
    """Preset and algorithms, which the other flags depend on; modules to import are imported.

    Raises:
      ValueError: if a preset, an algorithm or a module is unknown, or one of the algorithms has no
        such preset.
    """
    first = Parser(add_help=False)
    first.add_argument("--preset", default="paper")
    first.add_argument("--algorithm", nargs="*", default=["mapg"])
    plugins.add_argument(first)
    known, _ = first.parse_known_args(flags)
    plugins.load(known.imports)
    algorithms = known.algorithm or ["mapg"]
    for name in algorithms:
        preset(known.preset, name)
    return known.preset, algorithms


def add_preset(parser: Parser) -> None:
    """The flag that says where the defaults come from."""
    action = parser.add_argument(
        "--preset",
        default="paper",
        help=f"Where the defaults come from: {', '.join(PRESETS)}.",
    )
    completion.propose(action, lambda: PRESETS)


def add(parser: Parser, name: str, algorithms: Sequence[str], several: bool) -> None:
    """A flag for each field that one of the algorithms has, with the preset's defaults."""
    shown: dict[str, tuple[dataclasses.Field, Any, Any]] = {}
    for algorithm in algorithms:
        default, cls = preset(name, algorithm), config_type(algorithm)
        hints = typing.get_type_hints(cls)
        for field in fields(cls).values():
            shown.setdefault(field.name, (field, hints[field.name], getattr(default, field.name)))
    common = {k: v for k, v in shown.items() if k in fields(Config)}
    own = {k: v for k, v in shown.items() if k not in common}
    add_fields(parser.add_argument_group("the run"), common, several)
    add_fields(parser.add_argument_group(f"{' and '.join(algorithms)}"), own, several)


def given(arguments: Any) -> dict[str, Any]:
    """The fields that were given."""
    known = {name for algorithm in registry.names() for name in fields(config_type(algorithm))}
    return {name: value for name, value in vars(arguments).items() if name in known}


def refuse_foreign_flags(parser: Parser, flags: Sequence[str], algorithms: Sequence[str]) -> None:
    """Raises ValueError, which says whose flag it is, if one belongs to another algorithm."""
    for flag in flags:
        name = flag.partition("=")[0].removeprefix("--").replace("-", "_")
        if not flag.startswith("--") or flag.partition("=")[0] in parser.flags():
            continue
        if owners := owners_of(name):
            raise ValueError(
                f"--{name.replace('_', '-')} is an option of {owners}, "
                f"not of {' and '.join(algorithms)}"
            )
