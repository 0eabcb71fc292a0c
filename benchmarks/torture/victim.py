"""The run that is broken, and what it is when nothing is."""

import dataclasses
import hashlib
import json
import pathlib
import signal
from typing import Any

import jax
import numpy as np

from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.finishing import finish
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.train import begin
from mapg_jax.training.config import Config, preset
from mapg_jax.training.trainer import make_trainer

SECONDS = 60
"""What takes longer hangs."""
CLOCK = ("seconds", "per_second")


def config(**changes: Any) -> Config:
    """Small, with many checkpoints."""
    small = {"steps": 4_000, "checkpoint_seconds": 1e-9, "checkpoints_kept": 3, "heads": 2}
    return preset("smoke", **{**small, "evaluate_every": 500, **changes})


def train(path: pathlib.Path, **changes: Any) -> RunFolder:
    """The run, undisturbed."""
    run = begin(config(**changes), path)
    run.go()
    finish(run.folder)
    return run.folder


def digest(tree: Any) -> str:
    """Of every bit of a state."""
    content = hashlib.blake2b()
    for leaf in jax.tree.leaves(tree):
        keys = jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        content.update(np.asarray(jax.random.key_data(leaf) if keys else leaf).tobytes())
    return content.hexdigest()


@dataclasses.dataclass(frozen=True)
class Ending:
    """All that a run leaves but its clock."""

    state: str
    rows: tuple[tuple[str, ...], ...]
    returns: tuple[float, ...]


def ending(folder: RunFolder) -> Ending:
    """Of a finished run; numbers as text, since NaN equals nothing."""
    shapes = make_trainer(folder.config).shapes
    state, _ = Checkpoints(folder.checkpoints, config=folder.digest).load(shapes)
    rows = tuple(
        tuple(str(v) for k, v in row.items() if not k.endswith(CLOCK))
        for row in read_metrics(folder.metrics)
    )
    return Ending(digest(state), rows, tuple(json.loads(folder.evaluation.read_text())["returns"]))


class Hang(BaseException):
    """It took too long. (Nothing that catches an Exception may swallow it.)"""


def within_time(function):
    """Its value.

    Raises:
      Hang: if it takes longer than SECONDS.
    """

    def late(*_):
        raise Hang

    previous = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        return function()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)


def refusal(error: Exception) -> str:
    """How a refusal is counted: as one line, or as what it should not be."""
    polite = isinstance(error, ValueError | OSError) and len(str(error).splitlines()) == 1
    return "refused in a line" if polite else f"TRACEBACK: {type(error).__name__}"
