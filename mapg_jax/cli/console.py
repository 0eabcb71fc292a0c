"""What the commands share on a terminal: refusals, and a standard output of our own."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable
from typing import TextIO

import rich.console


def refuse_politely(function: Callable):
    """The function's value; a refusal is one line on standard error and exit status 2."""
    try:
        return function()
    except (ValueError, OSError) as error:
        sys.exit(complain(str(error), 2))


@contextlib.contextmanager
def parse_politely():
    """The parser of the command line draws a box of several lines; ours is one line, status 2."""
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            yield
    except SystemExit as error:
        if error.code != 2:
            raise
        rows = [row.strip("│ ") for row in box.getvalue().splitlines()[1:-1]]
        parts = re.split(r"\.? ?─+ ?", " ".join(rows))
        parts[0] = parts[0].removeprefix("Error parsing config: ")
        parts[-1] = re.sub("^For full helptext, (run|see):?", "see", parts[-1])
        sys.exit(complain("; ".join(parts), 2))
    print(box.getvalue(), end="", file=sys.stderr)  # warnings


def complain(message: str, status: int) -> int:
    """One line on standard error; gives the exit status."""
    print("mapg:", *message.splitlines(), file=sys.stderr)
    return status


def console(out: TextIO) -> rich.console.Console:
    """Where tables are printed."""
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
            out.flush()
            os.dup2(ours, 1)
