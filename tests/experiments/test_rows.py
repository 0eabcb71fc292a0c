"""What is measured on runs, as CSV files: what is damaged is named, and never averaged."""

import pytest

from experiments import curves, rows
from experiments.plan import DDPG, make_plan


@pytest.fixture
def plan(tmp_path):
    return make_plan("paper", 1600, 3, tmp_path / "runs", tmp_path)


def lines(config, returns):
    """A curve of a run."""
    zero = dict.fromkeys(curves.COLUMNS, 0.0)
    return [
        {**rows.identity(config), **zero, "env_steps": t, "return_mean": x}
        for t, x in enumerate(returns)
    ]


def test_the_rows_of_a_run_are_those_of_its_key(plan):
    one, two, three = plan.over_seeds("hopper", **DDPG)
    path = plan.measured / curves.FILE
    rows.append(path, [*lines(one, [1, 2]), *lines(two, [3])])
    found = rows.of(path, [two, three], ("return_mean",), each="env_steps")
    assert [row["return_mean"] for row in found] == [3.0]
    assert rows.runs_in(path, [two, three]) == {tuple(rows.identity(two).values())}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lambda text: text.replace("return_mean", "mean"), "has no column return_mean"),
        (lambda text: text.replace(",7.5,", ",abc,"), "return_mean of hopper, seed 2000 is 'abc'"),
        (lambda text: text + text.splitlines()[1] + "\n", "hopper, ddpg, M = 1, seed 2000 twice"),
        (lambda text: text + "hopper,ddpg\n", "a row has other columns than the header"),
    ],
)
def test_a_damaged_file_is_named(plan, text, message):
    path = plan.measured / curves.FILE
    runs = plan.over_seeds("hopper", **DDPG)
    rows.append(path, lines(runs[0], [7.5]))
    path.write_text(text(path.read_text()))
    with pytest.raises(ValueError, match=message) as error:
        curves.of(plan, runs)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
