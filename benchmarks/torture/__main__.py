"""make torture: breaks runs on purpose, prints what came of it, and goes on from the last time."""

import argparse
import logging
import pathlib
import sys
import tempfile

from benchmarks.torture import damages, hostile, kills
from benchmarks.torture.tally import Tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=6, help="scenarios, of three kills each")
    parser.add_argument("--damages", type=int, default=100, help="scenarios")
    parser.add_argument("--hostile", type=int, default=200, help="command lines")
    arguments = parser.parse_args()
    logging.disable()  # what is set aside is said, and counted here
    tally, wrong = Tally(), 0

    def count(group: str, kind: str, outcome: str) -> int:
        tally.add(f"{group}: {kind}", outcome)
        print(f"{group}: {kind}: {outcome}", flush=True)
        return outcome.split(":")[0].isupper()

    with tempfile.TemporaryDirectory() as folder:
        root = pathlib.Path(folder)
        if arguments.damages:
            damages.prepare(root)
        first = tally.seeds("damage")
        for seed in range(first, first + arguments.damages):
            wrong += count("damage", *damages.scenario(seed))
        first = tally.seeds("command line")
        for seed in range(first, first + arguments.hostile):
            wrong += count("command line", *hostile.scenario(seed, root))
        first = tally.seeds("kill -9")
        for seed in range(first, first + arguments.kills):
            wrong += count("kill -9", *kills.scenario(seed, root))
    tally.write_page()
    print(f"\n{tally.table()}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
