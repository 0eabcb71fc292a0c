"""A disk that fills up while a run trains: it ends in a line, and goes on once there is room."""

import contextlib
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.torture import kills, victim
from mapg_jax.runs.folder import RunFolder

MEGABYTES = 8
NAME = "train, MAPG"


def scenario(seed: int, root: pathlib.Path) -> tuple[str, str]:
    """Another process takes all room but some; gives what came of it."""
    rng = np.random.default_rng(seed)
    whole, seconds = kills.undisturbed(NAME, root)
    with small_disk(root / "disk") as place:
        process = subprocess.Popen(
            kills.command(NAME, place / "run"),
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        time.sleep(rng.uniform(0.2, 1.0) * seconds)
        room = int(rng.integers(0, 300_000))
        _fill(place / "others", room)
        said = process.communicate(timeout=victim.SECONDS + 4 * seconds)[1].strip().splitlines()
        (place / "others").unlink()
        kind = "filled up"
        if process.returncode not in (0, 1, 2):
            return kind, f"STATUS {process.returncode}"
        if process.returncode and (not said or not said[-1].startswith("mapg")):
            return kind, f"TRACEBACK: {said[-1:]}"
        if process.returncode and "Traceback" in "".join(said):
            return kind, "TRACEBACK"
        if not (place / "run" / "config.json").exists():
            return kind, "not begun, in a line"
        ended = subprocess.run(
            [sys.executable, "-P", "-m", "mapg_jax", "resume", str(place / "run")],
            capture_output=True, text=True,
        )  # fmt: skip
        if ended.returncode:
            return kind, f"FAILED: {ended.stderr.strip().splitlines()[-1][:100]}"
        stopped = "stopped in a line" if process.returncode else "not full yet"
        found, expected = (victim.ending(RunFolder.open(run)) for run in (place / "run", whole))
        return kind, f"{stopped}; then equal to the last bit" if found == expected else "DIFFERENT"


def _fill(file: pathlib.Path, room: int) -> None:
    """Takes all of the disk but `room` bytes."""
    free = os.statvfs(file.parent)
    with contextlib.suppress(OSError), file.open("wb") as stream:
        stream.write(bytes(max(0, free.f_bavail * free.f_frsize - room)))


@contextlib.contextmanager
def small_disk(place: pathlib.Path) -> Iterator[pathlib.Path]:
    """A disk in memory; to mount it takes the rights of root."""
    place.mkdir(exist_ok=True)
    size = f"size={MEGABYTES}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", place], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)
