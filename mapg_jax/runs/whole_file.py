"""Files of text that are written whole or not at all."""

import contextlib
import pathlib
from collections.abc import Iterator
from typing import TextIO


@contextlib.contextmanager
def whole_file(path: pathlib.Path) -> Iterator[TextIO]:
    """A file to write, which takes the place of the old one once it is closed without an error."""
    partial = path.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        yield file
    partial.replace(path)
