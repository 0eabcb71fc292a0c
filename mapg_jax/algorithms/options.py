"""Numbers that a user sets, with their help and their bounds beside them, checked in one place."""

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal

from envs.values import fits

LARGEST = 2**31 - 1
"""Of a whole number, where no bound of its own says otherwise: what compiled programs count in."""


def option(
    default: Any,
    help: str,
    *,
    at_least: int | float | None = None,
    above: int | float | None = None,
    at_most: int | float | None = None,
    below: int | float | None = None,
    of_heads: bool = False,
    host: bool = False,
    known: Callable[[], Sequence[str]] | None = None,
) -> Any:
    """A field of a frozen dataclass of options.

    Args:
      default: its value if none is given; None there means that the option is off.
      help: what it means, with its unit, for the command line.
      at_least: the least value allowed.
      above: values must be larger.
      at_most: the largest value allowed.
      below: values must be smaller.
      of_heads: whether it says nothing where there is one head.
      host: whether it bears on the host's work alone, neither on the task nor on learning.
      known: values that a shell can propose.
    """
    bounds = {"at least": at_least, "above": above, "at most": at_most, "below": below}
    bounds = {words: bound for words, bound in bounds.items() if bound is not None}
    metadata = {"help": help, "bounds": bounds, "of_heads": of_heads, "host": host, "known": known}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What every algorithm reads: M, its networks, and how far it looks ahead."""

    heads: int = option(
        10, "M, the actions proposed per state; 1 is the plain algorithm.", at_least=1
    )
    hidden: tuple[int, ...] = option(
        (64, 64), "Widths of the hidden layers of all networks; at least two."
    )
    layer_norm: bool = option(True, "Layer norm before each ReLU, as in the code the paper ran on.")
    discount: float = option(0.99, "γ, per environment step, in [0, 1).", at_least=0, below=1)

    def __post_init__(self):
        """Plain lists become tuples.

        Raises:
          ValueError: if a value is of another type, or out of bounds.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
            _check(field, _hints(type(self))[field.name], getattr(self, field.name))
        if len(self.hidden) < 2 or min(self.hidden) < 1:
            raise ValueError(
                f"hidden must be two widths or more, each at least 1, got {self.hidden}"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticOptions(Options):
    """Beside these, what a critic of states and actions reads."""

    action_layer: int = option(
        2,
        "The hidden layer of the critic that the action joins: the second, as in DDPG, or the "
        "first, as in TD3 and SAC.",
        at_least=1,
        at_most=2,
    )


_WITHIN = {
    "at least": lambda value, bound: value >= bound,
    "above": lambda value, bound: value > bound,
    "at most": lambda value, bound: value <= bound,
    "below": lambda value, bound: value < bound,
}


def _check(field: dataclasses.Field, hint: Any, value: Any) -> None:
    name, choices = field.name, typing.get_args(hint)
    if typing.get_origin(hint) is Literal and value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    if not fits(value, hint):
        expected = hint.__name__ if isinstance(hint, type) else hint
        raise ValueError(f"{name} must be {expected}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value}")
    bounds = field.metadata.get("bounds", {})
    if not {"at most", "below"} & set(bounds):
        for whole in value if isinstance(value, tuple) else (value,):
            if isinstance(whole, int) and whole > LARGEST:
                raise ValueError(f"{name} must be at most {LARGEST}, got {_short(whole)}")
    if value is None or isinstance(value, str):
        return
    if all(_WITHIN[words](value, bound) for words, bound in bounds.items()):
        return
    if set(bounds) == {"at least", "below"}:
        raise ValueError(
            f"{name} must be in [{bounds['at least']}, {bounds['below']}), got {value}"
        )
    words, bound = next(item for item in bounds.items() if not _WITHIN[item[0]](value, item[1]))
    raise ValueError(f"{name} must be {words} {bound}, got {value}")


def _short(whole: int) -> str:
    return str(whole) if whole < 10**20 else "a number of more than twenty digits"


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)
