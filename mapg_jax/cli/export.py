"""mapg export: a policy that runs without this package."""

import argparse
import pathlib
import typing
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.runs.export import Format, export


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "export",
        "The program takes observations [N, D] to all proposals [N, M, A] and their values [N, M]. "
        "A card in JSON beside it says what they mean.",
    )
    command.add_argument("path", type=pathlib.Path, help="Run folder.")
    command.add_argument(
        "--format", choices=typing.get_args(Format), default="stablehlo", help="Of the file."
    )
    command.add_argument(
        "--out", type=pathlib.Path, help="The file; by default policy.FORMAT in this folder."
    )
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Exports."""
    file = arguments.out or pathlib.Path(f"policy.{arguments.format}")
    for written in refuse_politely(lambda: export(arguments.path, arguments.format, file)):
        print(written, file=out)
