"""mapg envs: the environments."""

import argparse
from typing import TextIO

import rich.table

import envs
from mapg_jax.cli.console import complain, console
from mapg_jax.cli.main import parser


def parse(flags: list[str]) -> argparse.Namespace:
    """The arguments."""
    command = parser("envs")
    return command.parse(flags)


def run(arguments: argparse.Namespace, out: TextIO) -> None:
    """Lists them."""
    headers = ("name", "observation", "action", "time limit", "engines", "equals")
    table = rich.table.Table(*(rich.table.Column(h, overflow="fold") for h in headers))
    for name in envs.names():
        try:
            spec, env = envs.spec(name), envs.make(name)
        except ValueError as error:  # of somebody else's package
            complain(str(error), 1)
            continue
        table.add_row(
            name,
            str(env.observation_size),
            str(env.action_size),
            str(spec.time_limit),
            ", ".join(spec.engines),
            spec.gymnasium_id or "",
        )
    console(out).print(table)
    print("brax:NAME takes any environment of Brax.", file=out)
    print("playground:NAME takes any of MuJoCo Playground, on MJX.", file=out)
    print("gym:NAME takes any of Gymnasium with flat boxes, stepped on the host.", file=out)
