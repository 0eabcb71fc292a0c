"""The time that a sweep will take."""

import dataclasses
import pathlib

import oracles

from mapg_jax.sweeps import forecast
from mapg_jax.sweeps.groups import Job, groups
from mapg_jax.training.config import Config


def jobs(**changes) -> list[Job]:
    cells = [dataclasses.replace(oracles.RUN, heads=m, **changes) for m in (1, 4, 10)]
    return [Job(cell, pathlib.Path(f"nowhere/{cell.heads}")) for cell in cells]


def test_each_program_is_timed_once_with_the_most_heads(monkeypatch):
    """Two programs, of 3 groups and of 1, on two workers."""
    timed = []

    def seconds(group):
        timed.append(group[0].config.heads)
        return 100.0 if group[0].config.batch_size == 4 else 10.0

    monkeypatch.setattr(forecast, "_seconds", seconds)
    cut = [*groups(jobs(), "one"), *groups(jobs(batch_size=4)[:1], "one")]
    assert forecast.predict(cut, 2) == (3 * 10 + 100) / 2
    assert timed == [10, 1]


def test_what_learns_from_rollouts_is_timed_too(monkeypatch):
    monkeypatch.setattr(forecast, "MEASURED_SECONDS", 1e-9)
    config = Config(
        algorithm="a3c", environments=4, hidden=(8, 8), steps=800, time_limit=50,
        evaluation_episodes=2, final_episodes=2,
    )  # fmt: skip
    cut = groups([Job(config, pathlib.Path("nowhere"))], "one")
    assert forecast.predict(cut, 1) > forecast.START_SECONDS
