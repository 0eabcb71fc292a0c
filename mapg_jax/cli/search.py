"""mapg search: hyper-parameters by Optuna."""

import argparse
import importlib.util
import pathlib
import shlex
import sys
import typing
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

from envs.values import items
from mapg_jax.cli import config_file, fields
from mapg_jax.cli.console import complain, refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.cli.parser import value_of
from mapg_jax.cli.sweep import add_workers
from mapg_jax.runs.locking import lock
from mapg_jax.training import plugins
from mapg_jax.training.config import Config, config_type, preset, refuse_foreign

if TYPE_CHECKING:
    from mapg_jax.sweeps.search import Dimension, Plan, SearchFolder

EXAMPLE = (
    "Example: mapg search --env pendulum --heads 10 --steps 20000 --space "
    "actor_learning_rate=log:1e-5..1e-2 batch_size=32,64,128 --trials 30 --out runs/search"
)


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments; fields that are given are those of every run."""
    flags = config_file.expand(flags)
    name, (algorithm, *_) = fields.settle(flags)
    command = parser("search", EXAMPLE)
    command.add_argument(
        "--space",
        nargs="+",
        required=True,
        metavar="NAME=VALUES",
        help="What is looked for: NAME=LOW..HIGH, NAME=log:LOW..HIGH, or NAME=A,B,C.",
    )
    command.add_argument("--trials", type=int, default=20, help="Runs, pruned ones too.")
    command.add_argument("--out", type=pathlib.Path, required=True, help="Folder of the search.")
    add_workers(command)
    fields.add_preset(command)
    config_file.add_argument(command)
    fields.add(command, name, [algorithm], several=False)
    fields.refuse_foreign_flags(command, flags, [algorithm])
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Searches."""
    refuse_without_optuna()
    from mapg_jax.sweeps.search import make_plan

    search = refuse_politely(lambda: search_folder(arguments))
    plan = refuse_politely(lambda: make_plan(search))
    refuse_politely(search.create)
    _go(plan, out)


def go_on(path: pathlib.Path, out: TextIO) -> None:
    """Runs what is missing of a search."""
    refuse_without_optuna()
    from mapg_jax.sweeps.search import SearchFolder, make_plan

    search = refuse_politely(lambda: SearchFolder.open(path))
    _go(refuse_politely(lambda: make_plan(search)), out)


def refuse_without_optuna() -> None:
    """Exits with a line if it is not installed."""
    if importlib.util.find_spec("optuna") is None:
        sys.exit(complain("mapg search needs optuna: pip install 'mapg-jax[search]'", 2))


def search_folder(arguments: argparse.Namespace) -> "SearchFolder":
    """What the flags ask for; nothing is written.

    Raises:
      ValueError: if a field of the space is none or named twice, or its values are not.
    """
    from mapg_jax.sweeps.search import Dimension, SearchFolder

    given = fields.given(arguments)
    config = preset(arguments.preset, **given)
    space: dict[str, Dimension] = {}
    for name, dimension in (_dimension(config, text) for text in arguments.space):
        if name in space:
            raise ValueError(f"--space names {name} twice; give all its values at once")
        space[name] = dimension
    if twice := sorted(set(space) & set(given)):
        raise ValueError(f"{twice[0]} is given and looked for; leave out --{twice[0]}")
    return SearchFolder(
        arguments.out,
        arguments.preset,
        given,
        space=space,
        trials=arguments.trials,
        workers=arguments.workers,
        launcher=arguments.launcher,
        launcher_options=tuple(arguments.launcher_options),
    )


def _dimension(config: Config, text: str) -> "tuple[str, Dimension]":
    """NAME=VALUES as a field and what it may be."""
    from mapg_jax.sweeps.search import Dimension

    name, equals, values = text.partition("=")
    name = name.replace("-", "_")
    if not equals or not values:
        raise ValueError(f"a space is written NAME=LOW..HIGH or NAME=A,B,C, got {text!r}")
    refuse_foreign(type(config), name)
    hint = typing.get_type_hints(config_type(config.algorithm))[name]
    scale, colon, ends = values.rpartition(":")
    low, dots, high = ends.partition("..")
    try:
        if not dots:
            return name, Dimension(tuple(value_of(hint, item) for item in items(values)))
        if colon and scale != "log":
            raise ValueError(f"{scale} is no scale; leave it out, or write log:{ends}")
        return name, Dimension((), value_of(hint, low), value_of(hint, high), bool(colon))
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise ValueError(f"--space {name}: {error}") from None


def _go(plan: "Plan", out: TextIO) -> None:
    """Searches, and prints the best run as a command."""
    from mapg_jax.sweeps.search import carry_out

    search = plan.search
    refusal = f"another process carries out {search.path}"
    with refuse_politely(lambda: lock(search.path / ".lock", refusal)):
        found = refuse_politely(lambda: carry_out(plan, lambda line: print(line, file=sys.stderr)))
    if found is None:
        sys.exit(complain(f"none of the {search.trials} trials of {search.path} has a score", 1))
    folder, score = found
    print(f"best of {search.trials} trials: {folder.path.name}, score {score:.1f}", file=out)
    chosen = {name: getattr(folder.config, name) for name in search.space}
    print(command_of(search.preset, {**search.values, **chosen}), file=out)
    print(f"search folder: {search.path}", file=out)


def command_of(name: str, values: Mapping[str, Any]) -> str:
    """The `mapg train` that makes a run."""
    imports = [f"--import={module}" for module in plugins.loaded()]
    words = ["mapg", "train", *imports, "--preset", name]
    for field, value in values.items():
        flag = f"--{field.replace('_', '-')}"
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        elif isinstance(value, tuple):
            words += [flag, *map(str, value)]
        else:
            words += [flag, "none" if value is None else str(value)]
    return shlex.join(words)
