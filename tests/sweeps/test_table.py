"""What a sweep tells while it goes: how far all its runs are, and how long they will take."""

import dataclasses
import io
import re

import oracles
import pytest
import rich.console

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps.groups import Job
from mapg_jax.sweeps.table import SweepTable

RUN = dataclasses.replace(oracles.RUN, steps=1000)


@pytest.fixture
def folders(tmp_path):
    """Four runs of 1,000 steps, none of them evaluated."""
    return [
        RunFolder.create(tmp_path / name, dataclasses.replace(RUN, seed=seed))
        for seed, name in enumerate(("one", "two", "three", "four"))
    ]


def evaluate(folder: RunFolder, steps: int, seconds: float) -> None:
    folder.metrics.write_text(
        "env_steps,return_mean,return_std,steps_per_second,seconds\n"
        f"{steps},{-steps},2.5,123,{seconds}\n"
    )


def table_of(folders, workers: int = 2, enabled: bool = False) -> SweepTable:
    return SweepTable([(Job(f.config, f.path),) for f in folders], workers, enabled)


def shown(table: SweepTable) -> list[str]:
    """The lines of the table: what it says of all runs, and of each."""
    file = io.StringIO()
    rich.console.Console(file=file, width=120).print(table.view())
    title, *lines = file.getvalue().splitlines()
    rows = [re.split(r"\s*│\s*", line.strip("│ ")) for line in lines if line.startswith("│")]
    return [title.strip(), *(" ".join(row) for row in rows)]


def test_runs_under_way_count_in_progress_and_time_left(folders):
    table = table_of(folders)
    assert shown(table) == ["0 of 4 runs done; 0% of all steps; unknown time left"]
    table.started(folders[:2])
    assert shown(table)[1:] == ["one 0 % - - -", "two 0 % - - -"]
    evaluate(folders[0], 500, 50.0)  # a tenth of a second a step: 50 s, and 100 s of each other
    assert shown(table) == [
        "0 of 4 runs done; 12% of all steps; 0:02:55 left",
        "one 50% -500.0 ± 2.5 123 0:00:50",
        "two 0 % - - -",
    ]


def test_a_run_that_has_just_begun_takes_its_time(folders):
    """Two are finished, two are under way without an evaluation: not 0 seconds left."""
    table = table_of(folders)
    table.started(folders)
    for folder in folders[:2]:
        evaluate(folder, 1000, 60.0)
        table.ended(folder, None)
    assert shown(table)[0] == "2 of 4 runs done; 50% of all steps; 0:01:00 left"


def test_runs_that_have_ended_stay_below_those_under_way(folders):
    table = table_of(folders)
    table.started(folders[:3])
    evaluate(folders[1], 1000, 60.0)
    table.ended(folders[1], None)
    table.ended(folders[0], "why")
    assert shown(table) == [
        "2 of 4 runs done, 1 failed; 50% of all steps; 0:01:00 left",
        "three 0 % - - -",
        "one FAILED - -",
        "two finished -1000.0 ± 2.5 123",
    ]
    assert table.failures == [f"{folders[0].path}: why"]


def test_a_group_counts_its_time_once(folders):
    """Two runs in lockstep take as long as one."""
    table = SweepTable([tuple(Job(f.config, f.path) for f in folders[:2])], 1, False)
    table.started(folders[:2])
    for folder in folders[:2]:
        evaluate(folder, 500, 50.0)
    assert shown(table)[0] == "0 of 2 runs done; 50% of all steps; 0:00:50 left"


def test_a_run_whose_group_failed_waits_again(folders):
    table = SweepTable([tuple(Job(f.config, f.path) for f in folders[:2])], 1, False)
    table.started(folders[:2])
    for folder in folders[:2]:
        table.retried(folder, "killed")
    table.started(folders[:1])
    evaluate(folders[0], 500, 50.0)
    assert shown(table) == [
        "0 of 2 runs done; 25% of all steps; 0:02:30 left",
        "one 50% -500.0 ± 2.5 123 0:00:50",
    ]


def test_without_a_terminal_it_is_a_line_an_event(folders, capsys):
    with table_of(folders[:1], enabled=True) as table:
        table.started(folders[:1])
        evaluate(folders[0], 1000, 60.0)
        table.update()
        table.ended(folders[0], None)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "one: under way",
        "one: finished, return -1000.0 (1 of 1 runs done; 100% of all steps; 0:00:00 left)",
    ]
