"""Modules that a user names, which register environments and algorithms when they are imported."""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

_loaded: list[str] = []


def load(modules: Sequence[str]) -> None:
    """Imports them; what Python does not find otherwise is looked for in the working folder.

    Raises:
      ValueError: if one cannot be imported.
    """
    if modules and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    for module in modules:
        try:
            importlib.import_module(module)
        except Exception as error:  # of somebody else's code
            raise ValueError(f"the module {module!r} cannot be imported: {error}") from error
        if module not in _loaded:
            _loaded.append(module)


def loaded() -> tuple[str, ...]:
    """Those that this process has imported, which its workers import too."""
    return tuple(_loaded)


def add_argument(parser: argparse.ArgumentParser) -> None:
    """The flag --import, which may be repeated."""
    parser.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="MODULE",
        help="A module to import first, which registers environments or algorithms of yours.",
    )
