"""A track by its name or its file."""

import re
from pathlib import Path

from envs.driving.circuits import NAMES, circuit, random_circuit
from envs.driving.torcs_xml import read_torcs_xml
from envs.driving.tracks import Track
from envs.driving.tumftm_csv import read_csv

LARGEST_FILE = 5_000_000  # bytes; the longest of TORCS has less than a hundredth of it


def load_track(track: str | Path | Track) -> Track:
    """The track of this name or file; a `Track` is returned as it is.

    Names are those of the circuits, and `random:SEED`.

    Raises:
      ValueError: if there is no such track, or a file is malformed (with the line).
    """
    if isinstance(track, Track):
        return track
    name = str(track)
    if name in NAMES:
        return circuit(name)
    if found := re.fullmatch(r"random:(\d+)", name):
        return random_circuit(int(found[1]))
    readers = {".xml": read_torcs_xml, ".csv": read_csv}
    path = Path(name)
    if path.suffix.lower() not in readers:
        raise ValueError(
            f"unknown track {name!r}; known are {', '.join(NAMES)}, random:SEED "
            f"and files .xml and .csv"
        )
    if not path.is_file():
        raise ValueError(f"there is no track file {name}")
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"{name} has more than {LARGEST_FILE:,} bytes: it is no track file")
    return readers[path.suffix.lower()](path)
