"""Finished runs as records, and what makes two of them comparable."""

import contextlib
import dataclasses
import datetime
import functools
import json
import math
import os
import pathlib
import shlex
import types
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mapg_jax.algorithms import registry
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.runs.sealing import refuse_a_broken_seal
from mapg_jax.training.config import Config, fields, preset, presets_of

COLUMNS_OF_THEIR_OWN = {"env", "algorithm", "heads", "seed", "steps"}
CURVE = ("env_steps", "return_mean", "return_std", "spread", "q_gap_relative")


class UnfinishedError(ValueError):
    """The run has not reached its last step, or its last policy has no score."""


class RunKey(NamedTuple):
    """What tells a run from every other one."""

    env: str
    algorithm: str  # its slug
    heads: int
    seed: int
    steps: int
    settings: str


class Result(NamedTuple):
    """One finished run: what was trained, how its last policy scored, and where it comes from."""

    env: str
    algorithm: str  # its slug: ddpg (MAPG with M = 1), mapg, a3c, …
    heads: int  # M
    seed: int
    steps: int  # environment steps taken
    return_mean: float  # over the episodes of the last policy
    return_std: float  # with E - 1
    episodes: int  # E
    settings: str  # what else differs from the preset `paper`, as name=value
    select: str  # how one action was made of the M proposals
    physics: str  # what the episodes ran on
    versions: str  # of the packages that define the task
    seconds: float  # of training, by the wall clock
    date: str  # UTC day of the run's last command
    command: str
    processor: str = ""  # this and the next four: of the process that trained; '' if not recorded
    instructions: str = ""
    commit: str = ""
    threads: str = ""  # of XLA
    engine: str = ""  # of the physics
    metrics: Mapping[str, float] = types.MappingProxyType({})  # the environment's own numbers

    @property
    def run(self) -> RunKey:
        """What tells it from every other one."""
        return RunKey(*(getattr(self, name) for name in RunKey._fields))


COLUMNS = Result._fields[:-1]
"""Of a CSV file of results, before those of the environments' own metrics."""
HOST = tuple(name for name in COLUMNS if name in Result._field_defaults)
"""Those of the process that trained, which older files do not have."""


class Protocol(NamedTuple):
    """What runs must have in common to be compared."""

    steps: int
    preset: str
    settings: str  # of what all runs have; the algorithm's own are what comparisons are about
    select: str
    physics: str
    episodes: int
    versions: str
    recorded: bool  # whether it is known what machine trained them


def read_run(folder: RunFolder | str | os.PathLike) -> Result:
    """The record of a finished run, from what it wrote.

    Raises:
      UnfinishedError: if it has not reached its last step, or has no evaluation.
      ValueError: if there is no run, or a file of it is damaged.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    return read_scored(folder)[0]


def read_scored(folder: RunFolder) -> tuple[Result, dict[str, Any]]:
    """`read_run`, and the score that it comes from: evaluation.json."""
    if not folder.evaluation.exists():
        raise UnfinishedError(f"{folder.path} is not finished: it has no evaluation.json")
    config, last = folder.config, _metrics(folder)[-1]
    if last["env_steps"] < config.steps:
        raise UnfinishedError(
            f"{folder.path} is not finished: {last['env_steps']:,.0f} of {config.steps:,} steps"
        )
    with _reading(folder.path / "config.json") as record:
        history = record["history"]
        origin: dict[str, Any] = {
            "versions": versions(config, history),
            "date": history[-1].get("date") or _day(folder.evaluation),
            "command": str(history[0]["command"]),
            **{name: _joined(process.get("host", {}).get(name) for process in history)
               for name in HOST},
        }  # fmt: skip
    with _reading(folder.evaluation) as score:
        result = Result(
            **run_key(config)._replace(steps=int(last["env_steps"]))._asdict(),
            return_mean=finite(score["mean"]),
            return_std=finite(score["std"]),
            episodes=int(score["episodes"]),
            select=str(score["select"]),
            physics=str(score["physics"]),
            seconds=round(last["seconds"], 1),
            **origin,
            metrics=_summed_up(config, score.get("metrics", {})),
        )
        scored = int(score.get("env_steps", config.steps))
    refuse_a_broken_seal(folder, score)
    if scored < config.steps:
        raise UnfinishedError(f"{folder.path} is not finished: its score is of step {scored:,}")
    return result, score


def find_runs(path: str | os.PathLike) -> list[RunFolder]:
    """The run at `path`, or all runs below it at any depth, in the order of their names.

    Raises:
      ValueError: if there is none, or the configuration of one is damaged.
    """
    path = pathlib.Path(path)
    if not path.exists():
        raise ValueError(f"there is no {path}")
    if not path.is_dir():
        raise ValueError(f"{path} is neither a run folder, a folder of them nor a CSV of results")
    found = [RunFolder.open(file.parent) for file in sorted(path.rglob("config.json"))]
    if not found:
        raise ValueError(f"there are no runs in {path}")
    return found


@functools.cache
def run_key(config: Config) -> RunKey:
    """What tells a run from every other one."""
    return RunKey(
        config.env, config.slug, config.heads, config.seed, config.steps, settings(config)
    )


def settings(config: Config) -> str:
    """Every field that bears on learning or the task and is not the preset paper's."""
    paper = preset("paper", config.algorithm)
    bears = {name for name, field in fields(type(config)).items() if not field.metadata["host"]}
    values = {name: getattr(config, name) for name in sorted(bears - COLUMNS_OF_THEIR_OWN)}
    values["env_options"] = tuple(sorted(config.env_options))
    return shlex.join(f"{k}={_text(v)}" for k, v in values.items() if v != getattr(paper, k))


def versions(config: Config, history: Iterable[Mapping[str, Any]]) -> str:
    """The packages that define the task, of every process of a run, in order, where they differ.

    Args:
      config: of the run.
      history: of its folder, or `run_folder.this_process()` alone.
    """
    names = ("gymnasium", "mujoco", *(["brax"] if config.env.startswith("brax:") else []))
    texts = (", ".join(f"{n} {process['packages'][n]}" for n in names) for process in history)
    return _joined(texts)


class Settings(NamedTuple):
    """The settings of a run, sorted: by what all runs have, and by its algorithm's own."""

    preset: str  # the nearest one
    common: str  # what else differs from it, as name=value
    own: str  # the same, of the algorithm's own options


def sort_settings(result: Result) -> Settings:
    """The settings of a run, as differences from the nearest preset."""
    return _sort_settings(result.algorithm, result.heads, result.settings)


@functools.cache
def _sort_settings(slug: str, heads: int, text: str) -> Settings:
    """The nearest preset has the fewest differences in what all runs have."""
    algorithm = registry.of_slug(slug, heads)
    name = registry.name_of(algorithm)
    own = {field.name for field in dataclasses.fields(algorithm.Options)} - set(fields(Config))
    paper, found, changes = preset("paper", name), _by_name(text), {}
    for other in presets_of(name):
        theirs = _by_name(settings(preset(other, name)))
        ours = {k: _text(getattr(paper, k)) for k in theirs} | found
        changes[other] = {k: v for k, v in sorted(ours.items()) if v != theirs.get(k)}
    nearest = min(changes, key=lambda other: len(changes[other].keys() - own))
    common, of_algorithm = [], []
    for k, v in changes[nearest].items():
        (of_algorithm if k in own else common).append(f"{k}={v}")
    return Settings(nearest, shlex.join(common), shlex.join(of_algorithm))


def _by_name(text: str) -> dict[str, str]:
    """Settings by their names."""
    pairs = (item.partition("=") for item in shlex.split(text))
    return {name: value for name, _, value in pairs}


def read_curve(folder: RunFolder | str | os.PathLike, rows: int = 40) -> dict[str, np.ndarray]:
    """The columns CURVE of metrics.csv, thinned.

    Args:
      folder: of the run.
      rows: at most so many, equally far apart, the last one among them.

    Returns:
      Arrays of float64, nan where the run has no such number.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    table = _metrics(folder)
    every = math.ceil(len(table) / rows)
    kept = table[(len(table) - 1) % every :: every]
    return {name: np.array([row.get(name, math.nan) for row in kept]) for name in CURVE}


def protocol(result: Result) -> Protocol:
    """What the run must have in common with another."""
    found = sort_settings(result)
    common = {**result._asdict(), "preset": found.preset, "settings": found.common}
    common["recorded"] = bool(result.processor)
    return Protocol(*(common[name] for name in Protocol._fields))


def separate(results: Iterable[Result]) -> dict[Protocol, list[Result]]:
    """Results that may be compared, apart from those that may not."""
    groups: dict[Protocol, list[Result]] = {}
    for result in results:
        groups.setdefault(protocol(result), []).append(result)
    return groups


def identity(result: Result) -> tuple:
    """What tells a score from every other one: its run, and how that was scored."""
    return result.run, protocol(result)


def merge(results: Iterable[Result]) -> list[Result]:
    """Each run once, the first record of it.

    Raises:
      ValueError: if two records of one run have other scores.
    """
    kept: dict[tuple, Result] = {}
    for result in results:
        other = kept.setdefault(identity(result), result)
        if (other.return_mean, other.return_std) != (result.return_mean, result.return_std):
            raise ValueError(
                f"two runs of {result.env}, {result.algorithm}, M = {result.heads}, "
                f"seed {result.seed}, {result.steps:,} steps have other scores: "
                f"{other.return_mean:.6g} of {other.date} and {result.return_mean:.6g} of "
                f"{result.date}; leave one out"
            )
    return list(kept.values())


def _metrics(folder: RunFolder) -> list[dict[str, float]]:
    try:
        rows = read_metrics(folder.metrics)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder.metrics} is damaged: {error}") from None
    if not rows or not {"env_steps", "seconds"} <= set(rows[-1]):
        raise ValueError(f"{folder.metrics} is damaged: it has no rows")
    return rows


@contextlib.contextmanager
def _reading(path: pathlib.Path) -> Iterator[dict[str, Any]]:
    """The record in a JSON file; what is wrong or missing in it is said with its name."""
    try:
        yield json.loads(path.read_text())
    except KeyError as error:
        raise ValueError(f"{path} is damaged: it lacks {error}") from None
    except (AttributeError, IndexError, OSError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error}") from None


def finite(value: str | int | float) -> float:
    """The number; ValueError if it is none, or not finite."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number


def _summed_up(config: Config, metrics: Mapping[str, list[float]]) -> dict[str, float]:
    """The numbers that the environment has of its own, over the episodes of a score."""
    if not metrics:
        return {}
    return {own.name: own.over(metrics[own.metric]) for own in config.make_env().scored_metrics}


def _joined(texts: Iterable[str | None]) -> str:
    """What there is, in order, where it differs."""
    return "; ".join(dict.fromkeys(filter(None, texts)))


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _day(path: pathlib.Path) -> str:
    return datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC).date().isoformat()
