"""--import MODULE: environments and algorithms of one's own, from a file in the working folder."""

import json
import subprocess
import sys

import pytest

MODULE = """
import jax.numpy as jnp

import envs
import mapg_jax
from envs.base import Env, State
from mapg_jax.algorithms.mapg import Mapg


class Bandit(Env):
    dt = 1.0
    action_high = jnp.ones(1)
    observation_size = action_size = 1
    backend = "jax"

    def reset(self, rng):
        return State(None, jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state, action):
        return state.replace(reward=1 - jnp.abs(action[0]), done=jnp.ones(()))


class Mine(Mapg):
    @staticmethod
    def label(heads):
        return f"mine, M = {heads}"

    @staticmethod
    def slug(heads):
        return "mine"


envs.register("bandit", Bandit, time_limit=5)
mapg_jax.register("mine", Mine)
"""
TINY = (
    "--env bandit --algorithm mine --preset smoke --steps 200 --environments 4 --replay-size 200 "
    "--batch-size 8 --hidden 8,8 --evaluate-every 100"
)


@pytest.fixture
def mapg(tmp_path):
    """mapg(*arguments) → the process that did it, beside a module `own` with both."""
    (tmp_path / "own.py").write_text(MODULE)

    def run(command, *arguments):
        own = TINY.split() if command in ("train", "sweep") else []
        return subprocess.run(
            [sys.executable, "-m", "mapg_jax", command, *own, *arguments],
            cwd=tmp_path, capture_output=True, text=True,
        )  # fmt: skip

    return run


def test_a_run_of_ones_own(mapg, tmp_path):
    done = mapg("train", "--import", "own", "--out", "run")
    assert done.returncode == 0, done.stderr
    folder = json.loads((tmp_path / "run" / "config.json").read_text())
    assert folder["config"]["algorithm"] == "mine"
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["episodes"] == 4

    # A run folder is data: what it was trained with is not imported by itself.
    (tmp_path / "run" / "own.py").write_text("raise SystemExit('read from a run folder')")
    done = mapg("report", "run")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("mapg: ") and done.stderr.count("\n") == 1
    assert "algorithm must be one of mapg, " in done.stderr and ", got 'mine'" in done.stderr
    done = mapg("report", "run", "--import=own")
    assert done.returncode == 0, done.stderr
    assert "mine, M = 3" in done.stdout


def test_workers_of_a_sweep_import_it_too(mapg, tmp_path):
    done = mapg("sweep", "--import", "own", "--out", "swept", "--heads", "2", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert [*(tmp_path / "swept").glob("*/evaluation.json")]
    assert not (tmp_path / "swept" / "own.py").exists()
    done = mapg("resume", "swept")
    assert done.returncode == 2
    assert "algorithm must be one of mapg, " in done.stderr and ", got 'mine'" in done.stderr
    done = mapg("resume", "swept", "--import", "own")
    assert done.returncode == 0, done.stderr
