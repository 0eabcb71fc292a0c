"""Plain values as a user writes them: read from text, and fitted to type annotations."""

import ast
import itertools
import math
import types
import typing
from typing import Any

WORDS = {
    "none": None, "null": None, "true": True, "false": False, "inf": math.inf, "-inf": -math.inf
}  # fmt: skip
"""What is no literal of Python, and what is meant by it."""


def read(text: str) -> Any:
    """What a text says: a literal of Python, one of WORDS, [a,b] of any of these; else itself."""
    value, inner = _one(text), _within_brackets(text)
    return [_one(item) for item in items(inner)] if value is text and inner else value


def _one(text: str) -> Any:
    if text in WORDS:
        return WORDS[text]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def items(text: str) -> list[str]:
    """Split at commas; those within brackets belong to an item, and [a,b] is a,b."""
    inner = _within_brackets(text)
    found, depth = [""], 0
    for letter in text if inner is None else inner:
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and not depth:
            found.append("")
        else:
            found[-1] += letter
    return [item for item in map(str.strip, found) if item]


def _within_brackets(text: str) -> str | None:
    """What one pair of brackets holds, if it holds all: not of [a],[b]."""
    if text[:1] + text[-1:] not in ("[]", "()"):
        return None
    depths = itertools.accumulate((x in "([") - (x in ")]") for x in text[:-1])
    return text[1:-1] if min(depths) > 0 else None


def fitted(value: Any, hint: Any) -> Any:
    """The value; where only a tuple fits, a list becomes one, and a value alone one of itself."""
    if fits(value, hint):
        return value
    several = tuple(value) if isinstance(value, list) else (value,)
    return several if fits(several, hint) else value


def fits(value: Any, hint: Any) -> bool:
    """Whether `value` is of the annotated type; whole numbers count as float, bools as bool only.

    Knows int, float, bool, str, None, Literal, unions and tuples; any other annotation fits.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in arguments)
    if origin is typing.Literal:
        return value in arguments
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if arguments[-1] is not Ellipsis:
            return len(value) == len(arguments) and all(map(fits, value, arguments))
        return all(fits(one, arguments[0]) for one in value)
    if isinstance(value, bool) or hint is bool:
        return isinstance(value, bool) and hint in (bool, Any)
    if hint is float:
        return isinstance(value, int | float)
    if hint in (int, str, None, types.NoneType):
        return value is None if hint in (None, types.NoneType) else isinstance(value, hint)
    return True
