"""A lock on a folder: what two processes would write at once, one of them writes."""

import fcntl
import os
import pathlib


class Lock:
    """A locked file; it is given back by `close`, by `with`, or when nothing refers to it."""

    _file = -1

    def __init__(self, path: pathlib.Path):
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)

    def fileno(self) -> int:
        """As `fcntl` wants it."""
        return self._file

    def close(self) -> None:
        """Gives it back."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> "Lock":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()


def lock(path: pathlib.Path, refusal: str = "", *, wait: bool = False) -> Lock:
    """The file `path`, locked until it is given back or the process ends.

    Args:
      path: the file, made where there is none.
      refusal: what the error says.
      wait: whether to wait for the process that has it.

    Raises:
      BlockingIOError: if another process has it.
    """
    held = Lock(path)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        held.close()
        raise BlockingIOError(refusal) from None
    except OSError:  # a file system without locks: better a run than none
        pass
    return held
