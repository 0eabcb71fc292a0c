"""python -m benchmarks.same_numbers OTHER: whether two checkouts train the same numbers.

Short runs are trained in both by the command line, on this machine. Every array of their last
checkpoints, every row of metrics.csv and every return of evaluation.json must be equal to the last
bit. Arrays are compared whatever their names are, since a rebuilt house gives them others.
"""

import argparse
import collections
import csv
import hashlib
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import orbax.checkpoint as ocp

SHORT = "--steps 4000 --evaluate-every 1000 --evaluation-episodes 2 --final-episodes 3"
STORED = f"{SHORT} --replay-size 20000"
RUNS = {
    "DDPG, Pendulum": f"train --env pendulum --heads 1 {STORED}",
    "M = 10, Pendulum": f"train --env pendulum --heads 10 {STORED}",
    "A3C, Pendulum": f"train --env pendulum --algorithm a3c {SHORT}",
    "DDPG, Hopper": f"train --env hopper --heads 1 {STORED}",
    "M = 10, HalfCheetah": f"train --env halfcheetah --heads 10 {STORED}",
    "A3C, Hopper": f"train --env hopper --algorithm a3c {SHORT}",
    "M = 10, Humanoid": f"train --env humanoid --heads 10 {STORED}",
    "M = 10, driving": f"train --env driving --heads 10 --time-limit 400 {STORED}",
    "other rules, a ladder of noise": "train --env pendulum --heads 3 --gradient resampled --target"
    f" sampled --noise gaussian --noise-scale 0.1 --noise-scale-last 0.4 {STORED}",
    "all heads, no layer norm, clipped": "train --env pendulum --heads 3 --gradient all"
    f" --no-layer-norm --max-gradient-norm 0.5 --truncation terminal {STORED}",
    "padded heads in lockstep": "sweep --env pendulum --heads 1 3 10 --seeds 2 --group all"
    f" --keep-replay {STORED}",
    "A3C in lockstep": f"sweep --env pendulum --algorithm a3c --seeds 2 --group all {SHORT}",
}
RESUMED = "M = 10, Pendulum, resumed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=pathlib.Path, help="the root of the other checkout")
    checkouts = pathlib.Path(__file__).parent.parent, parser.parse_args().other.absolute()
    equal = True
    with tempfile.TemporaryDirectory() as folder:
        for name in (*RUNS, RESUMED):
            ours, theirs = (
                numbers(root, name, pathlib.Path(folder) / str(i) / name)
                for i, root in enumerate(checkouts)
            )
            differing = [f"{kind} {n}" for kind, n in difference(ours, theirs).items() if n]
            equal &= not differing
            verdict = f"DIFFERENT: {', '.join(differing)}" if differing else "equal"
            counts = ", ".join(f"{sum(c.values())} {kind}" for kind, c in ours.items())
            print(f"{name}: {verdict} ({counts})", flush=True)
    sys.exit(0 if equal else 1)


def numbers(root: pathlib.Path, name: str, out: pathlib.Path) -> dict[str, collections.Counter]:
    """All that a run wrote, by kind: how often each array, row of metrics and return is there."""
    if name == RESUMED:
        half = "--steps 2000 --evaluate-every 1000 --evaluation-episodes 2 --final-episodes 3"
        command(root, f"train --env pendulum --heads 10 --replay-size 20000 {half}", "--out", out)
        command(root, "resume", out, "--steps", "4000")
    else:
        command(root, RUNS[name], "--out", out)
    found = {kind: collections.Counter() for kind in ("arrays", "rows", "returns")}
    for folder in sorted(path.parent for path in out.rglob("metrics.csv")):
        found["arrays"].update(arrays(folder))
        found["rows"].update(rows(folder / "metrics.csv"))
        found["returns"].update(json.loads((folder / "evaluation.json").read_text())["returns"])
    return found


def command(root: pathlib.Path, text: str, *more: object) -> None:
    """`mapg …` of that checkout."""
    subprocess.run(
        [sys.executable, "-m", "mapg_jax", *text.split(), *map(str, more)],
        cwd=root, env={**os.environ, "PYTHONPATH": str(root)}, check=True, capture_output=True,
    )  # fmt: skip


def arrays(folder: pathlib.Path) -> collections.Counter:
    """Shape, type and digest of every array of the newest checkpoint."""
    newest = max((folder / "checkpoints").iterdir(), key=lambda path: int(path.name))
    counted = collections.Counter()
    for part in ("agent", "rest"):
        if (newest / part).exists():
            stored = ocp.PyTreeCheckpointer().restore(newest.absolute() / part)
            for value in map(np.asarray, stored.values()):
                digest = hashlib.sha256(value.tobytes()).hexdigest()
                counted[value.shape, str(value.dtype), digest] += 1
    return counted


def rows(path: pathlib.Path) -> list[str]:
    """Rows of metrics.csv without what the clock says."""
    with path.open(newline="") as file:
        return [
            json.dumps(
                {k: v for k, v in row.items() if not k.endswith("second") and k != "seconds"}
            )
            for row in csv.DictReader(file)
        ]


def difference(ours, theirs) -> dict[str, int]:
    """By kind, how many of either are not in the other."""
    return {
        kind: sum((ours[kind] - theirs[kind]).values()) + sum((theirs[kind] - ours[kind]).values())
        for kind in ours
    }


if __name__ == "__main__":
    main()
