"""A search for hyper-parameters: trials of Optuna, each a run of its own, pruned at evaluations.

The study lies in a journal beside the runs: what is stopped goes on with the trials under way.
"""

import dataclasses
import json
import math
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, Self

import optuna
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.signals import StoppedError, caught_signals
from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.folder import FolderOfRuns
from mapg_jax.sweeps.groups import Job, group_bytes, refuse_a_full_disk, workers_that_fit
from mapg_jax.sweeps.pool import Worker
from mapg_jax.training.config import Config, preset

optuna.logging.set_verbosity(optuna.logging.ERROR)
POLL_SECONDS = 0.5


@dataclasses.dataclass(frozen=True)
class Dimension:
    """What a field may be: one of several values, or a number of a range."""

    choices: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    log: bool = False

    def __post_init__(self):
        """
        Raises:
          ValueError: if there is neither a choice nor a range of numbers.
        """
        numbers = all(type(end) in (int, float) for end in self.ends)
        if self.choices or (numbers and self.low < self.high and not (self.log and self.low <= 0)):
            return
        above = " above 0" if self.log else ""
        raise ValueError(f"{self.low}..{self.high} is no range of numbers{above}, low..high")

    def suggested(self, trial: optuna.Trial | FrozenTrial, name: str) -> Any:
        """The value of a trial."""
        if self.choices:  # by number: Optuna keeps no tuples
            return self.choices[trial.suggest_categorical(name, list(range(len(self.choices))))]
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values that show whether all are possible."""
        return self.choices or (self.low, self.high)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchFolder(FolderOfRuns):
    """Where a search keeps what it looks for, its study, and its runs."""

    FILE: ClassVar[str] = "search.json"

    space: Mapping[str, Dimension]
    """Of the fields that are looked for."""
    trials: int

    def __post_init__(self):
        super().__post_init__()
        if self.trials < 1:
            raise ValueError(f"trials must be at least 1, got {self.trials}")

    def config(self, found: Mapping[str, Any]) -> Config:
        """A run of the search."""
        return preset(self.preset, **{**self.values, **found})

    def found(self, trial: optuna.Trial | FrozenTrial) -> dict[str, Any]:
        """The values of a trial."""
        return {name: axis.suggested(trial, name) for name, axis in self.space.items()}

    def run(self, number: int) -> pathlib.Path:
        """The run folder of a trial."""
        return self.path / f"trial-{number}"

    def check(self) -> None:
        for name, axis in self.space.items():
            for value in axis.ends:
                self.config({name: value})

    @classmethod
    def of_record(cls, path: pathlib.Path, record: dict[str, Any]) -> Self:
        space = {name: Dimension(**axis) for name, axis in record["space"].items()}
        return super().of_record(path, {**record, "space": space})

    def study(self) -> optuna.Study:
        """The trials so far; Optuna's tree of Parzen estimators asks, its median rule prunes.

        It is for the one process that carries out the search: a line of the journal that an
        earlier one did not end is cut off, or Optuna would write the next one behind it.

        Raises:
          ValueError: if the journal cannot be read.
        """
        journal = self.path / "study.journal"
        if journal.exists():
            os.truncate(journal, journal.read_bytes().rfind(b"\n") + 1)
        try:
            study = optuna.create_study(
                storage=optuna.storages.JournalStorage(JournalFileBackend(str(journal))),
                study_name="search",
                direction="maximize",
                load_if_exists=True,
                pruner=optuna.pruners.MedianPruner(n_startup_trials=4),
            )
            # A search that goes on draws others than those that it had drawn first.
            study.sampler = optuna.samplers.TPESampler(seed=len(study.trials))
            return study
        except (AssertionError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{journal} is damaged: {error}") from None


class Plan(NamedTuple):
    """How a search will be carried out."""

    search: SearchFolder
    workers: int
    launcher: launchers.Launcher


def make_plan(search: SearchFolder) -> Plan:
    """How many trials go side by side, and where; nothing is written.

    Raises:
      ValueError: if a value is none of its field, a launcher lacks its package, or memory or disk
        do not suffice.
    """
    launcher = launchers.launcher(search.launcher, search.launcher_options)
    largest = _largest(search)
    trials = [(Job(largest, search.run(number)),) for number in range(search.trials)]
    if launcher.here:
        workers = workers_that_fit(trials, search.workers)
    else:  # the machines that they run on know what fits
        workers = min(search.workers or search.trials, search.trials)
    refuse_a_full_disk(trials, workers, keep_replay=False)
    return Plan(search, workers, launcher)


def _largest(search: SearchFolder) -> Config:
    """The run that needs the most memory, as far as the ends of the space show.

    It has the largest value of every field, or of one where these do not go together.
    """

    def size(found: Mapping[str, Any]) -> int:
        return group_bytes((Job(search.config(found), search.path),))

    each = {
        name: max(axis.ends, key=lambda value, name=name: size({name: value}))
        for name, axis in search.space.items()
    }
    try:
        size(each)
    except ValueError:
        return search.config(max(({name: each[name]} for name in each), key=size))
    return search.config(each)


class _Trial:
    """A trial and the worker that carries it out."""

    def __init__(self, trial: optuna.Trial, job: Job, share: launchers.Share, launcher):
        self.trial, self.job, self.share = trial, job, share
        self.pruned = False
        self._told = set(trial.storage.get_trial(trial._trial_id).intermediate_values)
        self.worker = Worker((job,), share, False, launcher)

    @property
    def folder(self) -> RunFolder:
        return RunFolder(self.job.path, self.job.config)

    def report(self) -> None:
        """Tells of new evaluations; one that falls behind the median of the others is stopped."""
        for row in read_metrics(self.folder.metrics) if self.folder.metrics.exists() else []:
            step = int(row["env_steps"])
            if step not in self._told and math.isfinite(row["return_mean"]):
                self._told.add(step)
                self.trial.report(row["return_mean"], step)
                self.pruned = self.pruned or self.trial.should_prune()
        if self.pruned:
            self.worker.stop()

    def conclude(self, study: optuna.Study) -> str:
        """Tells what became of it, once its worker has ended; gives a line."""
        self.worker.wait()
        failure = self.worker.failures().get(self.job.path)
        if failure is None:
            score = float(json.loads(self.folder.evaluation.read_text())["mean"])
            study.tell(self.trial, score)
            return f"{self.job.path.name}: score {score:.1f}"
        study.tell(self.trial, state=TrialState.PRUNED if self.pruned else TrialState.FAIL)
        return f"{self.job.path.name}: {'pruned' if self.pruned else failure.splitlines()[0]}"


def carry_out(
    plan: Plan, tell: Callable[[str], None] = lambda line: None
) -> tuple[RunFolder, float] | None:
    """Begins the trials that are missing and goes on with those that were cut off.

    Args:
      plan: of a search whose folder exists.
      tell: called with a line an event.

    Returns:
      The run with the highest score, and its score; None if no trial has one.

    Raises:
      ValueError: if the study or the folder of a trial is damaged.
      StoppedError: on SIGINT or SIGTERM, once all workers have saved their state.
    """
    search, study = plan.search, plan.search.study()
    ended = sum(trial.state.is_finished() for trial in study.get_trials(deepcopy=False))
    free = plan.launcher.shares(max(1, min(plan.workers, search.trials - ended)))
    trials, under_way = _trials(study, search.trials), []
    with caught_signals() as signals:
        try:
            while not signals:
                while free and not signals and (trial := next(trials, None)):
                    if job := _job(search, study, trial, tell):
                        under_way.append(_Trial(trial, job, free.pop(0), plan.launcher))
                if not under_way:
                    break
                for trial in list(under_way):
                    trial.report()
                    if not trial.worker.running():
                        tell(trial.conclude(study))
                        under_way.remove(trial)
                        free.append(trial.share)
                time.sleep(POLL_SECONDS)
        finally:
            for trial in under_way:
                trial.worker.stop()
            for trial in under_way:
                trial.worker.wait()
    if signals:
        raise StoppedError(signals[0], f"mapg resume {search.path}")
    return _best(search, study)


def _trials(study: optuna.Study, count: int) -> Iterator[optuna.Trial]:
    """Those that were cut off, and new ones until there are so many."""
    for trial in study.get_trials(states=[TrialState.RUNNING]):
        yield optuna.Trial(study, trial._trial_id)
    while len(study.get_trials(deepcopy=False)) < count:
        yield study.ask()


def _job(
    search: SearchFolder, study: optuna.Study, trial: optuna.Trial, tell: Callable[[str], None]
) -> Job | None:
    """The run of a trial; None if its values do not go together, which ends the trial."""
    found, path = search.found(trial), search.run(trial.number)
    tell(f"{path.name}: {', '.join(f'{name} {value}' for name, value in found.items())}")
    try:
        return Job(search.config(found), path)
    except ValueError as error:
        study.tell(trial, state=TrialState.PRUNED)  # of a failure Optuna would learn nothing
        tell(f"{path.name}: left out: {error}")
        return None


def _best(search: SearchFolder, study: optuna.Study) -> tuple[RunFolder, float] | None:
    done = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    if not done:
        return None
    trial = max(done, key=lambda trial: trial.values)
    config = search.config(search.found(trial))  # the folder may be gone
    return RunFolder(search.run(trial.number), config), trial.values[0]
