"""A lock is held by one at a time, and is given back however its holder ends."""

import pytest

from mapg_jax.runs.locking import lock


def test_one_has_it_at_a_time(tmp_path):
    with lock(tmp_path / ".lock"), pytest.raises(BlockingIOError, match=r"^taken$"):
        lock(tmp_path / ".lock", "taken")
    lock(tmp_path / ".lock", "taken").close()
    lock(tmp_path / ".lock", wait=True).close()


def test_an_error_gives_it_back(tmp_path):
    with pytest.raises(KeyError), lock(tmp_path / ".lock"):
        raise KeyError
    lock(tmp_path / ".lock", "taken").close()
