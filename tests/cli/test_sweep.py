"""mapg sweep: what it prints, what it refuses, and that it can be stopped at any time."""

import pathlib
import signal
import subprocess
import sys
import time

import pytest

from mapg_jax.algorithms import registry
from mapg_jax.cli import fields, train
from mapg_jax.cli import sweep as command
from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.sweeps import groups
from mapg_jax.sweeps.folder import SweepFolder
from mapg_jax.training.config import Config

FLAGS = (
    "--preset smoke --environments 4 --replay-size 200 --batch-size 8 --hidden 8,8 "
    "--evaluate-every 200 --final-episodes 3"
)


def files(folder: pathlib.Path) -> dict[pathlib.Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_killed_sweep_resumes_and_finishes(mapg, tmp_path):
    """SIGTERM: the workers save and end. What is left is done by `mapg resume`, in lockstep."""
    out = tmp_path / "sweep"
    program = [sys.executable, "-m", "mapg_jax"]
    flags = f"{FLAGS} --heads 1 3 --steps 200000 --group all"
    names = ["pendulum-m1", "pendulum-m3"]
    with subprocess.Popen(
        [*program, "sweep", *flags.split(), "--out", str(out)], stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            wait_for(lambda: (out / names[-1] / "metrics.csv").exists())
            process.send_signal(signal.SIGTERM)
            _, error = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 128 + signal.SIGTERM, error
    assert f"mapg: stopped by SIGTERM; go on with: mapg resume {out}" in error
    steps = {int(next((out / n / "checkpoints").iterdir()).name) for n in names}
    assert len(steps) == 1  # lockstep

    # The rest of 200,000 steps would take too long: the same sweep of fewer steps.
    (stopped,) = steps
    shorten(out, names, stopped + 400)
    done = subprocess.run([*program, "resume", str(out)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in names:
        folder = RunFolder.open(out / name)
        assert is_finished(folder)
        assert read_metrics(folder.metrics)[-1]["env_steps"] == stopped + 400
        assert name in done.stdout
    before = files(out)
    status, shown, _ = mapg("resume", out)
    assert status == 0 and all(name in shown for name in names)
    status, shown, error = mapg("resume", out / names[0], "--steps", stopped + 800)
    assert (status, shown) == (2, "")
    assert error.startswith("mapg: ") and "finished without keeping its replay" in error
    assert files(out) == before


def test_workers_end_with_their_parent(tmp_path):
    """Killed outright, the parent leaves no process behind, and the state is saved."""
    out = tmp_path / "sweep"
    flags = f"{FLAGS} --steps 100000000 --out {out}"
    process = subprocess.Popen(
        [sys.executable, "-m", "mapg_jax", "sweep", *flags.split()], stderr=subprocess.DEVNULL
    )
    try:
        wait_for(lambda: (out / "pendulum" / "metrics.csv").exists())
    finally:
        process.kill()
        process.wait()
    wait_for(lambda: any((out / "pendulum" / "checkpoints").glob("[0-9]*")))


def wait_for(condition, seconds: float = 300.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def shorten(out: pathlib.Path, names: list[str], steps: int) -> None:
    """Rewrites a sweep's number of steps, in its grid and in its runs."""
    for file in (out / "sweep.json", *(out / name / "config.json" for name in names)):
        file.write_text(file.read_text().replace("200000", str(steps)))


REFUSALS = [
    ("--heads", "the grid is empty: --heads has no values"),
    ("--seeds 0", "the grid is empty: seeds must be at least 1, got 0"),
    ("--seeds 100000000", "the grid has 100,000,000 cells, more than 100,000"),
    ("--seeds 100000 --heads 1 10", "the grid has 200,000 cells, more than 100,000"),
    ("--seeds 2 --seed 3 4", "--seeds and --seed both say the seeds"),
    ("--heads 0 1", "heads must be at least 1, got 0"),
    ("--env pendulum hoper", "unknown environment 'hoper'"),
    ("--hidden 64", "hidden must be two widths or more"),
    ("--replay-size 2000000000", "do not fit"),
    ("--group 0", "group must be auto, one, all or at least 1, got 0"),
    ("--group some", "--group: must be auto, one, all or a whole number, got 'some'"),
    ("--workers 0", "workers must be at least 1, got 0"),
    ("--gradient stored al", "'al'"),
    ("--stepz 3", "stepz"),
    ("--algorithm a3c --tau 0.1", "--tau is an option of mapg, "),
    (
        "--algorithm mapg a4c",
        f"algorithm must be one of {', '.join(registry.names())}, got 'a4c'",
    ),
    (
        "--preset papr",
        "preset must be one of paper, diverse, reference, parallel, smoke, got 'papr'",
    ),
    ("--algorithm mapg sac --preset diverse", "diverse is a preset of mapg and td3, not of sac"),
]


@pytest.mark.parametrize(("flags", "message"), REFUSALS)
def test_bad_input_is_named_and_leaves_nothing(flags, message, mapg, contents):
    status, out, err = mapg("sweep", *flags.split(), "--out", "here")
    assert (status, out) == (2, "")
    assert err.startswith("mapg: ") and message in err and err.count("\n") == 1
    assert not contents()


def folder(*flags: str):
    """What `mapg sweep` would write down."""
    return command.sweep_folder(command.parse([*flags, "--out", "nowhere"]))


def test_the_order_of_values_changes_no_cell():
    """A3C has no heads and no noise, and takes neither from the cells of MAPG."""
    flags = ["--heads", "10", "--noise", "none", "--gradient", "all", "--algorithm"]

    def cells(*algorithms):
        return {config for config, _ in folder(*flags, *algorithms).runs()}

    mapg = Config(heads=10, noise="none", gradient="all")
    assert cells("a3c", "mapg") == cells("mapg", "a3c") == {mapg, Config(algorithm="a3c")}


def test_every_value_is_tried_with_its_own():
    """The batch fits each of the replays asked for, though not the preset's."""
    flags = "--preset smoke --batch-size 20000 --replay-size 50000 100000"
    found = folder(*flags.split()).runs()
    assert [config.replay_size for config, _ in found] == [50000, 100000]


def test_a_value_of_several_parts_is_written_as_in_train():
    """Commas join what belongs to one value; in a sweep spaces part the values."""
    flags = [
        "--env",
        "driving",
        "--hidden",
        "64,64",
        "--env-options",
        "control_hz=10,start=anywhere",
    ]
    (swept,) = (config for config, _ in folder(*flags).runs())
    arguments = train.parse(flags)
    assert swept == Config(**fields.given(arguments))
    assert (swept.hidden, swept.env_options) == ((64, 64), ("control_hz=10", "start=anywhere"))
    assert fields.given(train.parse(["--hidden", "64", "64"])) == {"hidden": (64, 64)}
    several = folder("--hidden", "64,64", "8,8,8").runs()
    assert [config.hidden for config, _ in several] == [(64, 64), (8, 8, 8)]


def test_a_full_disk_is_refused(mapg, contents, monkeypatch):
    monkeypatch.setattr(groups.disk, "free_bytes", lambda path: 1_000_000)
    status, out, err = mapg("sweep", "--out", "here")
    assert (status, out) == (2, "")
    assert "has 1.0 MB left" in err
    assert not contents()


def test_a_dry_run_shows_the_runs_and_writes_nothing(mapg, contents):
    flags = f"{FLAGS} --heads 1 3 3 --seeds 2 --group all --dry-run --no-measure"
    status, out, err = mapg("sweep", *flags.split(), "--out", "here")
    assert status == 0
    assert "2 cells are equal to others and are run once" in err
    for name in ("pendulum-m1-s0", "pendulum-m3-s1"):
        assert name in out
    assert "4 runs in 1 groups" in out
    assert "memory:" in out and "disk:" in out and "time:" not in out
    assert not contents()


def test_a_dry_run_predicts_the_time(mapg, contents, monkeypatch):
    monkeypatch.setattr(command.forecast, "predict", lambda groups, workers: 3725.4)
    status, out, _ = mapg("sweep", "--dry-run", "--out", "here")
    assert status == 0
    assert "time:   1:02:05, from" in out
    assert not contents()


def test_a_sweep_takes_no_flags_of_its_runs_when_it_is_resumed(mapg, tmp_path):
    SweepFolder(tmp_path / "s", "smoke", {"seed": (0, 1)}).create()
    status, out, err = mapg("resume", "s", "--steps", 5)
    assert (status, out, err) == (2, "", "mapg: s is a sweep; --steps is for a run of it\n")
    status, out, err = mapg("resume", "s", "--track", "wandb")
    assert (status, out, err) == (2, "", "mapg: s is a sweep; --track is for a run of it\n")
