"""make torture: breaks runs on purpose, prints what came of it, and goes on from the last time."""

import argparse
import logging
import pathlib
import sys
import tempfile

from benchmarks.torture import damages, disks, hostile, kills, rivals
from benchmarks.torture.tally import Tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=6, help="scenarios, of three kills each")
    parser.add_argument("--damages", type=int, default=100, help="scenarios")
    parser.add_argument("--hostile", type=int, default=200, help="command lines")
    parser.add_argument("--disks", type=int, default=3, help="scenarios; they need root")
    parser.add_argument("--rivals", type=int, default=3, help="scenarios")
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
        for group, scenario, number in (
            ("command line", hostile.scenario, arguments.hostile),
            ("full disk", disks.scenario, arguments.disks),
            ("several processes", rivals.scenario, arguments.rivals),
            ("kill -9", kills.scenario, arguments.kills),
        ):
            first = tally.seeds(group)
            for seed in range(first, first + number):
                wrong += count(group, *scenario(seed, root))
    tally.write_page()
    print(f"\n{tally.table()}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
