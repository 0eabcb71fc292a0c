"""Command lines: a flag for each field of a configuration, and refusals of one line."""

import argparse
import dataclasses
import difflib
import functools
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, NoReturn

from envs.values import items
from mapg_jax.cli import completion
from mapg_jax.cli.console import complain
from mapg_jax.training import plugins

WIDTH = 100


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and exits with 2."""

    def __init__(self, *arguments, **options):
        super().__init__(
            *arguments,
            **options,
            allow_abbrev=False,
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=WIDTH),
        )

    def error(self, message: str) -> NoReturn:
        self.exit(complain(message.removeprefix("argument "), 2))

    def flags(self) -> list[str]:
        """All flags that it knows."""
        return list(self._option_string_actions)

    def parse(self, flags: list[str]) -> argparse.Namespace:
        """The arguments; a flag that is near an unknown one is named, --import is obeyed."""
        completion.answer(self)
        arguments, rest = self.parse_known_args(flags)
        if rest:
            self.error(self._unknown(rest[0], flags))
        plugins.load(arguments.imports)
        return arguments

    def _unknown(self, word: str, flags: list[str]) -> str:
        before = [x for x in flags[: flags.index(word)] if x in self._option_string_actions]
        if not word.startswith("-") and before:
            flag = self._option_string_actions[before[-1]]
            takes = "no value" if flag.nargs == 0 else "one value"
            return f"{before[-1]} takes {takes}: {word} is one too many"
        near = difflib.get_close_matches(word, self.flags(), 1)
        return f"unknown: {word}" + (f"; did you mean {near[0]}?" if near else "")


def add_fields(
    parser: argparse._ActionsContainer,
    fields: Mapping[str, tuple[dataclasses.Field, Any, Any]],
    several: bool = False,
) -> None:
    """A flag a field; those that are not given do not appear among the arguments.

    Args:
      parser: to add to.
      fields: by name, the field, its type and the default that the help shows.
      several: whether each takes any number of values.
    """
    for name, (field, hint, default) in fields.items():
        shown = "" if default is None else f" (default: {_shown(default)})"
        options: dict[str, Any] = {
            "dest": name,
            "help": (field.metadata.get("help", "") + shown).replace("%", "%%"),
            "default": argparse.SUPPRESS,
        }
        if hint is bool and not several:
            options["action"] = argparse.BooleanOptionalAction
        elif several:
            options |= {"type": _one(hint), "nargs": "*", "metavar": _metavar(hint)}
        elif typing.get_origin(hint) is tuple:
            options |= {"action": _Joined, "type": _one(hint), "nargs": "*"}
            options["metavar"] = _metavar(hint)
        else:
            options |= {"type": _one(hint), "metavar": _metavar(hint)}
        action = parser.add_argument(f"--{name.replace('_', '-')}", **options)
        known = field.metadata.get("known") or functools.partial(_choices, hint)
        completion.propose(action, known)


def _choices(hint: Any) -> tuple[str, ...]:
    """What a flag can be, where that is known."""
    literal = typing.get_origin(hint) is Literal
    return tuple(map(str, typing.get_args(hint))) if literal else ()


class _Joined(argparse.Action):
    """`--hidden 64 64` is `--hidden 64,64`."""

    def __call__(self, parser, namespace, values, option_string=None):
        setattr(namespace, self.dest, tuple(item for value in values or () for item in value))


def value_of(hint: Any, text: str) -> Any:
    """A text as a value of a type.

    Raises:
      argparse.ArgumentTypeError: if it is none.
    """
    return _one(hint)(text)


def _one(hint: Any) -> Callable[[str], Any]:
    """A text as a value of that type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        words, kinds = _words(arguments)
        (kind,) = kinds
        return lambda text: _word_or(text, words, kind)
    if origin is tuple:
        return lambda text: tuple(map(_one(arguments[0]), items(text)))
    if origin is Literal:
        return lambda text: _member(text, arguments)
    if hint is bool:
        return lambda text: _member(text.capitalize(), ("True", "False")) == "True"
    return lambda text: _number(text, hint)


def _words(kinds: tuple) -> tuple[dict[str, Any], list[Any]]:
    """Of a union: what is written as a word, none among it; and the types that are left."""
    words: dict[str, Any] = {}
    for kind in kinds:
        if typing.get_origin(kind) is Literal:
            words |= {word: word for word in typing.get_args(kind)}
    if types.NoneType in kinds:
        words["none"] = None
    others = (x for x in kinds if x is not types.NoneType and typing.get_origin(x) is not Literal)
    return words, list(others)


def _word_or(text: str, words: dict[str, Any], kind: Any) -> Any:
    if text.lower() in words:
        return words[text.lower()]
    try:
        return _one(kind)(text)
    except argparse.ArgumentTypeError as error:
        wrong, _, got = str(error).partition(", got ")
        raise argparse.ArgumentTypeError(f"{wrong} or {' or '.join(words)}, got {got}") from None


def _member(text: str, choices: tuple[str, ...]) -> str:
    if text not in choices:
        raise argparse.ArgumentTypeError(f"must be one of {', '.join(choices)}, got {text!r}")
    return text


def _number(text: str, kind: type) -> Any:
    try:
        return kind(text)
    except ValueError:
        word = {int: "a whole number", float: "a number"}.get(kind, kind.__name__)
        raise argparse.ArgumentTypeError(f"must be {word}, got {text!r}") from None


def _metavar(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return "|".join("none" if x is types.NoneType else _metavar(x) for x in arguments)
    if origin is tuple:
        return f"{_metavar(arguments[0])},…"
    return "|".join(arguments) if origin is Literal else hint.__name__.upper()


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(str, value)) or "none"
    return str(value)
