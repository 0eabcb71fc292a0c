"""Several processes at once in one run folder: one trains, the others leave in a line."""

import pathlib
import shutil
import subprocess
import sys
import time

import numpy as np

from benchmarks.torture import kills, victim
from mapg_jax.runs.folder import RunFolder

NAME = "train, MAPG"


def scenario(seed: int, root: pathlib.Path) -> tuple[str, str]:
    """Two or three of them, a little apart, in a new folder or in one of a killed run."""
    rng = np.random.default_rng(seed)
    whole, seconds = kills.undisturbed(NAME, root)
    out = root / "rivals"
    shutil.rmtree(out, ignore_errors=True)
    begins = bool(rng.random() < 0.5)
    resume = [sys.executable, "-P", "-m", "mapg_jax", "resume", str(out)]
    if not begins:
        kills.killed(kills.command(NAME, out), rng.uniform(0.6, 1.0) * seconds, rng)
    argv = kills.command(NAME, out) if not (out / "config.json").exists() else resume
    rivals = []
    for _ in range(rng.integers(2, 4)):
        rivals.append(subprocess.Popen(argv, stderr=subprocess.PIPE, stdout=-3, text=True))
        time.sleep(rng.uniform(0, 0.3))
    kind, statuses = "new folder" if begins else "killed run", []
    for rival in rivals:
        said = rival.communicate(timeout=len(rivals) * (victim.SECONDS + 4 * seconds))[1]
        if "Traceback" in said:
            return kind, "TRACEBACK"
        statuses.append(rival.returncode)
    if set(statuses) - {0, 2} or not statuses.count(0):
        return kind, f"STATUSES {statuses}"
    same = victim.ending(RunFolder.open(out)) == victim.ending(RunFolder.open(whole))
    return kind, "one wrote, equal to the last bit" if same else "DIFFERENT"
