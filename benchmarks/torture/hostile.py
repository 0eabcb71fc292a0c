"""Hostile command lines: each is a run that can begin, or one line, and nothing half-written."""

import contextlib
import io
import pathlib
import shutil

import numpy as np

from benchmarks.torture import victim
from mapg_jax.algorithms import registry
from mapg_jax.cli import train
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.train import begin
from mapg_jax.training.config import PRESETS, config_type, fields, preset

VALUES = ("-1", "0", "1", "7", "1e9", "-1e30", "1e308", "nan", "inf", "none", "true", "", " ", "x",
          "é²", "10000000000000", "2147483647", "0.5", "[[", "=", "a=b", "--", "pendulum", "hopper",
          "halfcheetah", "brax:ant", "brax:", "mjx", "native", "64,64", "1,", "episode",
          "9" * 400)  # fmt: skip


def scenario(seed: int, root: pathlib.Path) -> tuple[str, str]:
    """A command line; gives which command, and what came of it."""
    rng = np.random.default_rng(seed)
    out = root / "hostile"
    shutil.rmtree(out, ignore_errors=True)
    algorithm = rng.choice(registry.names())
    names = sorted(fields(config_type(algorithm)))
    if rng.random() < 0.1:
        names.append("no_such_option")
    flags = ["--preset", rng.choice(list(PRESETS)) if rng.random() < 0.3 else "smoke"]
    flags += ["--algorithm", algorithm]
    for name in rng.choice(names, rng.integers(1, 4), replace=False):
        values = rng.choice(VALUES, 1 if rng.random() < 0.9 else 2)
        flags += [f"--{name.replace('_', '-')}", *values]
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
        outcome = _outcome([str(flag) for flag in flags], out, said)
    begun = out.exists() and any(out.iterdir())
    if begun != (outcome == "begins"):
        outcome = "HALF-WRITTEN"
    elif begun:
        RunFolder.open(out)
    return "train", outcome


def _outcome(flags: list[str], out: pathlib.Path, said: io.StringIO) -> str:
    def run() -> str:
        arguments = train.parse([*flags, "--out", str(out)])
        begin(preset(arguments.preset, **train.fields.given(arguments)), arguments.out)
        return "begins"

    try:
        return victim.within_time(run)
    except SystemExit as ended:
        lines = said.getvalue().strip().splitlines()
        polite = ended.code == 2 and lines[-1].startswith("mapg")
        return "refused in a line" if polite else f"STATUS {ended.code}"
    except victim.Hang:
        return "HANG"
    except Exception as error:
        return victim.refusal(error)
