"""A grid of runs: several values a field, their product, and a readable name for each cell."""

import itertools
import math
import urllib.parse
from collections.abc import Mapping, Sequence
from typing import Any

from mapg_jax.training.config import Config, config_type, fields, preset, refuse_foreign

Values = Mapping[str, Sequence[Any]]
"""The values that fields of a configuration take."""
SHORT = {"heads": "m", "seed": "s"}

MOST_CELLS = 100_000
"""More is a slip of the hand, and would take minutes to list."""


def expand(name: str, values: Values) -> list[Config]:
    """The product of the values over a preset; equal cells are one.

    A value goes to the algorithms that have the field. Seeds vary slowest, so that every cell has
    its first seed early.

    Raises:
      ValueError: if a field has no values, none of the algorithms has it, or a cell cannot be
        configured.
    """
    for field, several in values.items():
        if not several:
            raise ValueError(f"the grid is empty: {field} has no values")
    refuse_a_vast_grid(size(values))
    algorithms = values.get("algorithm", (Config.algorithm,))
    types = {algorithm: config_type(algorithm) for algorithm in algorithms}
    for field in values:
        if not any(field in fields(cls) for cls in types.values()):
            refuse_foreign(types[algorithms[0]], field)
    names = sorted(values, key=lambda field: field != "seed")
    cells = []
    for cell in itertools.product(*(values[field] for field in names)):
        chosen = {"algorithm": algorithms[0], **dict(zip(names, cell, strict=True))}
        known = fields(types[chosen["algorithm"]])
        cells.append(preset(name, **{k: v for k, v in chosen.items() if k in known}))
    return list(dict.fromkeys(cells))


def refuse_a_vast_grid(cells: int) -> None:
    """Raises ValueError if there are more cells than anybody means."""
    if cells > MOST_CELLS:
        raise ValueError(f"the grid has {cells:,} cells, more than {MOST_CELLS:,}")


def size(values: Values) -> int:
    """Cells of the product, equal ones included."""
    return math.prod(map(len, values.values()))


def names(cells: Sequence[Config], values: Values) -> list[str]:
    """A folder's name for each cell, of the fields with several values; the seed comes last."""
    varied = [field for field, several in values.items() if len(set(several)) > 1]
    varied = [field for field in varied if field != "env"]
    varied.sort(key=lambda field: field == "seed")
    return [_name(cell, varied) for cell in cells]


def _name(cell: Config, varied: Sequence[str]) -> str:
    parts = [cell.env.replace(":", "-").replace("/", "-")]
    for field in varied:
        if field == "algorithm":
            parts.append(cell.algorithm)
        elif field in fields(type(cell)):
            equals = SHORT.get(field, f"{field}=")
            parts.append(f"{equals}{_text(getattr(cell, field))}")
    return "-".join(parts)


def _text(value: Any) -> str:
    """A value as a part of a file name; different values differ."""
    text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return urllib.parse.quote(text, safe="=,")
