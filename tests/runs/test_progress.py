"""How far a run is, on standard error: a bar on a terminal, a line an evaluation elsewhere."""

import pytest
import rich.console

from mapg_jax.runs import progress as module
from mapg_jax.runs.progress import Progress

ROW = {"env_steps": 500, "return_mean": -12.34, "return_std": 5.0, "steps_per_second": 2000.0}


def test_it_is_a_line_an_evaluation_on_standard_error(capsys):
    with Progress(1000) as progress:
        progress.advance(500, 2000.0)
        progress.evaluated(ROW, 0.25)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "step 500 of 1,000: return -12.3 ± 5.0, 2,000 steps/s, 0 s left" in shown.err


def test_silence_is_silent(capsys):
    with Progress(1000, enabled=False) as progress:
        progress.advance(500, 2000.0)
        progress.learning()
        progress.evaluated(ROW, 1.0)
    assert capsys.readouterr() == ("", "")


@pytest.fixture
def terminal(monkeypatch):
    """Standard error is a terminal of 120 columns."""
    console = rich.console.Console(stderr=True, force_terminal=True, width=120)
    monkeypatch.setattr(module.rich.console, "Console", lambda stderr: console)


def test_a_terminal_has_a_bar_that_says_when_there_is_no_return_yet(terminal, capsys):
    with Progress(1000) as progress:
        progress.advance(250, 2000.0)
    before = capsys.readouterr().err
    assert "250/1000" in before and "not yet evaluated" in before and "2,000 steps/s" in before
    with Progress(1000) as progress:
        progress.advance(500, 2000.0)
        progress.evaluated(ROW, 0.25)
    assert "return -12.3 ± 5.0" in capsys.readouterr().err
