"""The experiments of the paper: train what is missing, measure what is finished, make the page."""

import contextlib
import fcntl
import pathlib
from collections.abc import Iterator, Sequence

from experiments import curves, overhead, page, rows, scores
from experiments.catalogue import TITLES, Name, experiment, runs
from experiments.plan import Plan
from mapg_jax.config import Config
from mapg_jax.results import UnfinishedError, read_run
from mapg_jax.run_folder import RunFolder
from mapg_jax.sweep import run_all
from mapg_jax.worker import failure_file


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
      ValueError: if the results are of another protocol, or another process is writing them.
    """
    refuse_other_protocols(plan)
    with alone(plan.results):
        failures = train(plan, names, workers) if training else []
        measure_finished(plan, names)
        if training and {"overhead", "claims"} & set(names):
            overhead.time_arms(plan)
        return page.write(plan), failures


@contextlib.contextmanager
def alone(folder: pathlib.Path) -> Iterator[None]:
    """Two processes that add rows to the same files would lose some."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"another mapg paper is writing into {folder}; wait for it") from None
        yield


def refuse_other_protocols(plan: Plan) -> None:
    """Results of other runs would be averaged with these, or hide them."""
    settings = {rows.identity(config)["settings"] for config in runs(plan, list(TITLES))}
    found = scores.read_csv(scores.path(plan))
    for result in found:
        if result.steps != plan.base.steps:
            theirs = f"runs of {result.steps:,} steps, and these have {plan.base.steps:,}"
        elif result.settings not in settings:
            theirs = f"other settings ({result.settings or 'those of the preset paper'})"
        elif result.versions != found[0].versions:
            theirs = f"runs of {found[0].versions} and of {result.versions}, which do not compare"
        else:
            continue
        raise ValueError(f"{plan.results} holds {theirs}; choose another --out")


def train(plan: Plan, names: Sequence[Name], workers: int | None) -> list[str]:
    """Trains what is not in the results and has not diverged; gives the failures."""
    recorded = [rows.identity_of(result) for result in scores.read_csv(scores.path(plan))]
    recorded += [
        {k: row[k] for k in rows.COLUMNS} for row in rows.read(plan.measured / rows.DIVERGED)
    ]
    waiting = [config for config in runs(plan, names) if rows.identity(config) not in recorded]
    unmeasured: list[str] = []

    def add(folder: RunFolder) -> None:
        try:
            measure(plan, folder)
        except (ValueError, OSError) as error:  # which must not stop the other runs
            unmeasured.append(f"{folder.path}: {error}")

    failures = run_all(
        [(config, plan.folder(config)) for config in waiting], workers=workers, on_finished=add
    )
    record_diverged(plan, waiting)
    return failures + unmeasured


def record_diverged(plan: Plan, configs: Sequence[Config]) -> None:
    """They are named, count as missing, and would only diverge again."""
    for config in configs:
        file = failure_file(plan.folder(config))
        reason = file.read_text().strip() if file.exists() else ""
        if "no longer finite" in reason:
            new = [{**rows.identity(config), "reason": reason.splitlines()[0]}]
            rows.append(plan.measured / rows.DIVERGED, new)


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
        if not plan.folder(config).exists():
            continue
        folder = RunFolder.open(plan.folder(config))
        if folder.config != config:
            raise ValueError(f"{folder.path} holds a run of another configuration")
        with contextlib.suppress(UnfinishedError):
            read_run(folder)
            measure(plan, folder)
