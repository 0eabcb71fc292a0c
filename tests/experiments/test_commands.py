"""The commands in the results make the runs of their rows, by the rebuilt command line too."""

import functools
import pathlib
import shlex

import pytest

from experiments.catalogue import TITLES, runs
from experiments.plan import make_plan
from mapg_jax.cli import fields, paper, train
from mapg_jax.reports.results import Result, settings
from mapg_jax.reports.results_csv import read_csv
from mapg_jax.training.config import preset

RESULTS = pathlib.Path(__file__).parents[2] / "results"
ROWS = read_csv(RESULTS / "scores.csv")
EARLIER = read_csv(RESULTS / "version_1" / "scores.csv")


def columns(config) -> dict:
    """What a row says of its configuration."""
    return {
        "env": config.env,
        "algorithm": config.slug,
        "heads": config.heads,
        "seed": config.seed,
        "steps": config.steps,
        "settings": settings(config),
    }


def of_row(row: Result) -> dict:
    return {name: getattr(row, name) for name in columns(preset())}


def earlier(command: str) -> list[Result]:
    return [row for row in EARLIER if row.command.startswith(f"mapg {command} ")]


@functools.cache
def planned(command: str) -> list[dict]:
    """The columns of all runs of that command."""
    arguments = paper.parse(shlex.split(command)[2:])
    nowhere = pathlib.Path("nowhere")
    plan = make_plan(arguments.preset, arguments.steps, arguments.seeds, nowhere, nowhere)
    names = list(TITLES) if arguments.name == "all" else [arguments.name]
    return [columns(config) for config in runs(plan, names)]


def test_every_row_is_of_a_command_that_is_known():
    assert ROWS and all(row.command.startswith("mapg paper ") for row in ROWS)
    assert earlier("train") and len(earlier("train") + earlier("paper")) == len(EARLIER)


@pytest.mark.parametrize("row", earlier("train"), ids=lambda row: row.command.split("/")[-1])
def test_the_command_of_a_run_makes_it(row):
    arguments = train.parse(shlex.split(row.command)[2:])
    config = preset(arguments.preset, **fields.given(arguments))
    assert columns(config) == of_row(row)


def test_the_command_of_an_experiment_has_the_run_in_its_plan():
    for row in ROWS:
        assert of_row(row) in planned(row.command), row.command
