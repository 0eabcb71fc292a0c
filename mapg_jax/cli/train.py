"""mapg train: a run from its first step to its score."""

import argparse
import logging
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

from mapg_jax.cli import completion, config_file, fields
from mapg_jax.cli.console import complain, refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.cli.score import print_score
from mapg_jax.runs import hosts, memory, trackers
from mapg_jax.runs.finishing import finish
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.run import Run
from mapg_jax.runs.signals import caught_signals
from mapg_jax.runs.train import begin
from mapg_jax.runs.video import film
from mapg_jax.training.config import FITTED, preset

LOG = logging.getLogger(__name__)
EXAMPLE = (
    "Example: mapg train --env hopper --heads 10 --steps 2000000 --seed 0 --out runs/hopper-m10"
)


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments; the other flags depend on --algorithm and --preset."""
    flags = config_file.expand(flags)
    name, (algorithm, *_) = fields.settle(flags)
    command = parser("train", EXAMPLE)
    fields.add_preset(command)
    command.add_argument(
        "--out",
        type=pathlib.Path,
        help="Run folder, which must not exist or be empty; by default a free number under runs/.",
    )
    command.add_argument(
        "--print-config",
        action="store_true",
        help="Print the configuration as YAML, which --config reads, and train nothing.",
    )
    add_track(command)
    config_file.add_argument(command)
    add_devices(command)
    fields.add(command, name, [algorithm], several=False)
    fields.refuse_foreign_flags(command, flags, [algorithm])
    return command.parse(flags)


def add_track(command: argparse.ArgumentParser) -> None:
    """The flag that names trackers."""
    action = command.add_argument(
        "--track",
        nargs="+",
        default=(),
        metavar="|".join(trackers.NAMES),
        help="Trackers that are told of every evaluation; TensorBoard always is.",
    )
    completion.propose(action, lambda: trackers.NAMES)


def add_devices(command: argparse.ArgumentParser) -> None:
    """The flag that lays shards over devices."""
    command.add_argument(
        "--devices",
        type=_all_or_number,
        metavar="all|D",
        help="Devices for the shards of the run, a number that divides them; by default all.",
    )
    command.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help="Of the first of several hosts, which make one run; or slurm, whose job says all.",
    )
    command.add_argument("--hosts", type=int, help="How many processes make the run.")
    command.add_argument("--host", type=int, help="Which of them this is, from 0.")


def join_hosts(arguments: argparse.Namespace) -> None:
    """Meets the other processes of the run, if there are any."""
    if (arguments.coordinator, arguments.hosts, arguments.host) == (None, None, None):
        return
    address = None if arguments.coordinator == "slurm" else arguments.coordinator
    refuse_politely(lambda: hosts.join(address, arguments.hosts, arguments.host))


def _all_or_number(text: str) -> int | None:
    """None is all."""
    if text != "all" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be all or a whole number, got {text!r}")
    return None if text == "all" else int(text)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Trains."""
    given = fields.given(arguments)
    if arguments.print_config:
        config = refuse_politely(lambda: preset(arguments.preset, **given))
        refuse_politely(config.make_env)  # which knows its options
        print(config_file.dump(config), end="", file=out)
        return
    refuse_politely(lambda: trackers.refuse_missing(arguments.track))
    join_hosts(arguments)
    under_way = refuse_politely(lambda: _begun(arguments, given))
    take_to_the_end(under_way, out, arguments.track)


def _begun(arguments: argparse.Namespace, given: Mapping[str, Any]) -> Run:
    """A replay of a size that somebody asked for is refused if it does not fit."""
    config = preset(arguments.preset, **given)
    if arguments.preset in FITTED and "replay_size" not in given:
        config = memory.fitting(config, arguments.devices)
    return begin(config, arguments.out, arguments.devices)


def take_to_the_end(run: Run, out: TextIO, track: Sequence[str] = ()) -> None:
    """Trains and scores, with a bar, obeying signals; trackers hear of it."""
    folder = run.folder
    with trackers.tracking(folder, track if hosts.is_first() else ()) as callbacks:
        if not run.finished:
            with caught_signals() as signals:
                run.go(callbacks, signals=signals, progress=True)
        if hosts.is_first():
            _score(folder, out)
            if callbacks:
                _film(folder)
    hosts.wait("scored")


def _film(folder: RunFolder) -> None:
    """The video that trackers are given; a task or a machine that cannot draw goes without."""
    try:
        film(folder)
    except Exception as error:  # whatever draws, the run is trained and scored
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        LOG.warning("no video for trackers: %s", reason)


def _score(folder: RunFolder, out: TextIO) -> None:
    print(f"scoring the last policy: {folder.config.final_episodes} episodes", file=sys.stderr)
    try:
        score = finish(folder)
    except KeyboardInterrupt:
        sys.exit(complain(f"interrupted while scoring; go on with: mapg resume {folder.path}", 130))
    print_score(score, out)
    print(f"run folder:     {folder.path}", file=out)
    print(f"learning curve: {folder.curve}", file=out)
