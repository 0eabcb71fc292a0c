"""Where workers run: on this machine, or as its options say."""

import importlib
import os
import pathlib
import subprocess
import sys

import pytest

from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.launchers import Local, launcher


def test_each_worker_sees_one_gpu(monkeypatch):
    monkeypatch.setattr(launchers.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(launchers.jax, "local_device_count", lambda: 2)
    for visible, names in (("", "01"), ("2, 5", "25"), ("GPU-a,GPU-b", ["GPU-a", "GPU-b"])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        shares = Local().shares(3)
        assert [share.gpu for share in shares] == [*names, names[0]]
        assert launchers._one_gpu(shares[1]) == {"CUDA_VISIBLE_DEVICES": names[1]}
    monkeypatch.setattr(launchers.jax, "local_device_count", lambda: 1)
    assert launchers._one_gpu(Local().shares(1)[0]) == {}  # as this process sees it


def test_the_memory_of_a_gpu_is_left_to_workers(monkeypatch):
    monkeypatch.setenv(launchers.PREALLOCATE, "true")
    launcher("local")
    assert os.environ[launchers.PREALLOCATE] == "false"
    assert launchers.environment()[launchers.PREALLOCATE] == "true"


def test_workers_of_a_checkout_need_no_installation():
    """Whatever folder they are started in, and by a Python that knows no packages."""
    find = "import importlib.util as u; print(u.find_spec('mapg_jax').origin)"
    found = subprocess.run(
        [sys.executable, "-P", "-S", "-c", find],
        env={**os.environ, **launchers.environment()},
        capture_output=True,
        text=True,
        check=True,
    )
    assert pathlib.Path(found.stdout.strip()) == launchers.CHECKOUT / "mapg_jax/__init__.py"


def test_what_is_wrong_is_said(monkeypatch):
    with pytest.raises(ValueError, match="the launcher local has no options"):
        launcher("local", ["a=1"])
    with pytest.raises(ValueError, match="written name=value, got 'partition'"):
        launcher("slurm", ["partition"])
    with pytest.raises(ValueError, match="the launcher's option a is given twice; leave one out"):
        launcher("slurm", ["a=1", "a=2"])
    with pytest.raises(ValueError, match="written name=value, got 1"):
        launcher("slurm", [1])
    with pytest.raises(ValueError, match="a launcher is local, slurm or ray, got 'foo'"):
        launcher("foo")

    def missing(name):
        raise ImportError("no", name="ray")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ValueError, match=r"\(ray\); pip install 'mapg-jax\[ray\]'"):
        launcher("ray")
