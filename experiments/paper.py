"""The experiments of the paper: train what is missing, measure what is finished, make the page."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from experiments import curves, page, rows, scores
from experiments.catalogue import TITLES, Name, experiment, runs
from experiments.plan import Plan
from mapg_jax.reports.results import UnfinishedError, run_key, settings, versions
from mapg_jax.runs.folder import RunFolder, create_folder, is_blank, this_process
from mapg_jax.runs.locking import Lock, lock
from mapg_jax.runs.member import DIVERGED
from mapg_jax.runs.signals import StoppedError
from mapg_jax.sweeps.sweep import carry_out, make_schedule
from mapg_jax.sweeps.worker import failure_file
from mapg_jax.training.config import Config


class Made(NamedTuple):
    """What became of an invocation."""

    page: pathlib.Path
    sections: dict[Name, str]
    """Of the page, as Markdown."""
    failures: list[str]
    """A line for each run that failed, or could not be measured."""


def make(
    plan: Plan, names: Sequence[Name], *, training: bool = True, workers: int | None = None
) -> Made:
    """Trains what is missing, measures what is finished, and writes the page.

    Args:
      plan: what is run, and where it goes.
      names: the experiments.
      training: False makes the page from what there is.
      workers: runs side by side; by default as many as the cores and the memory allow.

    Raises:
      ValueError: if the results are of another protocol or cannot be written, or there is nothing
        to make the page from.
      BlockingIOError: if another process is training the runs.
      StoppedError: on SIGINT or SIGTERM, once the runs are saved and the page is written.
    """
    refuse_other_protocols(plan)
    if not training:
        refuse_nothing(plan, names)
    failures = []
    try:
        if training:
            failures = train(plan, names, workers)
            with training_lock(plan):
                for module in map(experiment, names):
                    if hasattr(module, "carry_out"):
                        failures += module.carry_out(plan)
    except StoppedError:
        conclude(plan, names)
        raise
    made = conclude(plan, names)
    return made._replace(failures=list(dict.fromkeys([*failures, *made.failures])))


def conclude(plan: Plan, names: Sequence[Name]) -> Made:
    """Measures what is finished, names what diverged, and writes the page."""
    with writing_lock(plan):
        failures = measure_finished(plan, names)
        record_diverged(plan, runs(plan, names))
        sections = page.sections(plan)
        return Made(page.write(plan, sections), sections, failures)


def training_lock(plan: Plan) -> Lock:
    """Two processes would both train what is missing."""
    create_folder(plan.results)  # a page that could not be written is found out before training
    create_folder(plan.runs)
    return lock(
        plan.runs / ".training.lock",
        f"another mapg paper is training in {plan.runs}; wait for it, "
        "or show what there is with --no-train",
    )


def writing_lock(plan: Plan) -> Lock:
    """Two processes that add rows to the same files would lose some."""
    create_folder(plan.results)
    return lock(plan.results / ".writing.lock", wait=True)


def refuse_other_protocols(plan: Plan) -> None:
    """Results of other runs would be averaged with these, or hide them."""
    planned = runs(plan, list(TITLES))
    steps: dict[tuple, set[int]] = {}
    for config in planned:
        arm = config.env, config.slug, config.heads
        steps.setdefault(arm, {plan.base.steps}).add(config.steps)
    known = {settings(config) for config in planned}
    found = scores.read(plan)
    for number, result in enumerate(found):
        arm = result.env, result.algorithm, result.heads
        if result.steps not in steps.get(arm, {plan.base.steps}):
            theirs = f"runs of {result.steps:,} steps, and these have {plan.base.steps:,}"
        elif result.settings not in known:
            theirs = f"other settings ({result.settings or 'those of the preset paper'})"
        elif (result.episodes, result.select) != (plan.base.final_episodes, "uniform"):
            theirs = f"a run that was scored by {result.episodes} episodes and {result.select}"
        elif reason := scores.difference(
            found[:number], result.versions, result.env, result.physics
        ):
            theirs = f"a run that {reason}"
        else:
            continue
        raise ValueError(f"{plan.results} holds {theirs}; choose another --out")


def refuse_nothing(plan: Plan, names: Sequence[Name]) -> None:
    """A page of what is missing is none."""
    begun = any(not is_blank(plan.folder(config)) for config in runs(plan, names))
    if not (begun or scores.path(plan).exists() or plan.measured.exists()):
        raise ValueError(
            f"there is nothing to show: no results in {plan.results}, no runs in {plan.runs}; "
            "leave out --no-train to train them"
        )


def refuse_to_mix(plan: Plan, waiting: Sequence[Config]) -> None:
    """Runs begun now must compare with those there are, else hours are lost."""
    recorded = scores.read(plan)
    for env, config in {config.env: config for config in waiting}.items():
        ours = versions(config, [this_process()])
        if reason := scores.difference(recorded, ours, env, config.make_env().backend):
            raise ValueError(f"what would be trained here {reason}; choose another --out")


def train(plan: Plan, names: Sequence[Name], workers: int | None) -> list[str]:
    """Trains what is not in the results and has not diverged; gives the failures."""
    recorded = {result.run for result in scores.read(plan)}
    diverged = rows.of(plan.measured / rows.DIVERGED, runs(plan, names))
    named = [{k: row[k] for k in rows.COLUMNS} for row in diverged]
    waiting = [
        config
        for config in runs(plan, names)
        if run_key(config) not in recorded and rows.identity(config) not in named
    ]
    refuse_to_mix(plan, waiting)
    unmeasured: list[str] = []

    def add(folder: RunFolder) -> None:
        if folder.config not in waiting:
            return  # it was given more steps since; `measure_finished` names it
        with writing_lock(plan):
            unmeasured.extend(measure(plan, folder))

    sweep = make_schedule([(config, plan.folder(config)) for config in waiting], workers=workers)
    with training_lock(plan):
        return carry_out(sweep, on_finished=add) + unmeasured


def record_diverged(plan: Plan, configs: Sequence[Config]) -> None:
    """They are named, count as missing, and would only diverge again."""
    file = plan.measured / rows.DIVERGED
    for config in configs:
        failure = failure_file(plan.folder(config))
        reason = failure.read_text().strip() if failure.exists() else ""
        if reason.startswith(DIVERGED) and not rows.holds(file, rows.identity(config)):
            rows.append(file, [{**rows.identity(config), "reason": reason.splitlines()[0]}])


def measure(plan: Plan, folder: RunFolder) -> list[str]:
    """Adds all that is measured on a finished run, and is not there yet, to the results.

    Returns:
      What went wrong, which must not stop the other runs; nothing, or one line.
    """
    key = run_key(folder.config)
    try:
        scores.measure(plan, folder)
        curves.measure(plan, folder)
        for name in TITLES:
            module = experiment(name)
            if hasattr(module, "measure") and key in map(run_key, module.runs(plan)):
                module.measure(plan, folder)
    except UnfinishedError:
        return []
    except (ValueError, OSError) as error:
        return [f"{folder.path}: {error}"]
    return []


def measure_finished(plan: Plan, names: Sequence[Name]) -> list[str]:
    """Measures those of the runs whose folders are there and finished; gives the failures."""
    failures = []
    for config in runs(plan, names):
        if is_blank(plan.folder(config)):
            continue
        try:
            folder = RunFolder.open(plan.folder(config))
        except ValueError as error:
            failures.append(str(error))
            continue
        if folder.config == config:
            failures += measure(plan, folder)
        else:
            failures.append(f"{folder.path} holds a run of another configuration")
    return failures
