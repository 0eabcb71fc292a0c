"""mapg resume: what a run or a sweep still lacks."""

import argparse
import pathlib
import sys
from typing import TextIO

from mapg_jax.cli import search, sweep
from mapg_jax.cli.console import complain, refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.cli.train import add_devices, add_track, join_hosts, take_to_the_end
from mapg_jax.runs import trackers
from mapg_jax.runs.train import take_up
from mapg_jax.sweeps.folder import SweepFolder


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser("resume")
    command.add_argument("path", type=pathlib.Path, help="Folder of a run or of a sweep.")
    command.add_argument(
        "--steps",
        type=int,
        help="A new total of environment steps, to train a finished run further.",
    )
    add_track(command)
    add_devices(command)
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Goes on."""
    path, steps = arguments.path, arguments.steps
    if (path / "search.json").is_file():
        _refuse_flags_of_runs(arguments, "search")
        search.go_on(path, out)
        return
    if SweepFolder.is_one(path):
        _refuse_flags_of_runs(arguments, "sweep")
        sweep.go_on(path, out)
        return
    refuse_politely(lambda: trackers.refuse_missing(arguments.track))
    join_hosts(arguments)
    under_way = refuse_politely(lambda: take_up(path, steps, arguments.devices))
    if under_way.finished:
        print(
            f"{path} is finished: {under_way.env_steps:,} steps; "
            "--steps with a larger number trains it further",
            file=out,
        )
        folder = under_way.folder
        if folder.scored_steps() >= folder.config.steps:  # else it was cut off before its score
            return
    take_to_the_end(under_way, out, arguments.track)


def _refuse_flags_of_runs(arguments: argparse.Namespace, what: str) -> None:
    of_runs = ("steps", "track", "devices", "coordinator", "hosts", "host")
    for name in (name for name in of_runs if getattr(arguments, name) not in (None, ())):
        sys.exit(complain(f"{arguments.path} is a {what}; --{name} is for a run of it", 2))
