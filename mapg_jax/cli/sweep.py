"""The command `mapg sweep`: a flag a field, each with any number of values."""

import ast
import dataclasses
import datetime
import inspect
import itertools
import json
import pathlib
import re
import sys
import textwrap
import typing
from typing import Annotated, Any, Literal, TextIO

import rich.table
import tyro

from mapg_jax.cli.console import complain, console, refuse_politely
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.runs.locking import lock
from mapg_jax.runs.signals import StoppedError
from mapg_jax.sweeps import forecast as timing
from mapg_jax.sweeps import grid
from mapg_jax.sweeps.folder import SweepFolder
from mapg_jax.sweeps.groups import disk_bytes, group_bytes
from mapg_jax.sweeps.sweep import Plan, carry_out, make_plan
from mapg_jax.training.config import PRESETS, Config, Preset


@dataclasses.dataclass(kw_only=True)
class SweepOptions:
    """Train a grid of runs: every field of a run takes several values, the grid is their product.

    Example: mapg sweep --env hopper --heads 1 5 10 20 50 --seeds 5 --out runs/hopper-sweep
    """

    out: pathlib.Path
    """Folder of the sweep; must not exist or be empty. Each run has a folder in it."""
    seeds: int | None = None
    """Seeds 0, 1, … so many; or list them with --seed."""
    group: Literal["auto", "one", "all"] | int = "auto"
    """Runs that share a compiled program and go in lockstep: one, all that can, or so many at
    most; auto is one on a CPU and as many as half of an accelerator's memory holds."""
    workers: int | None = None
    """Processes side by side; by default as many as cores and memory allow."""
    keep_replay: bool = False
    """Keep the replay of finished runs on disk, so that they can be trained further."""
    dry_run: bool = False
    """Show the runs, and the time, memory and disk they will take; write nothing."""
    measure: bool = True
    """With --dry-run: time each program for a few seconds to predict the time."""
    preset: Preset = "paper"
    """Where the defaults below come from."""

    def run(self, out: TextIO) -> None:
        folder = refuse_politely(self.folder)
        plan = refuse_politely(lambda: _plan(folder))
        if self.dry_run:
            _show_plan(plan, self.measure, out)
            return
        refuse_politely(folder.create)
        _go(folder, plan, out)

    def folder(self) -> SweepFolder:
        """What the flags ask for; nothing is written.

        Raises:
          ValueError: if the grid is empty, or the folder exists.
        """
        values = {f.name: getattr(self.grid, f.name) for f in dataclasses.fields(Config)}
        if self.seeds is not None:
            if self.seeds < 1:
                raise ValueError(f"the grid is empty: seeds must be at least 1, got {self.seeds}")
            if values["seed"] != (0,):
                raise ValueError("--seeds and --seed both say the seeds; give one of them")
            values["seed"] = tuple(range(self.seeds))
        if not is_blank(self.out):
            raise ValueError(
                f"{self.out} exists already; choose another --out, "
                f"or go on with: mapg resume {self.out}"
            )
        for name, several in values.items():
            if not several:
                raise ValueError(f"the grid is empty: --{name.replace('_', '-')} has no values")
        first = {k: v[0] for k, v in values.items()}
        if len(values["algorithm"]) > 1:
            first["algorithm"] = "mapg"  # a base with a3c would lose what only MAPG reads
        base = dataclasses.replace(PRESETS[self.preset], **first)
        values = {k: v for k, v in values.items() if len(v) > 1}
        folder = SweepFolder(self.out, base, values, self.group, self.workers, self.keep_replay)
        same = grid.size(values) - len(folder.runs())
        if same:
            print(f"{same} cells are equal to others and are run once", file=sys.stderr)
        return folder


def parse(flags: list[str], base: Config) -> SweepOptions:
    """The command from its flags; fields have one value by default, that of `base`."""
    return tyro.cli(_command(base), prog="mapg sweep", args=flags)


def resume(path: pathlib.Path, out: TextIO) -> None:
    """Runs what is missing of a sweep.

    Raises:
      StoppedError: on SIGINT or SIGTERM, once all state is saved.
    """
    folder = refuse_politely(lambda: SweepFolder.open(path))
    _go(folder, refuse_politely(lambda: _plan(folder)), out)


def _plan(folder: SweepFolder) -> Plan:
    return make_plan(
        folder.runs(), workers=folder.workers, group=folder.group, keep_replay=folder.keep_replay
    )


def _go(folder: SweepFolder, plan: Plan, out: TextIO) -> None:
    """Carries it out; prints the scores, and the failures before it exits with 1."""
    refusal = f"another process carries out {folder.path}"
    try:
        with refuse_politely(lambda: lock(folder.path / ".lock", refusal)):
            failures = refuse_politely(lambda: carry_out(plan))
    except StoppedError as stopped:
        raise StoppedError(stopped.number, f"mapg resume {folder.path}") from None
    table = rich.table.Table("run", "mean", "std", "episodes")
    for config, path in folder.runs():
        run, cells = RunFolder(path, config), ("missing", "", "")
        if run.scored_steps() >= config.steps:
            score = json.loads(run.evaluation.read_text())
            cells = f"{score['mean']:.1f}", f"{score['std']:.1f}", str(score["episodes"])
        table.add_row(path.name, *cells)
    console(out).print(table)
    print(f"sweep folder: {folder.path}", file=out)
    if failures:
        for failure in failures:
            complain(failure, 1)
        sys.exit(1)


def _show_plan(plan: Plan, measure: bool, out: TextIO) -> None:
    table = rich.table.Table("group", "run", "steps")
    for number, group in enumerate(plan.groups, 1):
        for job in group:
            table.add_row(str(number), job.path.name, f"{job.config.steps:,}")
    console(out).print(table)
    memory = plan.workers * max(map(group_bytes, plan.groups))
    disk = disk_bytes(plan.groups, plan.workers, plan.keep_replay)
    runs = sum(map(len, plan.groups))
    print(f"{runs} runs in {len(plan.groups)} groups, {plan.workers} side by side", file=out)
    print(f"memory: {memory / 1e9:.1f} GB of training state", file=out)
    print(f"disk:   {disk / 1e9:.1f} GB of checkpoints at most", file=out)
    if measure:
        seconds = timing.predict(plan.groups, plan.workers)
        text = str(datetime.timedelta(seconds=round(seconds)))
        print(f"time:   {text}, from a second of each program on this machine as it is", file=out)


def _command(base: Config) -> type[SweepOptions]:
    """`SweepOptions` with a tuple of values for each field of a configuration."""
    hints, helps = typing.get_type_hints(Config), _docstrings(Config)
    fields = []
    for field in dataclasses.fields(Config):
        one: Any = hints[field.name]
        if typing.get_origin(one) is tuple:
            one = Annotated[one, _comma_joined(typing.get_args(one)[0])]
        several = Annotated[tuple[one, ...], tyro.conf.arg(help=helps[field.name])]
        default = dataclasses.field(default=(getattr(base, field.name),))
        fields.append((field.name, several, default))
    values = dataclasses.make_dataclass("Fields", fields)
    return dataclasses.make_dataclass(
        "Sweep",
        [("grid", tyro.conf.OmitArgPrefixes[values], dataclasses.field(default_factory=values))],
        bases=(SweepOptions,),
        kw_only=True,
    )


def _comma_joined(kind: type) -> tyro.constructors.PrimitiveConstructorSpec:
    """One value of several items: 64,64. Commas within brackets belong to an item."""

    def parse(texts: list[str]) -> tuple:
        items = re.split(r",(?![^(\[]*[)\]])", texts[0]) if texts[0] else []
        return tuple(map(kind, items))

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{kind.__name__.upper()},…",
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(map(str, value))],
    )


def _docstrings(cls: type) -> dict[str, str]:
    """The string below each field."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    body = typing.cast(ast.ClassDef, definition).body
    return {
        field.target.id: ast.literal_eval(text.value)
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
    }
