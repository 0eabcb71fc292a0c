"""Damages to the files of a run folder: what is loaded afterwards is what was saved, or nothing."""

import json
import os
import pathlib
import shutil
from collections.abc import Callable

import numpy as np

from benchmarks.torture import victim
from mapg_jax.reports.results import read_run
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import load_policy
from mapg_jax.runs.train import take_up
from mapg_jax.training.trainer import make_trainer

Damage = Callable[[pathlib.Path, np.random.Generator], None]


def flip(file: pathlib.Path, rng: np.random.Generator) -> None:
    """One bit."""
    content = bytearray(file.read_bytes())
    if content:
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    file.write_bytes(content)


def truncate(file: pathlib.Path, rng: np.random.Generator) -> None:
    """Its end is lost."""
    content = file.read_bytes()
    file.write_bytes(content[: rng.integers(len(content) + 1)])


def scramble(file: pathlib.Path, rng: np.random.Generator) -> None:
    """Other bytes, and perhaps more of them."""
    file.write_bytes(rng.bytes(int(rng.integers(1, 5_000))))


def delete(file: pathlib.Path, rng: np.random.Generator) -> None:
    """It is gone."""
    file.unlink()


def swap(file: pathlib.Path, rng: np.random.Generator) -> None:
    """The file of another run has its place."""
    others = [f for f in files(OTHER) if f.name == file.name] or files(OTHER)
    shutil.copy(others[rng.integers(len(others))], file)


def link(file: pathlib.Path, rng: np.random.Generator) -> None:
    """A link out of the folder, to a file that must stay as it is."""
    file.unlink()
    file.symlink_to(OUTSIDE)


def pipe(file: pathlib.Path, rng: np.random.Generator) -> None:
    """A pipe, from which nothing ever comes."""
    file.unlink()
    os.mkfifo(file)


def folder(file: pathlib.Path, rng: np.random.Generator) -> None:
    """A folder in its place."""
    file.unlink()
    file.mkdir()


def rename(file: pathlib.Path, rng: np.random.Generator) -> None:
    """A checkpoint that gives itself out for that of another step."""
    steps = sorted((RUN / "checkpoints").iterdir())
    chosen = steps[rng.integers(len(steps))]
    chosen.rename(chosen.with_name(str(int(chosen.name) + int(rng.integers(1, 2_000)))))


def mix(file: pathlib.Path, rng: np.random.Generator) -> None:
    """A part of another checkpoint, or of another run."""
    steps = sorted((RUN / "checkpoints").iterdir())
    donors = [*steps, *(OTHER / "checkpoints").iterdir()]
    into, donor = steps[rng.integers(len(steps))], donors[rng.integers(len(donors))]
    part = ("agent", "rest", "host")[rng.integers(3)]
    if into != donor:
        shutil.rmtree(into / part)
        shutil.copytree(donor / part, into / part)


VALUES = [None, -1, 0, 1, 20_000, 10**7, 10**12, 10**30, 1e308, float("nan"), "x", [], {}, [[[]]],
          True, "pendulum", "hopper", "[" * 5_000, ["x=" + "(" * 500], ["a=1"]]  # fmt: skip


def configure(file: pathlib.Path, rng: np.random.Generator) -> None:
    """Another value in config.json."""
    path = RUN / "config.json"
    record = json.loads(path.read_text())
    place = record["config"] if rng.random() < 0.8 else record
    names = sorted(place)
    place[names[rng.integers(len(names))]] = VALUES[rng.integers(len(VALUES))]
    path.write_text(json.dumps(record))


DAMAGES: tuple[Damage, ...] = (
    flip, flip, flip, truncate, scramble, delete, swap, link, pipe, folder, rename, mix, configure,
    configure,
)  # fmt: skip
ROOT = pathlib.Path()
RUN, OTHER, WHOLE, OUTSIDE = ROOT, ROOT, ROOT, ROOT
SAVED: dict[int, tuple[str, str]] = {}
"""By step: digests of the whole state, and of the agent."""


def prepare(root: pathlib.Path) -> None:
    """Trains the victim, and another run whose files are mixed into it."""
    global RUN, OTHER, WHOLE, OUTSIDE
    RUN, OTHER, WHOLE, OUTSIDE = (root / name for name in ("run", "other", "whole", "outside"))
    whole = victim.train(WHOLE)
    victim.train(OTHER, seed=1)
    OUTSIDE.write_text("untouched")
    checkpoints = Checkpoints(whole.checkpoints, config=whole.digest)
    shapes = make_trainer(whole.config).shapes
    for step in checkpoints.steps():
        state, _ = checkpoints.load(shapes, step)
        SAVED[step] = victim.digest(state), victim.digest(state.agent)


def files(path: pathlib.Path) -> list[pathlib.Path]:
    """All of a folder."""
    return sorted(file for file in path.rglob("*") if file.is_file() and not file.is_symlink())


def scenario(seed: int) -> tuple[str, str]:
    """A damage; gives its name, and what came of it, the worst of reading in three ways."""
    rng = np.random.default_rng(seed)
    shutil.rmtree(RUN, ignore_errors=True)
    shutil.copytree(WHOLE, RUN)
    damage = DAMAGES[rng.integers(len(DAMAGES))]
    there = files(RUN)
    if rng.random() < 0.5:  # else most would be those of checkpoints
        there = [file for file in there if file.parent == RUN]
    damage(there[rng.integers(len(there))], rng)
    found = [_outcome(read) for read in (_policy, _report, _resumed)]
    if OUTSIDE.read_text() != "untouched":
        found.append("WROTE OUTSIDE")
    wrong = [outcome for outcome in found if outcome.isupper() or outcome.split(":")[0].isupper()]
    return damage.__name__, (wrong or sorted(set(found), reverse=True))[0]


def _outcome(read: Callable[[], str]) -> str:
    try:
        return victim.within_time(read)
    except victim.Hang:
        return "HANG"
    except Exception as error:
        return victim.refusal(error)


def _policy() -> str:
    policy = load_policy(RUN)
    same = SAVED.get(policy.env_steps, ("", ""))[1] == victim.digest(policy.state)
    return "as it was saved" if same else "WRONG NUMBERS"


def _report() -> str:
    same = read_run(RUN) == read_run(WHOLE)
    return "as it was saved" if same else "WRONG NUMBERS"


def _resumed() -> str:
    config = RunFolder.open(RUN).config
    if config != RunFolder.open(WHOLE).config:  # of a run that has begun, only steps may differ
        same = {**config.__dict__, "steps": 0} == {**victim.config().__dict__, "steps": 0}
        if not same and (RUN / "checkpoints").is_dir() and any((RUN / "checkpoints").iterdir()):
            take_up(RUN)
            return "WRONG NUMBERS"
        return "as it was saved"
    run = take_up(RUN, steps=config.steps + 500)
    if run._state is None:
        return "begun anew"
    same = SAVED.get(run.env_steps, ("", ""))[0] == victim.digest(run._state)
    return "as it was saved" if same else "WRONG NUMBERS"
