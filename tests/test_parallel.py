"""benchmarks.parallel on evaluations made up here: nothing is trained."""

import math

import numpy as np
import pytest

from benchmarks import parallel
from benchmarks.parallel import Run
from mapg_jax.runs import csv_file

MAPG = [Run("pendulum", "mapg", preset, seed) for preset in parallel.PRESETS for seed in (0, 1)]
RETURNS = (-300.0, -200.0, -150.0, -100.0)
"""After ten minutes; half a minute in, all have -1,000."""


@pytest.fixture
def found(tmp_path):
    rows = [
        [*run, seconds, steps, value, ""]
        for run, last in zip(MAPG, RETURNS, strict=True)
        for seconds, steps, value in ((30.0, 10, -1_000.0), (599.0, 20, last), (601.0, 30, 0.0))
    ]
    csv_file.write(tmp_path / "parallel.csv", parallel.HEADER, rows)
    return parallel.evaluations(tmp_path / "parallel.csv")


def test_a_time_has_the_last_evaluation_until_then(found):
    curve = found[MAPG[0]]
    assert math.isnan(parallel.after(curve, 0.4))
    assert parallel.after(curve, 0.5) == parallel.after(curve, 9.9) == -1_000.0
    assert parallel.after(curve, 10) == -300.0


def test_a_point_of_the_picture_is_the_mean_of_what_was_close():
    seconds, returns = np.array([19.0, 20.0, 30.0, 61.0]), np.array([1.0, 2.0, 4.0, 8.0])
    points = parallel.points({"seconds": seconds, "return_mean": returns})
    assert points == ([19 / 60, 25 / 60, 61 / 60], [1.0, 3.0, 8.0])


def test_a_preset_wins_if_all_its_seeds_are_above_the_others(found):
    *_, two, five, ten = [row[3:] for row in parallel.returns(found).rows]
    assert two == five == ("-1,000 (-1,000 to -1,000)",) * 2 + ("+0", "neither", "2, 2")
    assert ten == ("-250 (-300 to -200)", "-125 (-150 to -100)", "+125", "parallel", "2, 2")
    assert parallel._compared([2.0, 4.0], [1.0, 0.0])[2:4] == ("-2", "paper")
    assert parallel._compared([2.0, 4.0], [])[2:] == ("", "", "2, 0")
    assert parallel._compared([2.0], [math.nan])[1:4] == ("not evaluated yet", "", "")


def test_the_best_has_the_highest_mean(found):
    best = {task: cells for task, *cells in parallel.best(found).rows}
    assert best["pendulum"][-1] == "mapg, parallel: -125"
    assert best["hopper"] == ["", "", ""], "not run yet"


def test_the_page_says_all_of_it(found):
    page = parallel.page(found)
    assert "| +125 | parallel | 2, 2 |" in page and "mapg, parallel: -125" in page
    assert page.count("`mapg train") == sum(run.seed == 0 for run in parallel.runs())


def test_every_cell_gets_a_seed_before_any_gets_its_next():
    runs = list(parallel.runs())
    assert [run.seed for run in runs] == sorted(run.seed for run in runs)
    assert len(set(runs)) == len(runs) == 60
    pairs = zip(runs[::2], runs[1::2], strict=True)
    assert all(a.preset != b.preset and a[:2] + a[3:] == b[:2] + b[3:] for a, b in pairs)
