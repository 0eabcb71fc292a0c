"""mapg evaluate: E starts, one episode each."""

import argparse
import json
import pathlib
import typing
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.cli.score import print_score
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.scoring import Physics, evaluate


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "evaluate",
        "A score by other episodes, physics, choices or seeds than the run's own stands beside its "
        "official one, in evaluations/.",
    )
    command.add_argument("path", type=pathlib.Path, help="Run folder.")
    command.add_argument(
        "--episodes", type=int, help="E; by default the number that the run was trained to have."
    )
    command.add_argument(
        "--physics",
        choices=typing.get_args(Physics),
        default="auto",
        help="What to run on: what the run's --engine means here, a named one, or Gymnasium's own.",
    )
    command.add_argument(
        "--select",
        default="uniform",
        help="How one action is made of the M proposals: uniform, argmax-q, mean or first; A3C "
        "samples (uniform) or takes its mean.",
    )
    command.add_argument("--seed", type=int, default=0, help="Of starts and actions.")
    command.add_argument("--json", action="store_true", help="Print one JSON object, no table.")
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Scores."""
    record = refuse_politely(
        lambda: evaluate(
            RunFolder.open(arguments.path),
            arguments.episodes,
            arguments.physics,
            arguments.select,
            arguments.seed,
        )
    )
    if arguments.json:
        print(json.dumps(record), file=out)
    else:
        print_score(record, out)
