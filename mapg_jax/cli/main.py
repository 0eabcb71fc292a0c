"""The command line: mapg train | sweep | resume | evaluate | drive | report | paper | envs."""

import dataclasses
import itertools
import json
import os
import pathlib
import sys
from typing import TextIO, cast

import jax
import rich.console
import rich.table
import tyro

import envs
from experiments.command import Paper
from mapg_jax.algorithms import heads
from mapg_jax.cli.console import complain, console, own_stdout, parse_politely, refuse_politely
from mapg_jax.cli import sweep as sweep_command
from mapg_jax.cli.sweep import SweepOptions
from mapg_jax.reports import document
from mapg_jax.reports.report import compose, gather, write
from mapg_jax.runs.finishing import finish
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.member import DivergedError
from mapg_jax.runs.recording import draw_drive
from mapg_jax.runs.runner import resume, start
from mapg_jax.runs.scoring import Physics, evaluate
from mapg_jax.runs.signals import StoppedError
from mapg_jax.sweeps.folder import SweepFolder
from mapg_jax.training.config import PRESETS, Config, Preset


@dataclasses.dataclass
class Train:
    """Train a policy.

    Example: mapg train --env hopper --heads 10 --steps 2000000 --seed 0 --out runs/hopper-m10
    """

    config: tyro.conf.OmitArgPrefixes[Config]
    preset: Preset = "paper"
    """Where the defaults below come from: the paper's set-up, one for accelerators, or one that
    ends in seconds."""
    out: pathlib.Path | None = None
    """Run folder; must not exist or be empty. By default the next free number under runs/."""

    def run(self, out: TextIO) -> None:
        run = refuse_politely(lambda: start(self.config, self.out))
        run.go(progress=True)
        _finish(run.folder, out)


@dataclasses.dataclass
class Resume:
    """Go on with a run, bit for bit as if it had not stopped, or with what a sweep still lacks."""

    path: tyro.conf.Positional[pathlib.Path]
    """Folder of a run or of a sweep."""
    steps: int | None = None
    """A new total of environment steps, to train a finished run further."""

    def run(self, out: TextIO) -> None:
        if SweepFolder.is_one(self.path):
            if self.steps is not None:
                sys.exit(complain(f"{self.path} is a sweep; --steps trains a run of it further", 2))
            sweep_command.resume(self.path, out)
        else:
            self._resume_run(out)

    def _resume_run(self, out: TextIO) -> None:
        run = refuse_politely(lambda: resume(self.path, self.steps))
        if run.finished:
            print(
                f"{self.path} is finished: {run.env_steps:,} steps; "
                "--steps with a larger number trains it further",
                file=out,
            )
            if run.folder.scored_steps() >= run.folder.config.steps:  # else it was cut off before
                return
        else:
            run.go(progress=True)
        _finish(run.folder, out)


@dataclasses.dataclass
class Evaluate:
    """Score a run's newest checkpoint: E starts, one episode each."""

    path: tyro.conf.Positional[pathlib.Path]
    """Run folder."""
    episodes: int = 100
    """E."""
    physics: Physics = "auto"
    """What to run on: what the run's --engine means here, a named one, or Gymnasium's own task."""
    select: heads.Select = "uniform"
    """How one action is made of the M proposals; for A3C, uniform samples its Gaussian, mean takes
    its mean."""
    seed: int = 0
    """Of starts and actions."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self, out: TextIO) -> None:
        record = refuse_politely(
            lambda: evaluate(
                RunFolder.open(self.path), self.episodes, self.physics, self.select, self.seed
            )
        )
        if self.json:
            print(json.dumps(record), file=out)
        else:
            _print_score(record, out)


@dataclasses.dataclass
class Drive:
    """Draw one episode of a driving run: the line on the track, and an animation for a browser."""

    path: tyro.conf.Positional[pathlib.Path]
    """Run folder; drive.png and drive.html are written into it."""
    select: heads.Select = "uniform"
    """How one action is made of the M proposals."""
    seed: int = 0
    """Of the start and the heads."""

    def run(self, out: TextIO) -> None:
        for picture in refuse_politely(self._draw):
            print(picture, file=out)

    def _draw(self) -> list[pathlib.Path]:
        folder = RunFolder.open(self.path)
        if folder.config.env != "driving":
            raise ValueError(f"{self.path} is a run of {folder.config.env}, not of driving")
        return draw_drive(folder, self.seed, self.select)


@dataclasses.dataclass
class Report:
    """Finished runs side by side: tables with intervals over seeds, and pictures.

    Example: mapg report runs/hopper-m1-1 runs/hopper-m10-1 --out report
    """

    paths: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Run folders, folders of them at any depth, and CSV files of results."""
    out: pathlib.Path | None = None
    """Folder for report.md, its pictures, report.csv and report.html, which needs no other file."""

    def run(self, out: TextIO) -> None:
        print(refuse_politely(self._write), file=out, end="")

    def _write(self) -> str:
        if not self.paths:
            raise ValueError("name a run folder, a folder of them or a CSV file of results")
        runs = gather(self.paths)
        blocks = compose(runs)
        if self.out:
            write(blocks, runs, self.out)
        return document.markdown(blocks, pictures=False)


@dataclasses.dataclass
class Envs:
    """List the environments."""

    def run(self, out: TextIO) -> None:
        headers = ("name", "observation", "action", "time limit", "engines", "equals")
        table = rich.table.Table(*(rich.table.Column(h, overflow="fold") for h in headers))
        for name in envs.names():
            spec, env = envs.spec(name), envs.make(name)
            table.add_row(
                name,
                str(env.observation_size),
                str(env.action_size),
                str(spec.time_limit),
                ", ".join(spec.engines),
                spec.gymnasium_id or "",
            )
        console(out).print(table)
        print("brax:NAME takes any environment of Brax.", file=out)


def main() -> None:
    """The command `mapg`."""
    # Networks of this size are too small to share among XLA's threads, which wait for each other:
    # one is faster and leaves the other cores to the physics. NPROC in the environment wins.
    os.environ.setdefault("NPROC", "1")
    with parse_politely():
        command = _parse(sys.argv[1:])
    jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    with own_stdout() as out:
        try:
            command.run(out)
        except DivergedError as error:
            sys.exit(complain(str(error), 1))
        except KeyboardInterrupt:
            sys.exit(complain("interrupted", 130))
        except OSError as error:  # a full disk, say
            sys.exit(complain(str(error), 1))
        except StoppedError as error:
            sys.exit(complain(str(error), 128 + error.number))


COMMANDS = {
    "train": Train,
    "sweep": SweepOptions,
    "resume": Resume,
    "evaluate": Evaluate,
    "drive": Drive,
    "report": Report,
    "paper": Paper,
    "envs": Envs,
}


def _parse(arguments: list[str]):
    # One command at a time: tyro's messages then name flags as the user wrote them.
    name, *flags = arguments or ["--help"]
    if name in COMMANDS:
        prog, preset = f"mapg {name}", PRESETS[_named_preset(flags)]
        if name == "sweep":
            return sweep_command.parse(flags, preset)
        if name == "train":
            return tyro.cli(Train, prog=prog, args=flags, default=Train(preset))
        return tyro.cli(COMMANDS[name], prog=prog, args=flags)
    description = "Multiple Action Policy Gradients. Each command has its own --help."
    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="mapg", description=description, args=[name]
    )


def _named_preset(flags: list[str]) -> Preset:
    """The value of --preset: the other flags' defaults depend on it. Unknown ones tyro refuses."""
    for flag, following in itertools.pairwise([*flags, ""]):
        name, equals, value = flag.partition("=")
        if name == "--preset":
            value = value if equals else following
            return cast(Preset, value) if value in PRESETS else "paper"
    return "paper"


def _finish(folder: RunFolder, out: TextIO) -> None:
    _print_score(finish(folder), out)
    print(f"run folder:     {folder.path}", file=out)
    print(f"learning curve: {folder.curve}", file=out)


def _print_score(record: dict, out: TextIO) -> None:
    scored = record.get("metrics", {})
    titles = ("env", "physics", "select", "episodes", "mean", "std", "95 % interval")
    table = rich.table.Table(*titles, *(f"mean {name}" for name in scored))
    low, high = record["ci95"]
    table.add_row(
        record["env"],
        record["physics"],
        record["select"],
        str(record["episodes"]),
        f"{record['mean']:.1f}",
        f"{record['std']:.1f}",
        f"{low:.1f} to {high:.1f}",
        *(f"{sum(values) / len(values):.1f}" for values in scored.values()),
    )
    console(out).print(table)


def _cache_folder() -> pathlib.Path:
    """Compiled programs, kept between commands."""
    base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(
        os.environ.get("JAX_COMPILATION_CACHE_DIR") or pathlib.Path(base) / "mapg-jax"
    )
