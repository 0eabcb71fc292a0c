"""Whether a plain value, as a user writes it, fits a type annotation."""

import types
import typing
from typing import Any


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
