"""mapg watch: a video of a run's newest policy."""

import argparse
import pathlib
from typing import TextIO

from mapg_jax.cli.console import refuse_politely
from mapg_jax.cli.main import parser
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.live import show
from mapg_jax.runs.video import film


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser(
        "watch",
        "Beside the picture stand the M proposals of each state, coloured by head, the action "
        "taken as a ring, and the critic's value of each proposal, or of the state if it values no "
        "actions. --out keeps the run folder as it is, one that is shared or in version control.",
    )
    command.add_argument("path", type=pathlib.Path, help="Run folder.")
    command.add_argument(
        "--out",
        type=pathlib.Path,
        help="The video, .mp4 or .gif; by default video.mp4 in the run folder, or video.gif where "
        "mp4 cannot be written.",
    )
    command.add_argument("--steps", type=int, default=300, help="Of an episode, at most.")
    command.add_argument("--episodes", type=int, default=1, help="One after the other.")
    command.add_argument(
        "--select", default="uniform", help="How one action is made of the M proposals."
    )
    command.add_argument("--seed", type=int, default=0, help="Of the starts and the heads.")
    command.add_argument(
        "--live", action="store_true", help="MuJoCo's viewer instead of a video; needs a display."
    )
    arguments = command.parse(flags)
    if arguments.live and arguments.out:
        command.error("--live shows a window and writes no --out; leave one of them out")
    return arguments


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Films, or shows."""
    chosen = {name: getattr(arguments, name) for name in ("steps", "episodes", "seed", "select")}
    if arguments.live:
        refuse_politely(lambda: show(RunFolder.open(arguments.path), **chosen))
        return
    written = refuse_politely(lambda: film(RunFolder.open(arguments.path), arguments.out, **chosen))
    print(written, file=out)
