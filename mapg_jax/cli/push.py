"""mapg push: a trained policy for others."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.reports.sharing import push


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "push",
        "What is given: the policy, its score, its curve, the newest video, and a model card.",
    )
    command.add_argument("path", type=pathlib.Path, help="Run folder, scored.")
    command.add_argument(
        "name", help="USER/NAME on the Hugging Face Hub, or a path: ./folder, /shared/folder."
    )
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Pushes."""
    print(refuse_politely(lambda: push(arguments.path, arguments.name)), file=out)
