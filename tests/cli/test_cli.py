"""The command line: what it prints and where, and that bad input leaves nothing behind."""

import dataclasses
import json
import shutil
import subprocess
import sys

import jax
import oracles
import pytest
from mapg_jax.runs.recording import record

import envs
from mapg_jax.cli.main import main as cli
from mapg_jax.runs import recording, runner
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config

TINY = (
    "--heads 3 --steps 400 --environments 4 --replay-size 200 --batch-size 8 --hidden 8 8 "
    "--learning-starts 16 --time-limit 50 --evaluate-every 200 --evaluation-episodes 2 "
    "--final-episodes 3"
)


@pytest.fixture
def mapg(monkeypatch, capfd, tmp_path):
    """mapg(*arguments) → exit status, standard output, standard error; in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPROC", "1")  # which `main` would set for good
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["mapg", *map(str, arguments)])
        capfd.readouterr()
        try:
            cli.main()
            status = 0
        except SystemExit as stop:
            status = stop.code
        return status, *capfd.readouterr()

    return run


def contents(folder):
    """Every path below a folder, and what the files hold."""
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.fixture
def workplace(tmp_path, finished_run):
    """A finished run, and run folders with something wrong."""
    shutil.copytree(finished_run.path, tmp_path / "run")
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "empty").mkdir()
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    RunFolder.create(tmp_path / "fresh", oracles.RUN)
    oracles.finished_run(oracles.RUN, tmp_path / "scored", [1.0, 2.0])
    text = (tmp_path / "run" / "config.json").read_text()
    for name, damaged in {
        "torn": text[: len(text) // 2],
        "wrong": text.replace('"heads": 3', '"heads": 0'),
        "unknown": text.replace('"heads"', '"haeds"'),
        "typed": text.replace('"heads": 3', '"heads": "three"'),
        "listed": "[]",
        "nested": '{"config": []}',
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(damaged)
    shutil.copytree(tmp_path / "run", tmp_path / "damaged")
    for file in (tmp_path / "damaged" / "checkpoints" / "800").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    shutil.copytree(tmp_path / "run", tmp_path / "held")
    with RunFolder.open(tmp_path / "held").lock():
        yield tmp_path


REFUSALS = [
    ("train --env hoper", "unknown environment 'hoper'; known are pendulum, hopper"),
    ("train --env brax:hoper", "Brax has no environment 'hoper'; it has"),
    ("train --env pendulum --engine mjx", "pendulum has no engine 'mjx'; it has jax"),
    ("train --env-options gravity=1", "pendulum has no option 'gravity'; it has g"),
    ("train --env-options g", "env_options are written name=value, got 'g'"),
    ("train --env-options engine=jax", "the engine is no option of an environment"),
    ("train --env-options name=pendulum", "pendulum has no option 'name'; it has g"),
    ("train --env driving --env-options track=5", "unknown track '5'"),
    ("train --heads 0", "heads must be at least 1, got 0"),
    ("train --batch-size 65 --replay-size 64", "a batch of 65 is larger than the replay of 64"),
    ("train --preset papr", "papr"),
    ("train --stepz 5", "--stepz"),
    ("train --gradient al", "stored"),
    ("train --heads many", "many"),
    ("train --out run", "run exists already; choose another --out, or go on with: mapg resume run"),
    ("train --out file/run", "file/run cannot be created: Not a directory"),
    ("trian", "trian"),
    ("resume nowhere", "there is no run folder nowhere"),
    ("resume empty", "empty is not a run folder: it has no config.json"),
    ("resume torn", "torn/config.json is damaged"),
    ("resume wrong", "heads must be at least 1, got 0"),
    ("resume unknown", "unknown: haeds"),
    ("resume typed", "typed/config.json is damaged"),
    ("resume listed", "listed/config.json is damaged"),
    ("resume nested", "nested/config.json is damaged"),
    ("resume damaged", "800 is damaged"),
    ("resume run --steps 0", "steps must be at least 1, got 0"),
    ("drive run", "run is a run of pendulum, not of driving"),
    ("resume held --steps 2000", "another process trains held"),
    ("evaluate nowhere", "there is no run folder nowhere"),
    ("evaluate fresh", "fresh has no complete checkpoint"),
    ("evaluate damaged", "800 is damaged"),
    ("evaluate run --physics native", "pendulum has no engine 'native'; it has jax"),
    ("evaluate run --physics bullet", "bullet"),
    ("evaluate run --episodes 0", "episodes must be at least 1, got 0"),
    ("report nowhere", "there is no nowhere"),
    ("report empty", "there are no runs in empty"),
    ("report file", "file is neither a run folder, a folder of them nor a CSV of results"),
    ("report torn", "torn/config.json is damaged"),
    ("report fresh --out pictures", "no run in fresh is finished (1 are not)"),
    ("report table.csv", "table.csv is no CSV of results: its columns are a,b, not env,algorithm"),
    ("report scored --out file", "file cannot be made: File exists"),
    ("report", "name a run folder, a folder of them or a CSV file of results"),
    (
        "evaluate run --seed -1 --physics gymnasium",
        "seed must be at least 0",
    ),
]


def test_bad_input_is_named_and_leaves_nothing(mapg, workplace):
    for command, message in REFUSALS:
        before = contents(workplace)
        status, out, err = mapg(*command.split())
        assert status == 2, command
        assert out == "", command
        assert message in err, command
        assert err.startswith("mapg: ") and err.count("\n") == 1, command
        assert contents(workplace) == before, command


def test_too_little_memory_is_refused_with_the_numbers(mapg, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "available_bytes", lambda: 50_000_000)
    status, out, err = mapg("train", "--env", "hopper", "--out", "run")
    assert (status, out) == (2, "")
    assert "mapg: the run needs 0.1 GB" in err
    assert not list(tmp_path.iterdir())


def test_a_drive_is_drawn_from_its_start(mapg, tmp_path, monkeypatch):
    config = dataclasses.replace(oracles.RUN, env="driving", time_limit=20)
    folder = oracles.untrained_run(config, tmp_path / "run")
    drawn = []
    monkeypatch.setattr(recording, "record", lambda *a: drawn.append(record(*a)) or drawn[0])
    status, out, err = mapg("drive", "run", "--seed", 5)
    assert (status, out.split()) == (0, ["run/drive.png", "run/drive.html"]), err
    assert (folder.path / "drive.png").read_bytes()[1:4] == b"PNG"
    assert "<html" in (folder.path / "drive.html").read_text()
    (states,) = drawn
    start = config.make_env().reset(jax.random.split(jax.random.key(5))[0]).pipeline_state
    assert states.x.shape == (20,)
    assert (states.steps == range(20)).all()
    assert (states.x[0], states.y[0]) == (start.x, start.y)


def test_train_then_resume_then_evaluate(mapg, tmp_path):
    status, out, err = mapg("train", *TINY.split(), "--out", "runs/mine")
    assert status == 0, err
    assert "step 400 of 400: return" in err
    assert "run folder:     runs/mine" in out
    assert "learning curve: runs/mine/curve.png" in out
    assert (tmp_path / "runs/mine/curve.png").read_bytes()[1:4] == b"PNG"
    folder = RunFolder.open("runs/mine")
    assert folder.config == dataclasses.replace(
        Config(), heads=3, steps=400, environments=4, replay_size=200, batch_size=8, hidden=(8, 8),
        learning_starts=16, time_limit=50, evaluate_every=200, evaluation_episodes=2,
        final_episodes=3,
    )  # fmt: skip

    before = contents(tmp_path)
    status, out, _ = mapg("resume", "runs/mine")
    assert status == 0
    assert "runs/mine is finished: 400 steps" in out
    status, out, _ = mapg("resume", "runs/mine", "--steps", 100)
    assert status == 0
    assert "runs/mine is finished: 400 steps" in out
    assert contents(tmp_path) == before

    status, out, err = mapg("evaluate", "runs/mine", "--json", "--episodes", 5)
    assert status == 0, err
    record = json.loads(out)
    assert record == json.loads(folder.evaluation.read_text())
    wanted = {"env", "physics", "select", "episodes", "mean", "std", "ci95", "returns"}
    assert wanted <= set(record)
    assert len(record["returns"]) == 5
    status, out, _ = mapg("evaluate", "runs/mine", "--episodes", 5)
    assert status == 0
    assert f"{record['mean']:.1f}" in out


def test_a3c_trains_resumes_and_is_scored(mapg, tmp_path):
    status, out, err = mapg("train", "--preset", "smoke", "--algorithm", "a3c")
    assert status == 0, err
    assert "run folder:     runs/pendulum-a3c-1" in out
    status, _, err = mapg("resume", "runs/pendulum-a3c-1", "--steps", 3_000)
    assert status == 0, err
    status, out, _ = mapg("evaluate", "runs/pendulum-a3c-1", "--select", "mean", "--json")
    assert status == 0
    record = json.loads(out)
    assert (record["select"], record["spread"], record["q_gap"]) == ("mean", 0, 0)
    before = contents(tmp_path)
    status, out, err = mapg("evaluate", "runs/pendulum-a3c-1", "--select", "argmax-q")
    assert (status, out) == (2, "")
    assert err == "mapg: select must be one of uniform, mean, got 'argmax-q'\n"
    assert contents(tmp_path) == before


def test_a_diverging_run_exits_1(mapg, tmp_path):
    status, out, err = mapg(
        "train", *TINY.split(), "--critic-learning-rate", "1e30", "--out", "run"
    )
    assert (status, out) == (1, "")
    assert "mapg: a loss or parameter is no longer finite at step 16" in err
    assert "Traceback" not in err


def test_environments_are_listed(mapg):
    status, out, _ = mapg("envs")
    assert status == 0
    for name in envs.names():
        spec = envs.spec(name)
        (line,) = (line for line in out.splitlines() if f" {name} " in line)
        for text in (*spec.engines, str(spec.time_limit), spec.gymnasium_id or ""):
            assert text in line


@pytest.mark.parametrize("preset", ["paper", "parallel", "smoke"])
def test_a_preset_sets_the_defaults_that_help_shows(mapg, preset, monkeypatch):
    started = []
    monkeypatch.setattr(cli, "start", lambda config, out: started.append(config) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        mapg("train", "--preset", preset, "--seed", 3)
    with pytest.raises(ZeroDivisionError):
        mapg("train", f"--preset={preset}", "--env", "hopper")
    assert started[0] == dataclasses.replace(cli.PRESETS[preset], seed=3)
    assert started[1] == dataclasses.replace(cli.PRESETS[preset], env="hopper")
    status, out, err = mapg("train", "--preset", preset, "--help")
    assert status == 0
    assert f"default: {cli.PRESETS[preset].batch_size}" in out + err


def test_json_is_all_that_reaches_standard_output(tmp_path):
    """In a process of its own, where Brax and MJX print while they are imported."""
    config = dataclasses.replace(oracles.RUN, env="hopper", engine="native", time_limit=20)
    folder = oracles.untrained_run(config, tmp_path / "run")
    command = [sys.executable, "-m", "mapg_jax", "evaluate", str(folder.path), "--json"]
    options = ["--physics", "gymnasium", "--episodes", "4"]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert (record["physics"], record["env"]) == ("gymnasium", "hopper")
    assert record == json.loads(folder.evaluation.read_text())


@pytest.mark.mjx
def test_a_smoke_run_on_mjx(mapg, tmp_path):
    command = "train --env hopper --engine mjx --preset smoke --out run"
    status, out, err = mapg(*command.split())
    assert status == 0, err
    assert "run folder:     run" in out
    record = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert (record["physics"], record["episodes"]) == ("mjx", 4)
