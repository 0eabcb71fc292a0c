"""mapg sweep: every field of a run takes several values, the grid is their product."""

import argparse
import datetime
import json
import pathlib
import sys
import typing
from typing import Any, TextIO

from mapg_jax.cli import config_file, fields
from mapg_jax.cli.console import complain, console, refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.cli.parser import Parser
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.runs.locking import lock
from mapg_jax.runs.signals import StoppedError
from mapg_jax.sweeps import forecast, grid, launchers
from mapg_jax.sweeps.folder import SweepFolder
from mapg_jax.sweeps.groups import disk_bytes, group_bytes
from mapg_jax.sweeps.sweep import Schedule, carry_out, make_schedule

EXAMPLE = "Example: mapg sweep --env hopper --heads 1 5 10 20 50 --seeds 5 --out runs/hopper-sweep"


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments; a value a field is as many as are given."""
    flags = config_file.expand(flags, several=True)
    name, algorithms = fields.settle(flags)
    command = parser("sweep", EXAMPLE)
    command.add_argument(
        "--out",
        type=pathlib.Path,
        required=True,
        help="Folder of the sweep, which must not exist or be empty; each run has a folder in it.",
    )
    command.add_argument(
        "--seeds", type=int, help="Seeds 0, 1, … so many; or list them with --seed."
    )
    command.add_argument(
        "--group",
        type=_grouping,
        default="auto",
        help="Runs that share a compiled program and go in lockstep: one, all that can, or so many "
        "at most; auto is one on a CPU and as many as half of an accelerator's memory holds, but "
        "of several none is idle.",
    )
    add_workers(command)
    command.add_argument(
        "--keep-replay",
        action="store_true",
        help="Keep the replay of finished runs on disk, so that they can be trained further.",
    )
    command.add_argument(
        "--dry-run",
        action="store_true",
        help="Show the runs, and the time, memory and disk they will take; write nothing.",
    )
    command.add_argument(
        "--measure",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="With --dry-run: time each program for a few seconds to predict the time.",
    )
    fields.add_preset(command)
    config_file.add_argument(command)
    fields.add(command, name, algorithms, several=True)
    fields.refuse_foreign_flags(command, flags, algorithms)
    return command.parse(flags)


def add_workers(command: Parser) -> None:
    """The flags that say how many workers there are, and where."""
    command.add_argument(
        "--workers",
        type=int,
        help="Processes side by side; by default as many as cores and memory allow.",
    )
    command.add_argument(
        "--launcher",
        choices=typing.get_args(launchers.Name),
        default="local",
        help="Where workers run: on this machine, as jobs of Slurm, or as tasks of Ray.",
    )
    command.add_argument(
        "--launcher-options",
        nargs="*",
        default=(),
        metavar="NAME=VALUE",
        help="Parameters of Slurm's jobs (submitit's names) or of Ray's tasks.",
    )


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Sweeps, or shows what it would do."""
    folder = refuse_politely(lambda: sweep_folder(arguments))
    schedule = refuse_politely(lambda: _schedule(folder))
    if arguments.dry_run:
        _show_schedule(schedule, arguments.measure, out)
        return
    refuse_politely(folder.create)
    _go(folder, schedule, out)


def go_on(path: pathlib.Path, out: TextIO) -> None:
    """Runs what is missing of a sweep.

    Raises:
      StoppedError: on SIGINT or SIGTERM, once all state is saved.
    """
    folder = refuse_politely(lambda: SweepFolder.open(path))
    _go(folder, refuse_politely(lambda: _schedule(folder)), out)


def sweep_folder(arguments: argparse.Namespace) -> SweepFolder:
    """What the flags ask for; nothing is written.

    Raises:
      ValueError: if the grid is empty, or the folder exists.
    """
    given: dict[str, Any] = {k: tuple(v) for k, v in fields.given(arguments).items()}
    for name, several in given.items():
        if not several:
            raise ValueError(f"the grid is empty: --{name.replace('_', '-')} has no values")
    seeds = arguments.seeds
    if seeds is not None:
        if seeds < 1:
            raise ValueError(f"the grid is empty: seeds must be at least 1, got {seeds}")
        if "seed" in given:
            raise ValueError("--seeds and --seed both say the seeds; give one of them")
        grid.refuse_a_vast_grid(seeds * grid.size(given))
        given["seed"] = tuple(range(seeds))
    if not is_blank(arguments.out):
        raise ValueError(
            f"{arguments.out} exists already; choose another --out, "
            f"or go on with: mapg resume {arguments.out}"
        )
    folder = SweepFolder(
        arguments.out,
        arguments.preset,
        given,
        group=arguments.group,
        keep_replay=arguments.keep_replay,
        workers=arguments.workers,
        launcher=arguments.launcher,
        launcher_options=tuple(arguments.launcher_options),
    )
    if same := grid.size(given) - len(folder.runs()):
        print(f"{same} cells are equal to others and are run once", file=sys.stderr)
    return folder


def _grouping(text: str) -> str | int:
    if text in ("auto", "one", "all"):
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be auto, one, all or a whole number, got {text!r}"
        ) from None


def _schedule(folder: SweepFolder) -> Schedule:
    return make_schedule(
        folder.runs(),
        workers=folder.workers,
        group=folder.group,
        keep_replay=folder.keep_replay,
        launcher=launchers.launcher(folder.launcher, folder.launcher_options),
    )


def _go(folder: SweepFolder, schedule: Schedule, out: TextIO) -> None:
    """Carries it out; prints the scores, and the failures before it exits with 1."""
    refusal = f"another process carries out {folder.path}"
    try:
        with refuse_politely(lambda: lock(folder.path / ".lock", refusal)):
            failures = refuse_politely(lambda: carry_out(schedule))
    except StoppedError as stopped:
        raise StoppedError(stopped.number, f"mapg resume {folder.path}") from None
    _print_scores(folder, out)
    print(f"sweep folder: {folder.path}", file=out)
    if failures:
        for failure in failures:
            complain(failure, 1)
        sys.exit(1)


def _print_scores(folder: SweepFolder, out: TextIO) -> None:
    import rich.table  # slow to import

    table = rich.table.Table("run", "mean", "std", "episodes")
    for config, path in folder.runs():
        run, cells = RunFolder(path, config), ("missing", "", "")
        if run.scored_steps() >= config.steps:
            score = json.loads(run.evaluation.read_text())
            cells = f"{score['mean']:.1f}", f"{score['std']:.1f}", str(score["episodes"])
        table.add_row(path.name, *cells)
    console(out).print(table)


def _show_schedule(schedule: Schedule, measure: bool, out: TextIO) -> None:
    import rich.table  # slow to import

    table = rich.table.Table("group", "run", "steps")
    for number, group in enumerate(schedule.groups, 1):
        for job in group:
            table.add_row(str(number), job.path.name, f"{job.config.steps:,}")
    console(out).print(table)
    memory = schedule.workers * max(map(group_bytes, schedule.groups))
    disk = disk_bytes(schedule.groups, schedule.workers, schedule.keep_replay)
    runs = sum(map(len, schedule.groups))
    print(
        f"{runs} runs in {len(schedule.groups)} groups, {schedule.workers} side by side", file=out
    )
    print(f"memory: {memory / 1e9:.1f} GB of training state", file=out)
    print(f"disk:   {disk / 1e9:.1f} GB of checkpoints at most", file=out)
    if measure:
        seconds = forecast.predict(schedule.groups, schedule.workers)
        text = str(datetime.timedelta(seconds=round(seconds)))
        print(f"time:   {text}, from a second of each program on this machine as it is", file=out)
