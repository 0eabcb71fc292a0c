"""mapg report: finished runs side by side."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.reports import document
from mapg_jax.reports.report import compose, gather, write


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "report", "Example: mapg report runs/hopper-ddpg-1 runs/hopper-mapg-m10-1 --out report"
    )
    command.add_argument(
        "paths",
        nargs="*",
        type=pathlib.Path,
        help="Run folders, folders of them at any depth, and CSV files of results.",
    )
    command.add_argument(
        "--out",
        type=pathlib.Path,
        help="Folder for report.md, its pictures, report.csv, and report.html, which needs no "
        "other file.",
    )
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Reports."""
    print(refuse_politely(lambda: _write(arguments)), file=out, end="")


def _write(arguments: argparse.Namespace) -> str:
    if not arguments.paths:
        raise ValueError("name a run folder, a folder of them or a CSV file of results")
    runs = gather(arguments.paths)
    blocks = compose(runs)
    if arguments.out:
        write(blocks, runs, arguments.out)
    return document.markdown(blocks, pictures=False)
