"""What checkpoints need of the disk, refused before a run begins."""

import os
import pathlib
import shutil

from mapg_jax.training.config import ReplayConfig
from mapg_jax.training.state import tree_bytes
from mapg_jax.training.trainer import Trainer


def checkpoint_bytes(trainer: Trainer) -> int:
    """Of one checkpoint, at most: the replay full, nothing compressed."""
    shapes = trainer.shapes
    if isinstance(trainer.config, ReplayConfig) and not trainer.config.save_replay:
        shapes = shapes.replace(replay=None)
    return tree_bytes(shapes)


def run_bytes(trainer: Trainer) -> int:
    """Of a run: all checkpoints that are kept, and one that is being written."""
    return (trainer.config.checkpoints_kept + 1) * checkpoint_bytes(trainer)


def refuse_a_full_disk(needed: int, path: pathlib.Path, taken: int, remedy: str) -> None:
    """Raises ValueError if checkpoints might not fit.

    Args:
      needed: bytes, at most.
      path: of a folder, which need not exist.
      taken: bytes of checkpoints there are already: newer ones replace them.
      remedy: what would need less.
    """
    free = free_bytes(path) + taken
    if needed > free:
        raise ValueError(
            f"the checkpoints can take {_size(needed)}, but the disk of {path} has "
            f"{_size(free)} left; choose {remedy}"
        )


def taken_bytes(path: pathlib.Path) -> int:
    """What the checkpoints in a run folder take."""
    files = (path / "checkpoints").rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())


def free_bytes(path: pathlib.Path) -> int:
    """Free space of the disk that a path, which need not exist, is or would be on."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(os.fspath(path)).free


def _size(number: int) -> str:
    return f"{number / 1e9:.1f} GB" if number >= 1e8 else f"{number / 1e6:.1f} MB"
