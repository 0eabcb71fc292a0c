"""A lock on a folder: what two processes would write at once, one of them writes."""

import fcntl
import pathlib
from typing import TextIO


def lock(path: pathlib.Path, refusal: str = "", *, wait: bool = False) -> TextIO:
    """The open file `path`, locked until it is closed, as by `with`, or the process ends.

    Args:
      path: the file, made where there is none.
      refusal: what the error says.
      wait: whether to wait for the process that has it.

    Raises:
      BlockingIOError: if another process has it.
    """
    file = path.open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        file.close()
        raise BlockingIOError(refusal) from None
    except OSError:  # a file system without locks: better a run than none
        pass
    return file
