"""What the commands share on a terminal: refusals, and a standard output of our own."""

import contextlib
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:  # slow to import
    import rich.console


def refuse_politely(function: Callable):
    """The function's value; a refusal is one line on standard error and exit status 2."""
    try:
        return function()
    except (ValueError, OSError) as error:
        sys.exit(complain(str(error), 2))


def complain(message: str, status: int) -> int:
    """One line on standard error; gives the exit status."""
    print("mapg:", *message.splitlines(), file=sys.stderr)
    return status


def console(out: TextIO) -> "rich.console.Console":
    """Where tables are printed."""
    import rich.console

    return rich.console.Console(file=out, width=None if out.isatty() else 120)


@contextlib.contextmanager
def own_stdout():
    """Standard output for us alone: what imported libraries print goes to standard error."""
    sys.stdout.flush()
    ours = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(ours, "w") as out:
        try:
            yield out
        finally:
            sys.stdout.flush()
            try:
                out.flush()
            except BrokenPipeError:  # whoever read it has gone, as `head` has
                os.dup2(os.open(os.devnull, os.O_WRONLY), ours)
            os.dup2(ours, 1)
