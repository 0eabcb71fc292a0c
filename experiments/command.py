"""The command `mapg paper`."""

import dataclasses
import pathlib
import sys
from typing import Literal, TextIO

import tyro

from experiments import paper
from experiments.catalogue import TITLES, Name
from experiments.plan import Plan, make_plan
from mapg_jax.cli.console import complain, refuse_politely
from mapg_jax.training.config import PRESETS


@dataclasses.dataclass(kw_only=True)
class Paper:
    """Make a table or figure of the paper: train the runs that are missing, then draw it.

    Runs that are in the results already are skipped, those that were cut off go on.
    Example: mapg paper table2 --seeds 3
    """

    name: tyro.conf.Positional[Literal[Name, "all"]]
    """Of the experiment; all of them share their runs."""
    steps: int | None = None
    """Environment steps a run; by default the preset's, 2,000,000."""
    seeds: int = 3
    """Seeds 0, 1, … so many of every cell."""
    preset: Literal["paper", "smoke"] = "paper"
    """The paper's set-up, or one that ends in seconds a run."""
    train: bool = True
    """--no-train makes it from the runs that are there."""
    workers: int | None = None
    """Processes side by side; by default as many as cores and memory allow."""
    out: pathlib.Path | None = None
    """Folder of the results; by default results/, of other steps or presets beside their runs."""

    def run(self, out: TextIO) -> None:
        plan = refuse_politely(self._plan)
        names: list[Name] = list(TITLES) if self.name == "all" else [self.name]
        made = refuse_politely(
            lambda: paper.make(plan, names, training=self.train, workers=self.workers)
        )
        for name in names:
            print(f"{made.sections[name]}\n", file=out)
        print(f"all results: {made.page}", file=out)
        if made.failures:
            for failure in made.failures:
                complain(failure, 1)
            sys.exit(1)

    def _plan(self) -> Plan:
        if self.seeds < 1:
            raise ValueError(f"seeds must be at least 1, got {self.seeds}")
        own = [self.preset] if self.preset != "paper" else []
        own += [str(self.steps)] if self.steps not in (None, PRESETS[self.preset].steps) else []
        runs = pathlib.Path("runs") / "-".join(["paper", *own])
        results = runs / "results" if own else pathlib.Path("results")
        return make_plan(self.preset, self.steps, self.seeds, runs, self.out or results)
