"""mapg paper: a table or figure of the paper."""

import argparse
import pathlib
import sys
from typing import TextIO, get_args

from experiments import paper
from experiments.catalogue import TITLES, Name
from experiments.plan import Plan, make_plan
from mapg_jax.cli.console import complain, refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.training.config import preset


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "paper",
        "Runs that are in the results already are skipped, those that were cut off go on.\n"
        "Example: mapg paper table2",
    )
    command.add_argument(
        "name",
        choices=(*get_args(Name), "all"),
        help="Of the experiment; all of them share their runs.",
    )
    command.add_argument(
        "--steps", type=int, help="Environment steps a run; by default the preset's, 2,000,000."
    )
    command.add_argument(
        "--seeds",
        type=int,
        help="Seeds 2000, 2001, … of each cell, at most; by default as many as the protocol has.",
    )
    command.add_argument(
        "--preset",
        choices=("paper", "smoke"),
        default="paper",
        help="The paper's set-up, or one that ends in seconds a run.",
    )
    command.add_argument(
        "--train",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="--no-train makes it from the runs that are there.",
    )
    command.add_argument(
        "--workers",
        type=int,
        help="Processes side by side; by default as many as cores and memory allow.",
    )
    command.add_argument(
        "--out",
        type=pathlib.Path,
        help="Folder of the results; by default results/, of other steps or presets beside their "
        "runs.",
    )
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Makes it."""
    plan = refuse_politely(lambda: _plan(arguments))
    names: list[Name] = list(TITLES) if arguments.name == "all" else [arguments.name]
    made = refuse_politely(
        lambda: paper.make(plan, names, training=arguments.train, workers=arguments.workers)
    )
    for name in names:
        print(f"{made.sections[name]}\n", file=out)
    print(f"all results: {made.page}", file=out)
    if made.failures:
        for failure in made.failures:
            complain(failure, 1)
        sys.exit(1)


def _plan(arguments: argparse.Namespace) -> Plan:
    if arguments.seeds is not None and arguments.seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {arguments.seeds}")
    name, steps = arguments.preset, arguments.steps
    own = [name] if name != "paper" else []
    own += [str(steps)] if steps not in (None, preset(name).steps) else []
    runs = pathlib.Path("runs") / "-".join(["paper", *own])
    results = runs / "results" if own else pathlib.Path("results")
    return make_plan(name, steps, arguments.seeds, runs, arguments.out or results)
