"""kill -9 at random moments; the end is that of the run that nobody killed, bit for bit."""

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import psutil

from benchmarks.torture import victim
from mapg_jax.runs.folder import RunFolder

KILLS = 3
"""Of a scenario."""
RUNS = {
    "train, MAPG": "train --preset smoke --heads 2 --steps 40000 --evaluate-every 10000",
    "train, A3C": "train --preset smoke --algorithm a3c --steps 40000 --evaluate-every 10000",
    "train, native": "train --preset smoke --env hopper --steps 4000 --evaluate-every 1000",
    "sweep, a program each": "sweep --preset smoke --heads 1 2 --steps 20000 --workers 2",
    "sweep, in lockstep": "sweep --preset smoke --heads 1 2 3 --steps 20000 --group all",
    "sweep, SAC in lockstep": "sweep --preset smoke --algorithm sac --heads 1 2 --steps 4000"
    " --group all",
}
SAVING = "--checkpoint-seconds 1e-9 --checkpoints-kept 3"


def command(name: str, out: pathlib.Path) -> list[str]:
    """As a user gives it."""
    keep = ["--keep-replay"] if RUNS[name].startswith("sweep") else []
    mapg = [sys.executable, "-P", "-m", "mapg_jax"]
    return [*mapg, *RUNS[name].split(), *SAVING.split(), *keep, "--out", str(out)]


def scenario(seed: int, root: pathlib.Path) -> tuple[str, str]:
    """Several kills; gives what was killed, and what came of it."""
    rng = np.random.default_rng(seed)
    name = list(RUNS)[seed % len(RUNS)]
    out = root / "killed"
    whole, seconds = undisturbed(name, root)
    shutil.rmtree(out, ignore_errors=True)
    resume = [sys.executable, "-P", "-m", "mapg_jax", "resume", str(out)]
    for _ in range(KILLS):
        begun = out.exists() and any(out.rglob("config.json"))
        killed(resume if begun else command(name, out), rng.uniform(1, seconds), rng)
        if out.exists() and not any(out.rglob("config.json")):
            shutil.rmtree(out)  # it had not begun
    last = resume if out.exists() else command(name, out)
    ended = subprocess.run(last, capture_output=True, text=True)
    if ended.returncode:
        return name, f"FAILED: {ended.stderr.strip().splitlines()[-1][:100]}"
    runs = sorted(path.parent.relative_to(whole) for path in whole.rglob("metrics.csv"))
    same = all(
        victim.ending(RunFolder.open(whole / run)) == victim.ending(RunFolder.open(out / run))
        for run in runs
    )
    return name, "equal to the last bit" if same else "DIFFERENT"


def undisturbed(name: str, root: pathlib.Path) -> tuple[pathlib.Path, float]:
    """The folder of what nobody killed, made once, and the seconds that it takes again."""
    whole, clock = root / f"whole {name}", root / f"seconds {name}"
    if not whole.exists():
        subprocess.run(command(name, whole), check=True, capture_output=True)
        clock.write_text(str(_seconds(command(name, root / "timed"))))
        shutil.rmtree(root / "timed")
    return whole, float(clock.read_text())


def _seconds(argv: list[str]) -> float:
    begun = time.monotonic()
    subprocess.run(argv, check=True, capture_output=True)
    return time.monotonic() - begun


def killed(argv: list[str], seconds: float, rng: np.random.Generator) -> None:
    """Started, and killed with all that it started, or its workers alone."""
    process = subprocess.Popen(
        argv, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        children = psutil.Process(process.pid).children(recursive=True)
        alone = bool(children) and rng.random() < 0.5
        for child in children:
            if child.is_running():
                child.send_signal(signal.SIGKILL)
        if alone:  # the sweep tries again by itself
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
        process.wait()
        for child in psutil.Process().children(recursive=True):
            child.wait(10)
