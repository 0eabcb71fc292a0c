"""MuJoCo's viewer: a state a step, until the window is closed; none without a display."""

import contextlib

import glfw
import numpy as np
import pytest

import envs
from envs.pendulum import Pendulum
from mapg_jax.cli import watch
from mapg_jax.runs import live


class Window:
    """A viewer that is closed once it has shown some states."""

    def __init__(self, states=10**6):
        self.states, self.shown = states, []

    @contextlib.contextmanager
    def open(self, _):
        yield self.show

    def show(self, state, left, right):
        self.shown.append((np.asarray(state), left, right))
        return len(self.shown) < self.states


@pytest.mark.parametrize("closed_after, shown", [(10**6, 12), (5, 5)])
def test_every_state_is_shown_until_the_window_is_closed(
    closed_after, shown, finished_run, monkeypatch
):
    window = Window(closed_after)
    monkeypatch.setattr(Pendulum, "viewer", lambda env: window.open(env))
    monkeypatch.setattr(Pendulum, "dt", 0.001)
    live.show(finished_run, steps=6, episodes=2)
    assert len(window.shown) == shown
    states, lefts, rights = zip(*window.shown, strict=True)
    assert len({state.tobytes() for state in states}) == shown
    heads = finished_run.config.heads
    assert all(text.count("*") >= 1 for text in lefts)  # who acts
    assert all(len(text.splitlines()) == 1 + heads for text in (*lefts, *rights))


def test_columns_name_heads_values_and_proposals():
    proposals = np.array([[0.5, -1.0], [0.25, 1.0]])
    left, right = live.columns(proposals, np.array([1.5, 2000.0]), proposals[1])
    assert left == "head\n0\n1*"
    assert right == "value, proposed action\n1.5  +0.50 -1.00\n2000  +0.25 +1.00"


def test_what_has_no_viewer_is_refused(finished_run):
    with pytest.raises(ValueError, match=r"a run of pendulum, which MuJoCo's viewer cannot show"):
        live.show(finished_run)


def test_a_window_writes_no_file(capsys):
    with pytest.raises(SystemExit) as refused:
        watch.parse(["runs/a", "--live", "--out", "a.gif"])
    assert refused.value.code == 2
    assert "--live shows a window and writes no --out" in capsys.readouterr().err


def test_no_display_is_one_line(monkeypatch):
    monkeypatch.setattr(glfw, "init", lambda: False)
    with pytest.raises(ValueError, match=r"^--live needs a display; leave it out for a video$"):
        envs.make("hopper", "native").viewer()
