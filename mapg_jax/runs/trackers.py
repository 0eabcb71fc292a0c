"""Trackers beside metrics.csv and TensorBoard: Weights & Biases, MLflow. None holds a run up.

A tracker is a callback of a run; where it writes is its own business: WANDB_MODE=offline and
MLFLOW_TRACKING_URI say so, as anywhere.
"""

import importlib
import logging
import math
import os
import pathlib
import queue
import shlex
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol

from mapg_jax.runs.folder import RunFolder, values_of
from mapg_jax.runs.run import Event

LOG = logging.getLogger(__name__)
PROJECT = "mapg-jax"
NAMES = ("tensorboard", "wandb", "mlflow")
"""TensorBoard's events are always written."""
PATIENCE = 10.0
"""Seconds, at most, that the end of a run waits for a tracker."""


class Tracker(Protocol):
    """One tracker of one run."""

    def log(self, numbers: Mapping[str, float], step: int) -> None: ...

    def close(self, files: Sequence[pathlib.Path]) -> None:
        """The end of the run; `files` are its curve and its video, where they are there."""
        ...


class Wandb:
    """Weights & Biases."""

    def __init__(self, folder: RunFolder, config: Mapping[str, Any]):
        self._wandb = importlib.import_module("wandb")
        self._run = self._wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            dir=str(folder.path),
            name=folder.path.name,
            config=dict(config),
            settings=self._wandb.Settings(silent=True),
        )

    def log(self, numbers: Mapping[str, float], step: int) -> None:
        self._run.log(dict(numbers), step=step)

    def close(self, files: Sequence[pathlib.Path]) -> None:
        media = {".png": self._wandb.Image, ".mp4": self._wandb.Video, ".gif": self._wandb.Video}
        self._run.log({file.stem: media[file.suffix](str(file)) for file in files})
        self._run.finish()


class Mlflow:
    """MLflow; without MLFLOW_TRACKING_URI in a database of the run folder."""

    def __init__(self, folder: RunFolder, config: Mapping[str, Any]):
        # By itself it tries for minutes, to reach a server that is not there.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "5")
        logging.getLogger("urllib3").setLevel(logging.ERROR)  # the error that ends them says it all
        mlflow = importlib.import_module("mlflow")
        if not os.environ.get("MLFLOW_TRACKING_URI"):
            mlflow.set_tracking_uri(f"sqlite:///{folder.path.absolute() / 'mlflow.db'}")
        self._client = mlflow.MlflowClient()
        found = self._client.get_experiment_by_name(PROJECT)
        experiment = found.experiment_id if found else self._client.create_experiment(PROJECT)
        self._run = self._client.create_run(experiment, run_name=folder.path.name).info.run_id
        for name, value in config.items():
            self._client.log_param(self._run, name, value)

    def log(self, numbers: Mapping[str, float], step: int) -> None:
        for name, value in numbers.items():
            self._client.log_metric(self._run, name, value, step=step)

    def close(self, files: Sequence[pathlib.Path]) -> None:
        for file in files:
            self._client.log_artifact(self._run, str(file))
        self._client.set_terminated(self._run)


TRACKERS: Mapping[str, Callable[[RunFolder, Mapping[str, Any]], Tracker]] = {
    "wandb": Wandb,
    "mlflow": Mlflow,
}


def refuse_missing(names: Sequence[str]) -> None:
    """Raises ValueError if a tracker is unknown or not installed."""
    for name in names:
        if name not in NAMES:
            raise ValueError(f"track must be among {', '.join(NAMES)}, got {name!r}")
        if name in TRACKERS:
            try:
                importlib.import_module(name)
            except ImportError:
                raise ValueError(f"--track {name} needs: pip install 'mapg-jax[{name}]'") from None


@contextmanager
def tracking(folder: RunFolder, names: Sequence[str]) -> Iterator[list[Callable[[Event], None]]]:
    """Callbacks that tell trackers of every evaluation; at the end they are told of it.

    Args:
      folder: of the run.
      names: among NAMES.
    """
    config = {**values_of(folder.config), "command": shlex.join(["mapg", *sys.argv[1:]])}
    with ExitStack() as stack:
        callbacks = []
        for name in dict.fromkeys(names):
            if name in TRACKERS:
                careful = _Careful(name, folder, config)
                stack.callback(careful.close)
                callbacks.append(careful)
        yield callbacks


class _Careful:
    """A tracker in a thread of its own, so that training never waits for it; it is left out once it
    fails, with one line."""

    def __init__(self, name: str, folder: RunFolder, config: Mapping[str, Any]):
        self._name, self._folder, self._given_up = name, folder, False
        self._waiting: queue.SimpleQueue[Callable[[Tracker], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, args=(config,), daemon=True)
        self._thread.start()

    def __call__(self, event: Event) -> None:
        if event.kind == "evaluation" and self._thread.is_alive():
            numbers = {k: float(v) for k, v in event.row.items() if math.isfinite(v)}
            self._waiting.put(lambda tracker: tracker.log(numbers, event.env_steps))

    def close(self) -> None:
        names = ("curve.png", "video.mp4", "video.gif")
        files = [self._folder.path / name for name in names]
        there = [file for file in files if file.exists()]
        self._waiting.put(lambda tracker: tracker.close(there))
        self._waiting.put(None)
        self._thread.join(PATIENCE)
        if self._thread.is_alive():
            self._give_up(f"it has not answered for {PATIENCE:g} s")

    def _work(self, config: Mapping[str, Any]) -> None:
        try:
            tracker = TRACKERS[self._name](self._folder, config)
            while told := self._waiting.get():
                told(tracker)
        except Exception as error:  # whatever a tracker does, the run goes on
            self._give_up((str(error).strip() or repr(error)).splitlines()[0])

    def _give_up(self, reason: str) -> None:
        if not self._given_up:
            self._given_up = True
            LOG.warning("%s is told no more of the run: %s", self._name, reason)
