"""mapg pull: a policy of others."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.reports.sharing import pull


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser("pull", "What is taken is data: nothing in it is executed.")
    command.add_argument("name", help="USER/NAME on the Hugging Face Hub, or a path: ./folder.")
    command.add_argument(
        "--out", type=pathlib.Path, help="A new folder; by default the last part of the name."
    )
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Pulls."""
    folder = arguments.out or pathlib.Path(pathlib.Path(arguments.name).name)
    print(refuse_politely(lambda: pull(arguments.name, folder)), file=out)
