"""A grid of runs: several values a field, their product, and a readable name for each cell."""

import dataclasses
import itertools
import math
import urllib.parse
from collections.abc import Mapping, Sequence
from typing import Any

from mapg_jax.training.config import Config

Values = Mapping[str, Sequence[Any]]
"""The values that fields of a configuration take."""
SHORT = {"heads": "m", "seed": "s"}

MOST_CELLS = 100_000
"""More is a slip of the hand, and would take minutes to list."""


def expand(base: Config, values: Values) -> list[Config]:
    """The product of the values over a base; equal cells are one.

    Seeds vary slowest, so that every cell has its first seed early.

    Raises:
      ValueError: if a field has no values, or a cell cannot be configured.
    """
    for name, several in values.items():
        if not several:
            raise ValueError(f"the grid is empty: {name} has no values")
    if size(values) > MOST_CELLS:
        raise ValueError(f"the grid has {size(values):,} cells, more than {MOST_CELLS:,}")
    names = sorted(values, key=lambda name: name != "seed")
    product = itertools.product(*(values[name] for name in names))
    cells = (dataclasses.replace(base, **dict(zip(names, cell, strict=True))) for cell in product)
    return list(dict.fromkeys(cells))


def size(values: Values) -> int:
    """Cells of the product, equal ones included."""
    return math.prod(map(len, values.values()))


def names(cells: Sequence[Config]) -> list[str]:
    """A folder's name for each cell, of the fields in which the cells differ."""
    varied = [
        field.name
        for field in dataclasses.fields(Config)
        if len({getattr(cell, field.name) for cell in cells}) > 1 and field.name != "env"
    ]
    varied.sort(key=lambda name: name == "seed")  # last
    return [_name(cell, varied) for cell in cells]


def _name(cell: Config, varied: Sequence[str]) -> str:
    parts = [cell.env.replace(":", "-")]
    for name in varied:
        if name == "algorithm":
            parts.append(cell.algorithm)
        elif name != "heads" or cell.algorithm != "a3c":  # which proposes one
            equals = SHORT.get(name, f"{name}=")
            parts.append(f"{equals}{_text(getattr(cell, name))}")
    return "-".join(parts)


def _text(value: Any) -> str:
    """A value as a part of a file name; different values differ."""
    text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return urllib.parse.quote(text, safe="=,")
