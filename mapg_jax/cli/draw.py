"""mapg draw: episodes, drawn by their environment."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.runs.episode import draw
from mapg_jax.runs.folder import RunFolder


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser("draw", "The pictures are written into the run folder.")
    command.add_argument("path", type=pathlib.Path, help="Run folder.")
    command.add_argument(
        "--select", default="uniform", help="How one action is made of the M proposals."
    )
    command.add_argument("--seed", type=int, default=0, help="Of the starts and the heads.")
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Draws."""
    pictures = refuse_politely(
        lambda: draw(RunFolder.open(arguments.path), arguments.seed, arguments.select)
    )
    for picture in pictures:
        print(picture, file=out)
