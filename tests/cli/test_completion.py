"""What a shell is told can stand at its cursor, as argcomplete's script asks for it."""

import os
import subprocess
import sys

import pytest

from mapg_jax.cli.main import COMMANDS
from mapg_jax.runs import trackers


@pytest.fixture
def completions(tmp_path):
    """completions(line) → the words."""

    def ask(line):
        told = tmp_path / "told"
        asked = {
            "_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(told), "COMP_LINE": line,
            "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n",
        }  # fmt: skip
        command = [sys.executable, "-P", "-m", "mapg_jax"]
        done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True)
        assert "Traceback" not in done.stderr and done.stdout == ""
        return told.read_text().split()

    return ask


def test_commands(completions):
    assert set(completions("mapg ")) >= set(COMMANDS)
    assert completions("mapg ev") == ["evaluate"]


def test_flags_are_those_of_the_algorithm(completions):
    assert "--rollout-steps" in completions("mapg train --algorithm ppo --ro")
    assert completions("mapg train --algorithm td3 --rollout") == []
    assert "--replay-size" in completions("mapg train --re")


def test_values_that_are_known(completions):
    assert completions("mapg train --env multi_") == ["multi_goal"]
    assert set(completions("mapg train --truncation ")) == {"bootstrap", "terminal"}
    assert completions("mapg train --algorithm tr") == ["trpo"]
    assert completions("mapg sweep --preset s") == ["smoke"]
    assert set(completions("mapg resume --track ")) == set(trackers.NAMES)
