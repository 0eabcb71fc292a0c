"""Many runs in worker processes: each in its folder, skipped, resumed or reported."""

import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from typing import ClassVar

import oracles
import pytest

from mapg_jax.cli import sweep as sweep_command
from mapg_jax.cli.main import main as cli
from mapg_jax.runs.finishing import is_finished
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.metrics import read_metrics
from mapg_jax.sweeps import forecast as timing
from mapg_jax.sweeps import groups as grouping
from mapg_jax.sweeps import sweep
from mapg_jax.sweeps import table as sweep_table
from mapg_jax.sweeps.folder import SweepFolder
from mapg_jax.sweeps.groups import Job, groups, workers_that_fit
from mapg_jax.sweeps.pool import Worker, shares
from mapg_jax.training.config import PRESETS, Config

RUN = dataclasses.replace(oracles.RUN, steps=400, checkpoint_seconds=300.0, checkpoints_kept=2)
FLAGS = (
    "--preset smoke --environments 4 --replay-size 200 --batch-size 8 --hidden 8,8 "
    "--evaluate-every 200 --final-episodes 3"
)


def files(folder: pathlib.Path) -> dict[pathlib.Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def swept(tmp_path_factory, quick_compilation):
    """Two runs one after the other, the first of which diverges."""
    root = tmp_path_factory.mktemp("sweep")
    runs = [
        (dataclasses.replace(RUN, critic_learning_rate=1e30), root / "bad"),
        (dataclasses.replace(RUN, heads=1), root / "one"),
    ]
    told = []
    failures = sweep.run_all(runs, workers=1, on_finished=lambda f: told.append(f.path.name))
    return runs, failures, told


def test_a_run_that_fails_does_not_stop_the_others(swept):
    runs, failures, told = swept
    paths = [path for _, path in runs]
    assert failures == [
        f"{paths[0]}: a loss or parameter is no longer finite at step 16; no checkpoint was due"
    ]
    assert told == ["one"]
    assert [is_finished(RunFolder.open(path)) for path in paths] == [False, True]
    score = json.loads((paths[1] / "evaluation.json").read_text())
    assert (score["episodes"], score["seed"]) == (3, 0)


def test_a_finished_run_keeps_no_replay_and_says_so(swept, monkeypatch, capsys):
    _, (_, path) = swept[0]
    assert [p.name for p in (path / "checkpoints").glob("*/*") if p.is_dir()] == ["agent", "host"]
    monkeypatch.setattr(sys, "argv", ["mapg", "resume", str(path), "--steps", "800"])
    before = files(path)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert "finished without keeping its replay" in capsys.readouterr().err
    assert files(path) == before


def test_what_is_finished_is_left_alone(swept):
    runs = swept[0][1:]
    before = [files(path) for _, path in runs]
    assert sweep.run_all(runs) == []
    assert [files(path) for _, path in runs] == before


def test_a_folder_of_another_run_is_refused(swept):
    _, (config, path) = swept[0]
    with pytest.raises(ValueError, match="one holds a run of another configuration"):
        sweep.run_all([(dataclasses.replace(config, seed=7), path)])
    with pytest.raises(ValueError, match="two runs are to be written into new"):
        sweep.run_all([(config, pathlib.Path("new")), (RUN, pathlib.Path("new"))])


def test_a_run_that_was_given_more_steps_keeps_them(swept, tmp_path):
    """`mapg resume SWEEP/RUN --steps` does not shut out the rest of the sweep."""
    _, (config, path) = swept[0]
    longer = dataclasses.replace(config, steps=2 * config.steps)
    RunFolder.create(tmp_path / "longer", longer)
    assert sweep.unique_jobs([(config, tmp_path / "longer")]) == [Job(longer, tmp_path / "longer")]
    with pytest.raises(ValueError, match="another configuration"):
        sweep.unique_jobs([(dataclasses.replace(longer, steps=4 * config.steps), path)])


def test_a_killed_sweep_resumes_and_finishes(tmp_path, monkeypatch):
    """SIGTERM: the workers save and end. What is left is done by `mapg resume`, in lockstep."""
    out = tmp_path / "sweep"
    command = [sys.executable, "-m", "mapg_jax"]
    flags = f"{FLAGS} --heads 1 3 --steps 200000 --group all"
    names = ["pendulum-m1", "pendulum-m3"]
    with subprocess.Popen(
        [*command, "sweep", *flags.split(), "--out", str(out)], stderr=subprocess.PIPE, text=True
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
    done = subprocess.run([*command, "resume", str(out)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in names:
        folder = RunFolder.open(out / name)
        assert is_finished(folder)
        assert read_metrics(folder.metrics)[-1]["env_steps"] == stopped + 400
        assert name in done.stdout
    before = files(out)
    monkeypatch.setenv("NPROC", "1")
    monkeypatch.setattr(sys, "argv", ["mapg", "resume", str(out)])
    cli.main()
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
        file.write_text(file.read_text().replace('"steps": 200000', f'"steps": {steps}'))


class CrashingTogether(Worker):
    """A worker that ends at once: a group of several crashes, and one named bad fails alone too."""

    started: ClassVar[list[list[str]]] = []

    def __init__(self, group, cores, keep_replay):
        self.group, self.cores = group, cores
        self.folders = [RunFolder(path, config) for config, path in group]
        self.started.append([path.name for _, path in group])

    def running(self):
        return False

    def wait(self):
        pass

    stop = wait

    def crashed(self):
        return len(self.group) > 1 or self.group[0].path.name == "bad"

    def failures(self):
        return {job.path: "why" for job in self.group if self.crashed() and job.path.name != "one"}


def test_a_group_that_crashes_is_cut_into_its_runs(tmp_path, monkeypatch):
    """The run that had finished before the crash is not tried again."""
    monkeypatch.setattr(sweep, "Worker", CrashingTogether)
    monkeypatch.setattr(sweep, "POLL_SECONDS", 0.0)
    row = {"env_steps": 1.0, "return_mean": 0.0, "seconds": 1.0}
    monkeypatch.setattr(sweep_table, "read_metrics", lambda path: [row])
    names = ("one", "bad", "good")
    runs = [(dataclasses.replace(RUN, seed=k), tmp_path / n) for k, n in enumerate(names)]
    told = []
    failures = sweep.run_all(runs, group="all", on_finished=lambda f: told.append(f.path.name))
    assert CrashingTogether.started == [["one", "bad", "good"], ["bad"], ["good"]]
    assert failures == [f"{tmp_path / 'bad'}: why"]
    assert told == ["one", "good"]


# ----- groups, workers, memory and disk


def jobs(**changes) -> list[Job]:
    cells = [dataclasses.replace(RUN, heads=m, **changes) for m in (1, 4, 10)]
    return [Job(cell, pathlib.Path(f"nowhere/{cell.heads}")) for cell in cells]


def test_groups_are_cut_as_asked():
    mixed = [*jobs(), *(job._replace(path=job.path / "b") for job in jobs(batch_size=4))]
    sizes = {k: [len(group) for group in groups(mixed, k)] for k in ("auto", "one", "all", 2)}
    assert sizes == {"auto": [1] * 6, "one": [1] * 6, "all": [3, 3], 2: [2, 1, 2, 1]}
    for cut in (groups(mixed, "all"), groups(mixed, 2)):
        assert sorted(job.path for group in cut for job in group) == sorted(j.path for j in mixed)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        groups(mixed, 0)


def test_accelerators_get_as_many_as_fit(monkeypatch):
    monkeypatch.setattr(grouping.jax, "default_backend", lambda: "gpu")
    each = grouping.group_bytes((jobs()[2],))
    monkeypatch.setattr(grouping, "available_bytes", lambda: 5 * each)
    assert [len(group) for group in groups(jobs(), "auto")] == [2, 1]  # in half of it
    assert workers_that_fit(groups(jobs(), "auto")) == 1
    monkeypatch.setattr(grouping, "available_bytes", lambda: 2 * each + each // 2)
    with pytest.raises(ValueError, match="do not fit"):
        workers_that_fit(groups(jobs(), "all"))


def test_workers_are_as_many_as_memory_allows(monkeypatch):
    cut = groups(jobs(), "one")
    monkeypatch.setattr(grouping, "cpus", lambda: 3)
    monkeypatch.setattr(grouping, "available_bytes", lambda: 2_500_000_000)
    assert workers_that_fit(cut) == 2  # each takes 1 GB and its state
    assert workers_that_fit(cut, 1) == 1
    with pytest.raises(ValueError, match="3 at a time"):
        workers_that_fit(cut, 3)
    monkeypatch.setattr(grouping, "available_bytes", lambda: 500_000_000)
    with pytest.raises(ValueError, match=r"0\.5 GB that are available"):
        workers_that_fit(cut)


def test_cores_are_dealt_out():
    assert shares([0, 1, 2, 3], 2) == [[0, 2], [1, 3]]
    assert shares([0, 1], 3) == [[0], [1], [0]]
    assert shares([], 2) == [[], []]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the platform cannot pin")
def test_a_worker_is_pinned_and_one_that_dies_is_reported(tmp_path):
    core = min(os.sched_getaffinity(0))
    worker = Worker((Job(RUN, tmp_path / "run"),), [core], keep_replay=False)
    assert os.sched_getaffinity(worker.pid) == {core}
    os.kill(worker.pid, signal.SIGKILL)
    worker.wait()
    assert worker.crashed()
    assert worker.failures() == {tmp_path / "run": "killed by signal 9"}


# ----- the command


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--heads", "the grid is empty: --heads has no values"),
        ("--seeds 0", "the grid is empty: seeds must be at least 1, got 0"),
        ("--seeds 2 --seed 3 4", "--seeds and --seed both say the seeds"),
        ("--heads 0 1", "heads must be at least 1, got 0"),
        ("--env pendulum hoper", "unknown environment 'hoper'"),
        ("--hidden 64", "hidden must be two widths or more"),
        ("--replay-size 2000000000", "do not fit"),
        ("--group 0", "group must be auto, one, all or at least 1, got 0"),
        ("--workers 0", "workers must be at least 1, got 0"),
        ("--gradient stored al", "'al'"),
        ("--stepz 3", "stepz"),
    ],
)
def test_bad_input_is_named_and_leaves_nothing(flags, message, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPROC", "1")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["mapg", "sweep", *flags.split(), "--out", "here"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    out, err = capfd.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert message in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_order_of_values_changes_no_cell(tmp_path):
    """A3C has no heads and no noise, and takes neither from the cells of MAPG."""
    flags = f"--heads 10 --noise none --gradient all --out {tmp_path / 'here'} --algorithm".split()

    def cells(*algorithms):
        folder = sweep_command.parse([*flags, *algorithms], Config()).folder()
        return {config for config, _ in folder.runs()}

    mapg = Config(heads=10, noise="none", gradient="all")
    assert cells("a3c", "mapg") == cells("mapg", "a3c") == {mapg, Config(algorithm="a3c")}


def test_every_value_is_tried_with_its_own(tmp_path):
    """The batch fits each of the replays asked for, though not the preset's."""
    flags = f"--batch-size 20000 --replay-size 50000 100000 --out {tmp_path / 'here'}".split()
    folder = sweep_command.parse(flags, PRESETS["smoke"]).folder()
    assert [config.replay_size for config, _ in folder.runs()] == [50000, 100000]


def test_checkpoints_that_are_there_count_as_room(tmp_path, monkeypatch):
    """A sweep that was stopped needs no more of the disk than when it began."""
    cut = [(jobs()[0]._replace(path=tmp_path / "run"),)]
    needed = grouping.disk_bytes(cut, 1, keep_replay=False)
    monkeypatch.setattr(grouping, "free_bytes", lambda path: needed - 1000)
    with pytest.raises(ValueError, match="the checkpoints can take"):
        grouping.refuse_a_full_disk(cut, 1, keep_replay=False)
    (tmp_path / "run" / "checkpoints" / "400").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "400" / "data").write_bytes(bytes(1000))
    grouping.refuse_a_full_disk(cut, 1, keep_replay=False)


def test_a_full_disk_is_refused(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(grouping, "free_bytes", lambda path: 1_000_000)
    monkeypatch.setattr(sys, "argv", ["mapg", "sweep", "--out", str(tmp_path / "here")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert "has 0.0 GB left" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_dry_run_shows_the_runs_and_writes_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPROC", "1")
    flags = f"sweep {FLAGS} --heads 1 3 3 --seeds 2 --group all --dry-run --no-measure"
    monkeypatch.setattr(sys, "argv", ["mapg", *flags.split(), "--out", "here"])
    cli.main()
    out, err = capfd.readouterr()
    assert "2 cells are equal to others and are run once" in err
    for name in ("pendulum-m1-s0", "pendulum-m3-s1"):
        assert name in out
    assert "4 runs in 1 groups" in out
    assert "memory:" in out and "disk:" in out and "time:" not in out
    assert not list(tmp_path.iterdir())


def test_a_dry_run_predicts_the_time(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPROC", "1")
    monkeypatch.setattr(sweep_command.timing, "predict", lambda groups, workers: 3725.4)
    monkeypatch.setattr(sys, "argv", ["mapg", "sweep", "--dry-run", "--out", "here"])
    cli.main()
    assert "time:   1:02:05, from" in capfd.readouterr().out
    assert not list(tmp_path.iterdir())


def test_each_program_is_timed_once_with_the_most_heads(monkeypatch):
    """Two programs, of 3 groups and of 1, on two workers."""
    timed = []

    def seconds(group):
        timed.append(group[0].config.heads)
        return 100.0 if group[0].config.batch_size == 4 else 10.0

    monkeypatch.setattr(timing, "_seconds", seconds)
    cut = [*groups(jobs(), "one"), *groups(jobs(batch_size=4)[:1], "one")]
    assert timing.predict(cut, 2) == (3 * 10 + 100) / 2
    assert timed == [10, 1]


def test_a_sweep_folder_is_its_grid(tmp_path):
    values = {"hidden": ((8, 8), (16, 16)), "env_options": ((), ("g=9.81",)), "seed": (0, 1)}
    folder = SweepFolder(tmp_path / "s", Config(), values, group=2, workers=1, keep_replay=True)
    folder.create()
    assert SweepFolder.is_one(folder.path)
    assert SweepFolder.open(folder.path) == folder
    assert len(folder.runs()) == 8
    (folder.path / "sweep.json").write_text("{}")
    with pytest.raises(ValueError, match=r"sweep\.json is damaged"):
        SweepFolder.open(folder.path)
