"""Scores of finished runs by task and arm, as tables. docs/report.md defines their numbers."""

import csv
import dataclasses
import io
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

import envs
from mapg_jax.algorithms import registry
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.inference import Comparison, Estimate
from mapg_jax.reports.results import Protocol, Result, separate, sort_settings

DDPG = "ddpg"
"""The slug of the paper's baseline."""


class Arm(NamedTuple):
    """What is compared on a task."""

    algorithm: str
    heads: int
    settings: str  # of the algorithm's own options

    @property
    def name(self) -> str:
        first = registry.of_slug(self.algorithm, self.heads).label(self.heads)
        return f"{first}, {self.settings}" if self.settings else first

    @property
    def baseline(self) -> "Arm":
        """The plain algorithm with the same settings, but those that say nothing of one head.

        What is plain itself is compared with DDPG.
        """
        algorithm = registry.of_slug(self.algorithm, self.heads)
        plain = algorithm.slug(1)
        if self.heads == 1 and plain != DDPG:
            return Arm(DDPG, 1, "")
        options = {f.name: f.metadata for f in dataclasses.fields(algorithm.Options)}
        rules = {name for name, of_field in options.items() if of_field.get("of_heads")}
        shared = [s for s in shlex.split(self.settings) if s.partition("=")[0] not in rules]
        return Arm(plain, 1, shlex.join(shared))

    @property
    def rank(self) -> tuple:
        """Plain algorithms first, as they are registered; then by M."""
        algorithm = registry.of_slug(self.algorithm, self.heads)
        place = [registry.find(name) for name in registry.names()].index(algorithm)
        return self.heads > 1, place, self.heads, self.settings


class Cell(NamedTuple):
    """One arm on one task, over its seeds."""

    env: str
    arm: Arm
    seeds: int
    mean: Estimate
    std: float  # over the episodes of a run, averaged over seeds
    interquartile_mean: Estimate
    median: Estimate
    comparison: Comparison | None  # with the arm's baseline


def arm_of(result: Result) -> Arm:
    """The arm that a run belongs to."""
    return Arm(result.algorithm, result.heads, sort_settings(result).own)


def by_cell(results: Iterable[Result]) -> dict[tuple[str, Arm], list[Result]]:
    """Results of one protocol, by task and arm; tasks by name, arms with DDPG first, then by M."""
    groups: dict[tuple[str, Arm], list[Result]] = {}
    for result in sorted(results, key=lambda r: (r.env, arm_of(r).rank, r.seed)):
        groups.setdefault((result.env, arm_of(result)), []).append(result)
    return groups


def cells(results: Iterable[Result]) -> list[Cell]:
    """The statistics of every task and arm that the results have."""
    groups = by_cell(results)
    scores = {key: [r.return_mean for r in of_cell] for key, of_cell in groups.items()}

    def comparison(env: str, arm: Arm) -> Comparison | None:
        old = scores.get((env, arm.baseline))
        if old is None or arm == arm.baseline:
            return None
        return statistics.compare(scores[env, arm], old)

    return [
        Cell(
            env,
            arm,
            len(of_cell),
            statistics.mean(scores[env, arm]),
            float(np.mean([r.return_std for r in of_cell])),
            statistics.interquartile_mean(scores[env, arm]),
            statistics.median(scores[env, arm]),
            comparison(env, arm),
        )
        for (env, arm), of_cell in groups.items()
    ]


def tables(results: Sequence[Result]) -> list[Table]:
    """Scores by task and arm, missing ones too; the mean over tasks; the environments' own."""
    found = {(cell.env, cell.arm): cell for cell in cells(results)}
    tasks = sorted({env for env, _ in found})
    arms = sorted({arm for _, arm in found}, key=lambda arm: arm.rank)
    rows = [[env, arm.name, *_texts(found.get((env, arm)), arm)] for env in tasks for arm in arms]
    header = ("task", "arm", "n", "mean ± 3σ", "mean", "IQM", "median", "P over plain", "P is")
    further = (over_tasks(results), *own_numbers(results))
    return [Table(header, rows), *(table for table in further if table.rows)]


def over_tasks(results: Iterable[Result]) -> Table:
    """The mean over tasks of the probability of improvement, where there are several tasks."""
    groups = by_cell(results)
    pairs: dict[Arm, dict[str, tuple]] = {}
    for (env, arm), of_cell in groups.items():
        old = groups.get((env, arm.baseline))
        if old and arm != arm.baseline:
            scores = tuple([r.return_mean for r in side] for side in (of_cell, old))
            pairs.setdefault(arm, {})[env] = scores
    rows = []
    for arm, of_arm in sorted(pairs.items(), key=lambda item: item[0].rank):
        if len(of_arm) > 1:
            estimate = statistics.mean_probability_of_improvement(list(of_arm.values()))
            rows.append([arm.name, ", ".join(of_arm), _share(estimate)])
    return Table(("arm", "tasks", "mean P over plain"), rows)


def table_csv(results: Iterable[Result]) -> str:
    """All cells of all protocols, one a row; an interval that there is none of is empty."""
    file = io.StringIO()
    estimates = ("mean", "interquartile_mean", "median", "improvement")
    columns = [name + end for name in estimates for end in ("", "_low", "_high")]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["env", "arm", *Protocol._fields, "seeds", "std", *columns, "p", "verdict"])
    missing = Estimate(math.nan, math.nan, math.nan)
    for protocol, of_protocol in separate(results).items():
        for cell in cells(of_protocol):
            c = cell.comparison
            numbers = [*cell.mean, *cell.interquartile_mean, *cell.median]
            numbers += [*(c.improvement if c else missing), c.p if c else math.nan]
            texts = ["" if math.isnan(x) else f"{x:.6g}" for x in (cell.std, *numbers)]
            row = [cell.env, cell.arm.name, *protocol, cell.seeds, *texts]
            writer.writerow([*row, c.verdict if c else ""])
    return file.getvalue()


def own_numbers(results: Iterable[Result]) -> list[Table]:
    """For each task whose environment counts more than the return, what it counts."""
    found: dict[str, list[list[str]]] = {}
    titles: dict[str, dict[str, str]] = {}
    for (env, arm), of_cell in by_cell(results).items():
        counted = [result.metrics for result in of_cell if result.metrics]
        if counted:
            titles.setdefault(env, _titles(env, counted[0]))
            estimates = [statistics.mean([m[name] for m in counted]) for name in titles[env]]
            row = [env, arm.name, str(len(counted)), *map(_plain, estimates)]
            found.setdefault(env, []).append(row)
    return [Table(("task", "arm", "n", *titles[env].values()), rows) for env, rows in found.items()]


def _titles(env: str, metrics: Mapping[str, float]) -> dict[str, str]:
    """The titles of an environment's numbers, as it gives them."""
    constructor = envs.spec(env).load()
    titles = {own.name: own.title for own in getattr(constructor, "scored_metrics", ())}
    return {name: titles.get(name, name) for name in metrics}


def _texts(cell: Cell | None, arm: Arm) -> list[str]:
    if cell is None:
        return ["0", *["missing"] * 6]
    comparison = cell.comparison
    if arm == arm.baseline:
        improvement = ["", ""]
    elif comparison is None:
        improvement = [f"{arm.baseline.name} missing", ""]
    else:
        p = f"p = {comparison.p:.2g}"
        half = "undecided" if comparison.verdict == "undecided" else f"{comparison.verdict} ½"
        improvement = [_share(comparison.improvement), f"{half}, {p}"]
    mean = _digits(cell.mean.value)
    return [
        str(cell.seeds),
        f"{mean} ± {_digits(3 * cell.std)}",
        *(_number(e) for e in (cell.mean, cell.interquartile_mean, cell.median)),
        *improvement,
    ]


def _number(estimate: Estimate) -> str:
    return _with_interval(estimate, _digits)


def _share(estimate: Estimate) -> str:
    return _with_interval(estimate, lambda x: f"{x:.2f}")


def _plain(estimate: Estimate) -> str:
    return _with_interval(estimate, lambda x: f"{x:,.0f}" if abs(x) >= 100 else f"{x:.2f}")


def _with_interval(estimate: Estimate, text: Callable[[float], str]) -> str:
    if math.isnan(estimate.low):
        return text(estimate.value)
    return f"{text(estimate.value)} ({text(estimate.low)} to {text(estimate.high)})"


def _digits(x: float) -> str:
    return f"{x:,.0f}" if abs(x) >= 100 else f"{x:.1f}"
