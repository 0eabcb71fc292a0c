"""Shell completion, by argcomplete: commands, their flags, and values that are known beforehand."""

import argparse
import contextlib
import importlib
import os
import shlex
from collections.abc import Callable, Iterable, Mapping

ASKED = "_ARGCOMPLETE"
"""In the environment where a shell asks, with its line and the place of its cursor."""


def complete(commands: Mapping[str, str]) -> None:
    """Answers the shell, and ends the process."""
    line, point = os.environ["COMP_LINE"], int(os.environ["COMP_POINT"])
    before = line[:point]
    words = before.split()
    if len(words) + before.endswith(" ") <= 2:
        parser = argparse.ArgumentParser(prog="mapg")
        parser.add_argument("command", choices=list(commands))
        answer(parser)
    program, name = words[:2]
    if name not in commands:
        raise SystemExit(1)
    rest = line.split(name, 1)[1]
    os.environ["COMP_LINE"] = program + rest
    os.environ["COMP_POINT"] = str(point - len(line) + len(program + rest))
    command = importlib.import_module(f"mapg_jax.cli.{name}")
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        with contextlib.suppress(SystemExit, ValueError):  # half a line may be refused
            command.parse(shlex.split(before.rpartition(" ")[0])[2:])
        command.parse([])


def propose(action: argparse.Action, values: Callable[[], Iterable[str]]) -> None:
    """Values that can stand behind a flag; without any a shell names files."""
    vars(action)["completer"] = lambda **_: values()


def answer(parser: argparse.ArgumentParser) -> None:
    """Where the shell asks: what can stand at the cursor, which ends the process."""
    if ASKED in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser, always_complete_options="long")
