"""Trackers beside metrics.csv and TensorBoard: Weights & Biases, MLflow. None of them stops a run.

A tracker is a callback of a run; where it writes is its own business: WANDB_MODE=offline and
MLFLOW_TRACKING_URI say so, as anywhere.
"""

import importlib
import logging
import math
import os
import pathlib
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol

from mapg_jax.runs.folder import RunFolder, values_of
from mapg_jax.runs.run import Event

LOG = logging.getLogger(__name__)
PROJECT = "mapg-jax"
NAMES = ("tensorboard", "wandb", "mlflow")
"""TensorBoard's events are always written."""


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
    """A tracker that is left out once it fails, with one line."""

    def __init__(self, name: str, folder: RunFolder, config: Mapping[str, Any]):
        self._name, self._folder = name, folder
        self._tracker: Tracker | None = None
        self._try(lambda: setattr(self, "_tracker", TRACKERS[name](folder, config)))

    def __call__(self, event: Event) -> None:
        if event.kind == "evaluation" and (tracker := self._tracker):
            numbers = {k: float(v) for k, v in event.row.items() if math.isfinite(v)}
            self._try(lambda: tracker.log(numbers, event.env_steps))

    def close(self) -> None:
        if tracker := self._tracker:
            names = ("curve.png", "video.mp4", "video.gif")
            files = [self._folder.path / name for name in names]
            self._try(lambda: tracker.close([file for file in files if file.exists()]))

    def _try(self, function: Callable[[], object]) -> None:
        try:
            function()
        except Exception as error:  # whatever a tracker does, the run goes on
            self._tracker = None
            reason = (str(error).strip() or repr(error)).splitlines()[0]
            LOG.warning("%s is told no more of the run: %s", self._name, reason)
