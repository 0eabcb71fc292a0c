"""Finished runs side by side: tables, pictures, and how sure we are (docs/report.md)."""

import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mapg_jax.reports import plots as plotting
from mapg_jax.reports.document import (
    Block,
    Bullets,
    Heading,
    Paragraph,
    Picture,
    markdown,
    page,
    picture_bytes,
)
from mapg_jax.reports.results import (
    Protocol,
    Result,
    UnfinishedError,
    find_runs,
    identity,
    merge,
    read_curve,
    read_run,
    separate,
)
from mapg_jax.reports.results_csv import read_csv
from mapg_jax.reports.tables import by_cell, table_csv, tables

LEGEND = (
    "n counts seeds. Mean ± 3σ is as the paper prints it, both averaged over the seeds: σ is over "
    "the episodes of one policy and says nothing of the next run. Brackets hold 95 % intervals "
    "over seeds (percentile bootstrap; one seed has none). P is the probability that a run scores "
    "higher than one of the plain algorithm (M = 1) with the same settings, or than one of DDPG if "
    "it is plain itself; it is called above or below ½ if its "
    "interval excludes ½, the exact rank-sum test has p < 0.05, and both arms have three seeds "
    "or more."
)


class Runs(NamedTuple):
    """What was found."""

    results: list[Result]
    curves: dict[tuple, dict[str, np.ndarray]]  # by identity; a CSV file has none
    unfinished: list[str]


def gather(paths: Sequence[str | os.PathLike]) -> Runs:
    """The runs at or below those paths, and those in CSV files of results.

    Raises:
      ValueError: if a path holds none, a file is damaged, or nothing is finished.
    """
    results, curves, unfinished = [], {}, {}
    for path in map(pathlib.Path, paths):
        if path.suffix == ".csv" and path.is_file():
            results += read_csv(path)
            continue
        for folder in find_runs(path):
            try:
                result = read_run(folder)
            except UnfinishedError as error:
                unfinished[folder.path.resolve()] = str(error)
            else:
                results.append(result)
                curves[identity(result)] = read_curve(folder)
    if not results:
        where = ", ".join(map(str, paths))
        raise ValueError(f"no run in {where} is finished ({len(unfinished)} are not)")
    return Runs(merge(results), curves, list(unfinished.values()))


def describe(protocol: Protocol) -> str:
    """A protocol in words."""
    machines = "" if protocol.recorded else "; machines not recorded"
    changes = f", but {protocol.settings}" if protocol.settings else ""
    return (
        f"{protocol.steps:,} environment steps; preset {protocol.preset}{changes}; scored over "
        f"{protocol.episodes} episodes on {protocol.physics}, select {protocol.select}; "
        f"{protocol.versions}{machines}"
    )


def compose(runs: Runs) -> list[Block]:
    """The whole report; protocols apart."""
    groups = separate(runs.results)
    blocks = [Heading("Report", 1), Paragraph(LEGEND)]
    if len(groups) > 1:
        blocks.append(
            Paragraph(
                f"These runs follow {len(groups)} protocols: other steps, settings, physics or "
                "versions, or machines that were not recorded. They are set apart; nothing is "
                "averaged or compared between them."
            )
        )
    for number, (protocol, results) in enumerate(groups.items(), 1):
        place = f" (protocol {number} of {len(groups)})" if len(groups) > 1 else ""
        blocks.append(Heading(f"{protocol.steps:,} steps{place}", 2))
        blocks.append(Paragraph(f"{describe(protocol)}."))
        blocks += tables(results)
        blocks += _pictures(results, runs, f"-{number}" if len(groups) > 1 else "")
    if runs.unfinished:
        blocks += [Heading("Not finished, and not counted", 2), Bullets(runs.unfinished)]
    return blocks


def write(blocks: Sequence[Block], runs: Runs, out: pathlib.Path) -> None:
    """report.md with its pictures, report.csv, and report.html, which is all in one file.

    Raises:
      ValueError: if the folder cannot be made.
    """
    files = {
        f"{block.name}.png": picture_bytes(block.figure, "png")
        for block in blocks
        if isinstance(block, Picture)
    }
    files["report.md"] = markdown(blocks).encode()
    files["report.html"] = page(blocks).encode()
    files["report.csv"] = table_csv(runs.results).encode()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{out} cannot be made: {error.strerror}") from None
    for name, data in files.items():
        partial = out / f"{name}.partial"
        partial.write_bytes(data)
        partial.replace(out / name)


def _pictures(results: Sequence[Result], runs: Runs, suffix: str) -> list[Block]:
    blocks: list[Block] = []
    curves: dict[str, dict[str, list]] = {}
    scores: dict[str, dict[int, list]] = {}
    for (env, arm), of_cell in by_cell(results).items():
        known = [runs.curves[identity(r)] for r in of_cell if identity(r) in runs.curves]
        if known:
            curves.setdefault(env, {})[arm.name] = known
        if arm.algorithm in ("ddpg", "mapg") and not arm.settings:
            scores.setdefault(env, {})[arm.heads] = [[r.return_mean] for r in of_cell]
    if curves:
        text = "Learning curves: mean over n seeds, bands 95 % intervals over seeds (bootstrap)."
        blocks.append(Picture(plotting.draw_curves(curves), f"curves{suffix}", text))
    heads = sorted({m for over_m in scores.values() for m in over_m})
    if len(heads) > 1:
        boxes = {env: {str(m): of.get(m, []) for m in heads} for env, of in scores.items()}
        text = "Score over M: a dot a seed; from five seeds on, a box with quartiles and median."
        blocks.append(Picture(plotting.draw_boxes(boxes), f"scores{suffix}", text))
    return blocks
