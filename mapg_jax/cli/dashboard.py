"""mapg dashboard: a page that follows runs while they go on."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.reports import dashboard


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "dashboard",
        "Curves side by side, scores, configurations, commands and the newest videos; served to "
        "this machine alone until Ctrl-C, or written once into a file that needs no other.",
    )
    command.add_argument("paths", nargs="+", type=pathlib.Path, help="Run folders, or above them.")
    command.add_argument("--out", type=pathlib.Path, help="The page as a file; nothing is served.")
    command.add_argument("--port", type=int, default=8700, help="0 takes a free one.")
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Writes the page, or serves it."""
    if arguments.out:
        refuse_politely(lambda: dashboard.write(arguments.paths, arguments.out))
        print(arguments.out, file=out)
        return
    server = refuse_politely(lambda: dashboard.server(arguments.paths, arguments.port))
    print(f"http://{dashboard.ADDRESS}:{server.server_port}", file=out, flush=True)
    with server:
        server.serve_forever()
