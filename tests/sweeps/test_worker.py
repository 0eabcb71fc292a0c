"""A worker of a sweep."""

import threading

from launched import RUN

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps import worker as worker_module


def test_a_run_that_another_process_trains_is_waited_for(tmp_path, capsys):
    folder = RunFolder.create(tmp_path / "run", RUN)
    taken = []
    waiting = threading.Thread(target=lambda: taken.append(worker_module._lock(folder)))
    with folder.lock():
        waiting.start()
        waiting.join(0.2)
        assert not taken
    waiting.join()
    taken[0].close()
    assert capsys.readouterr().out == f"another process trains {folder.path}, and is waited for\n"
