"""What a launcher carries out, and the same by workers of this machine."""

import dataclasses
import pathlib

import oracles

from mapg_jax.runs.folder import RunFolder
from mapg_jax.sweeps import search, sweep
from mapg_jax.sweeps.launchers import Local

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)
LONG = dataclasses.replace(RUN, steps=40_000, evaluate_every=4_000, checkpoint_seconds=1e-3)


def carry_out(launched_by, root: pathlib.Path, run, seeds=(0, 1)) -> list[RunFolder]:
    """A sweep over seeds, a group each."""
    runs = [(dataclasses.replace(run, seed=seed), root / f"s{seed}") for seed in seeds]
    schedule = sweep.make_schedule(runs, group="one", keep_replay=True, launcher=launched_by)
    failures = sweep.carry_out(schedule, progress=False)
    assert not failures, failures
    return [RunFolder(path, config) for config, path in runs]


def assert_as_here(found: list[RunFolder], root: pathlib.Path) -> None:
    """Runs of seeds 0, 1, …, to the last bit as workers of this machine make them."""
    here = carry_out(Local(), root, found[0].config, range(len(found)))
    for ours, theirs in zip(found, here, strict=True):
        oracles.assert_same_run(ours, theirs)


def searched(path: pathlib.Path, name: str, *options: str) -> list[str]:
    """What a search says, in which each trial's values depend on the scores of those before."""
    folder = search.SearchFolder(
        path,
        "smoke",
        {"steps": 400},
        space={"discount": search.Dimension(low=0.5, high=0.99)},
        trials=3,
        workers=1,
        launcher=name,
        launcher_options=options,
    )
    folder.create()
    lines = []
    assert search.carry_out(search.make_plan(folder), lines.append)
    return lines
