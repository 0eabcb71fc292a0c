"""What a page that follows runs shows of them, as plain data: read anew each time it is asked."""

import json
import math
import os
import pathlib
from collections.abc import Sequence
from typing import Any

from mapg_jax.reports.results import find_runs
from mapg_jax.runs.folder import RunFolder, values_of
from mapg_jax.runs.metrics import read_metrics

ROWS = 1_000
"""Of a run, at most: a curve on a screen has no more points."""
VIDEOS = ("*.mp4", "*.gif")


def snapshot(paths: Sequence[str | os.PathLike]) -> dict[str, Any]:
    """`runs`: of each run at or below those paths what `told` says; `problems`: lines of text.

    Raises:
      ValueError: if a path holds no run.
    """
    runs, problems = [], []
    for folder in _folders(paths):
        try:
            runs.append(told(folder))
        except (OSError, ValueError) as error:
            problems.append(str(error))
    return {"runs": runs, "problems": problems}


def told(folder: RunFolder) -> dict[str, Any]:
    """`name`, `config` (texts by name), `columns` of metrics.csv (lists by name, null where there
    is no number), `score`, `history` (a line a process), `video` (its file and its time).

    Raises:
      ValueError: if a file is damaged.
    """
    rows = read_metrics(folder.metrics)
    kept = rows[:: max(1, math.ceil(len(rows) / ROWS))]
    if rows and kept[-1] is not rows[-1]:
        kept.append(rows[-1])
    names = list(kept[0]) if kept else []
    video = newest_video(folder)
    return {
        "name": str(folder.path),
        "config": {k: json.dumps(v) for k, v in values_of(folder.config).items()},
        "columns": {name: [_number(row[name]) for row in kept] for name in names},
        "score": _score(folder),
        "history": _history(folder),
        "video": video and {"name": video.name, "time": video.stat().st_mtime},
    }


def newest_video(folder: RunFolder) -> pathlib.Path | None:
    """Of `mapg watch`, in the run folder."""
    found = [file for kind in VIDEOS for file in folder.path.glob(kind)]
    return max(found, key=lambda file: file.stat().st_mtime, default=None)


def _folders(paths: Sequence[str | os.PathLike]) -> list[RunFolder]:
    found = {folder.path.resolve(): folder for path in paths for folder in find_runs(path)}
    return list(found.values())


def folder_of(paths: Sequence[str | os.PathLike], number: int) -> RunFolder | None:
    """The run of that number among those of the paths."""
    folders = _folders(paths)
    return folders[number] if 0 <= number < len(folders) else None


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _score(folder: RunFolder) -> dict[str, Any] | None:
    """Of evaluation.json, where there is one to be read."""
    try:
        record = json.loads(folder.evaluation.read_text())
        returns = [float(value) for value in record["returns"]]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    mean = sum(returns) / len(returns) if returns else math.nan
    return {"mean": _number(mean), "episodes": len(returns)}


def _history(folder: RunFolder) -> list[str]:
    record = json.loads((folder.path / "config.json").read_text())
    return [f"{entry.get('date')}  {entry.get('command')}" for entry in record["history"]]
