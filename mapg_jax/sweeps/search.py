"""A search for hyper-parameters: trials of Optuna, each a run of its own, pruned at evaluations.

The study lies in a journal beside the runs: what is stopped goes on with the trials under way.
"""

import dataclasses
import json
import math
import os
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import optuna
from optuna.storages.journal import JournalFileBackend

from mapg_jax.runs.folder import FORMAT, RunFolder, make_folder, write_json
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.signals import StoppedError, caught_signals
from mapg_jax.sweeps import launchers
from mapg_jax.sweeps.groups import Job, workers_that_fit
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

    def suggested(self, trial: optuna.Trial, name: str) -> Any:
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


@dataclasses.dataclass(frozen=True)
class SearchFolder:
    """Where a search keeps what it looks for, its study, and its runs."""

    path: pathlib.Path
    preset: str
    values: Mapping[str, Any]
    """Of the fields that are given; all others are the preset's."""
    space: Mapping[str, Dimension]
    """Of the fields that are looked for."""
    trials: int
    workers: int | None = None
    launcher: launchers.Name = "local"
    launcher_options: tuple[str, ...] = ()

    def config(self, found: Mapping[str, Any]) -> Config:
        """A run of the search."""
        return preset(self.preset, **{**self.values, **found})

    def create(self) -> None:
        """Makes the folder and writes into it what is looked for.

        Raises:
          ValueError: if an end of a range is none of its field, or the folder exists.
        """
        for name, dimension in self.space.items():
            for value in dimension.ends:
                self.config({name: value})
        make_folder(self.path)
        record = {"format": FORMAT, **dataclasses.asdict(self)}
        del record["path"]
        write_json(self.path / "search.json", record)

    @classmethod
    def is_one(cls, path: str | os.PathLike) -> bool:
        """Whether a folder is that of a search."""
        return (pathlib.Path(path) / "search.json").is_file()

    @classmethod
    def open(cls, path: str | os.PathLike) -> "SearchFolder":
        """The folder of an earlier search.

        Raises:
          ValueError: if it cannot be read.
        """
        path = pathlib.Path(path)
        file = path / "search.json"
        try:
            record = json.loads(file.read_text())
            if (found := record.pop("format", 1)) != FORMAT:
                raise ValueError(f"it is of format {found!r}, and this version reads {FORMAT}")
            space = {k: Dimension(**_tuples(v)) for k, v in record.pop("space").items()}
            options = tuple(record.pop("launcher_options", ()))
            values = _tuples(record.pop("values"))
            return cls(path, values=values, space=space, launcher_options=options, **record)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{file} is damaged: {error}") from None

    def study(self) -> optuna.Study:
        """The trials so far; Optuna's tree of Parzen estimators asks, its median rule prunes."""
        backend = JournalFileBackend(str(self.path / "study.journal"))
        return optuna.create_study(
            storage=optuna.storages.JournalStorage(backend),
            study_name="search",
            direction="maximize",
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=0),
            pruner=optuna.pruners.MedianPruner(n_startup_trials=4),
        )


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Of JSON, which has lists alone."""
    return {k: tuple(map(_tuple, v)) if isinstance(v, list) else v for k, v in values.items()}


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


class _Trial:
    """A trial and the worker that carries it out."""

    def __init__(self, search: SearchFolder, trial: optuna.Trial, share, launcher):
        self.trial, self.share = trial, share
        found = {name: axis.suggested(trial, name) for name, axis in search.space.items()}
        self.job = Job(search.config(found), search.path / f"trial-{trial.number}")
        self.pruned = False
        self._told = set(trial.storage.get_trial(trial._trial_id).intermediate_values)
        self.worker = Worker((self.job,), share, False, launcher)

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
        states = optuna.trial.TrialState
        if failure is None:
            score = float(json.loads(self.folder.evaluation.read_text())["mean"])
            study.tell(self.trial, score)
            return f"{self.job.path.name}: score {score:.1f}"
        study.tell(self.trial, state=states.PRUNED if self.pruned else states.FAIL)
        return f"{self.job.path.name}: {'pruned' if self.pruned else failure.splitlines()[0]}"


def carry_out(search: SearchFolder, tell: Callable[[str], None] = lambda line: None) -> None:
    """Begins the trials that are missing and goes on with those that were cut off.

    Args:
      search: what is looked for.
      tell: called with a line an event.

    Raises:
      ValueError: if a launcher lacks its package, or memory does not suffice.
      StoppedError: on SIGINT or SIGTERM, once all workers have saved their state.
    """
    study = search.study()
    launcher = launchers.launcher(search.launcher, search.launcher_options)
    states = optuna.trial.TrialState
    cut_off = [optuna.Trial(study, t._trial_id) for t in study.get_trials(states=[states.RUNNING])]
    missing = search.trials - len(study.get_trials(deepcopy=False))
    count = _workers(search, launcher, missing + len(cut_off))
    free, under_way = launcher.shares(count), []
    with caught_signals() as signals:
        try:
            while (cut_off or missing > 0 or under_way) and not signals:
                while free and (cut_off or missing > 0):
                    if not cut_off:
                        missing -= 1
                    trial = cut_off.pop(0) if cut_off else study.ask()
                    under_way.append(_Trial(search, trial, free.pop(0), launcher))
                    tell(f"{under_way[-1].job.path.name}: {_shown(search, under_way[-1])}")
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


def _workers(search: SearchFolder, launcher: launchers.Launcher, trials: int) -> int:
    largest = {name: axis.ends[-1] for name, axis in search.space.items()}
    job = Job(search.config(largest), search.path / "largest")
    if launcher.here:
        return workers_that_fit([(job,)] * max(1, trials), search.workers)
    return max(1, min(search.workers or trials, trials))


def _shown(search: SearchFolder, trial: _Trial) -> str:
    return ", ".join(f"{name} {getattr(trial.job.config, name)}" for name in search.space)


def best(search: SearchFolder) -> tuple[RunFolder, float] | None:
    """The run with the highest score, and its score; None if no trial has finished."""
    states = optuna.trial.TrialState
    done: Sequence[Any] = search.study().get_trials(deepcopy=False, states=[states.COMPLETE])
    if not done:
        return None
    found = max(done, key=lambda trial: trial.values)
    return RunFolder.open(search.path / f"trial-{found.number}"), found.values[0]
