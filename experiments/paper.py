"""The experiments of the paper: train what is missing, measure what is finished, make the page."""

import contextlib
import importlib
import itertools
import pathlib
from collections.abc import Sequence
from typing import Literal

from experiments import claims, curves, rows, scores, table2
from experiments.plan import Plan, in_order
from mapg_jax.config import Config
from mapg_jax.results import UnfinishedError, read_run
from mapg_jax.run_folder import RunFolder
from mapg_jax.sweep import run_all

Name = Literal[
    "table2", "fig1", "fig5", "fig2", "fig3", "fig4", "torcs", "overhead", "heads", "claims"
]
TITLES: dict[Name, str] = {
    "table2": "Table 2: five tasks",
    "fig1": "Figure 1: score over M, Hopper and Walker2d",
    "fig5": "Figure 5: score over M, the other tasks",
    "fig2": "Figure 2: spread and return during training, Pendulum",
    "fig3": "Figure 3: spread and angle within an episode, Pendulum",
    "fig4": "Figure 4: with and without noise",
    "torcs": "Driving, for TORCS",
    "overhead": "What the heads cost",
    "heads": "The heads",
    "claims": "The claims",
}
PAGE = "README.md"
HEAD = """# Results

Every number and picture here was written by a command; how runs are made and claims judged was
fixed beforehand, in [experiments/protocol.md](../experiments/protocol.md). What is not there yet is
shown as missing. Scores of all runs: [scores.csv](scores.csv); learning curves:
[curves.csv](curves.csv)."""


def make(
    plan: Plan, names: Sequence[Name], *, training: bool = True, workers: int | None = None
) -> tuple[pathlib.Path, list[str]]:
    """Trains what is missing, measures what is finished, and writes the page.

    Args:
      plan: what is run, and where it goes.
      names: the experiments.
      training: False makes the page from what there is.
      workers: runs side by side; by default as many as the cores and the memory allow.

    Returns:
      The page, and the failures.

    Raises:
      ValueError: if the results are of other steps or another preset.
    """
    refuse_other_protocols(plan)
    failures = train(plan, names, workers) if training else []
    measure_finished(plan, names)
    for name in names:
        module = experiment(name)
        if training and hasattr(module, "time_arms"):
            module.time_arms(plan)
    return write_page(plan), failures


def refuse_other_protocols(plan: Plan) -> None:
    """Results of other runs would be averaged with these, or hide them."""
    settings = {rows.identity(config)["settings"] for config in runs(plan, list(TITLES))}
    for result in scores.read_csv(scores.path(plan)):
        if result.steps != plan.base.steps:
            theirs = f"{result.steps:,} steps, and these have {plan.base.steps:,}"
        elif result.settings not in settings:
            theirs = f"other settings ({result.settings or 'those of the preset paper'})"
        else:
            continue
        raise ValueError(f"{plan.results} holds runs of {theirs}; choose another --out")


def experiment(name: Name):
    """A module with `runs(plan)`, `section(plan)`, and perhaps `measure` and `time_arms`."""
    return importlib.import_module(f"experiments.{name}")


def runs(plan: Plan, names: Sequence[Name]) -> list[Config]:
    """All runs of those experiments, in the protocol's order."""
    wanted = itertools.chain.from_iterable(experiment(name).runs(plan) for name in names)
    return in_order(plan, wanted)


def train(plan: Plan, names: Sequence[Name], workers: int | None) -> list[str]:
    """Trains what is neither in the results nor finished; gives the failures."""
    wanted = runs(plan, names)
    recorded = [rows.identity_of(result) for result in scores.read_csv(scores.path(plan))]
    waiting = [config for config in wanted if rows.identity(config) not in recorded]
    return run_all(
        [(config, plan.folder(config)) for config in waiting],
        workers=workers,
        on_finished=lambda folder: measure(plan, folder),
    )


def measure(plan: Plan, folder: RunFolder) -> None:
    """Adds all that is measured on a finished run, and is not there yet, to the results."""
    key = rows.identity(folder.config)
    scores.measure(plan, folder)
    curves.measure(plan, folder)
    for name in TITLES:
        module = experiment(name)
        if hasattr(module, "measure") and key in map(rows.identity, module.runs(plan)):
            module.measure(plan, folder)


def measure_finished(plan: Plan, names: Sequence[Name]) -> None:
    """Measures those of the runs whose folders are there and finished."""
    for config in runs(plan, names):
        if plan.folder(config).exists():
            folder = RunFolder.open(plan.folder(config))
            with contextlib.suppress(UnfinishedError):
                read_run(folder)
                measure(plan, folder)


def write_page(plan: Plan) -> pathlib.Path:
    """results/README.md: every experiment, from what is in the results."""
    plan.results.mkdir(parents=True, exist_ok=True)
    sections = [
        f"## {title}\n\n{experiment(name).section(plan)}\n\n{provenance(plan, name)}"
        for name, title in TITLES.items()
    ]
    page = plan.results / PAGE
    page.write_text("\n\n".join([HEAD, *sections]) + "\n")
    if plan.results == pathlib.Path("results"):  # the project's own, and its README's tables
        write_headline(plan, pathlib.Path("README.md"))
    return page


def write_headline(plan: Plan, readme: pathlib.Path) -> None:
    """Puts Table 2 and the verdicts where the project's README has its comments for them."""
    verdicts = ["| | claim | verdict |", "|---|---|---|"]
    verdicts += [f"| {v.claim} | {v.text} | {v.verdict} |" for v in claims.ledger(plan)]
    tables = {"table 2": table2.beside_the_paper(plan), "claims": "\n".join(verdicts)}
    if readme.exists():
        text = readme.read_text()
        for name, table in tables.items():
            begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
            before, found, rest = text.partition(begin)
            if found and end in rest:
                text = f"{before}{begin}\n{table}\n{end}{rest.partition(end)[2]}"
        readme.write_text(text)


def provenance(plan: Plan, name: Name) -> str:
    """The command of a section, and the runs, versions and days behind it."""
    wanted = experiment(name).runs(plan)
    command = f"`mapg paper {name} --seeds {plan.seeds}`"
    if not wanted:
        return f"Made by {command}."
    found = scores.of(plan, wanted)
    text = f"Made by {command}: {len(found)} of {len(set(wanted))} runs finished"
    if not found:
        return text + "."
    days = sorted({result.date for result in found})
    return (
        f"{text}, {plan.base.steps:,} steps each; "
        f"{' and '.join(sorted({r.versions for r in found}))}; "
        f"{days[0]}{f' to {days[-1]}' if len(days) > 1 else ''}."
    )
