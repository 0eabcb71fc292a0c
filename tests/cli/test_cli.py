"""The command line: what it prints and where, and that bad input leaves nothing behind."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys

import jax
import oracles
import pytest

import envs
from mapg_jax.algorithms import registry
from mapg_jax.cli import train
from mapg_jax.cli.main import COMMANDS
from mapg_jax.runs import episode, memory, scoring
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config, fields, preset, presets_of

TINY = (
    "--heads 3 --steps 400 --environments 4 --replay-size 200 --batch-size 8 --hidden 8 8 "
    "--learning-starts 16 --time-limit 50 --evaluate-every 200 --evaluation-episodes 2 "
    "--final-episodes 3"
)


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
        "nested": '{"format": 5, "config": []}',
        "older": '{"config": {"env": "pendulum"}}',
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(damaged)
    shutil.copytree(tmp_path / "run", tmp_path / "damaged")
    (tmp_path / "broken.py").write_text("1 / 0")
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
    (
        "train --env driving --env-options lookahead=20,50",
        "env_options are written name=value, or name=[a,b] for several values, got '50'",
    ),
    ("train --env-options engine=jax", "the engine is no option of an environment"),
    ("train --env-options name=pendulum", "pendulum has no option 'name'; it has g"),
    ("train --env driving --env-options track=[town,five]", "unknown track 'five'"),
    ("train --print-config --env-options gravity=1", "pendulum has no option 'gravity'; it has g"),
    ("train --heads 0", "heads must be at least 1, got 0"),
    ("train --batch-size 65 --replay-size 64", "a batch of 65 is larger than the replay of 64"),
    ("train --preset papr", "papr"),
    ("push none ./there", "there is no run folder none"),
    ("pull ./none", "there is no folder ./none"),
    ("dashboard none", "there is no none"),
    ("train --stepz 5", "--stepz"),
    ("train --gradient al", "--gradient: must be one of stored, resampled, all, got 'al'"),
    ("train --heads many", "--heads: must be a whole number, got 'many'"),
    ("train --steps 1e6", "--steps: must be a whole number, got '1e6'"),
    ("train --step 5", "unknown: --step; did you mean --steps?"),
    ("sweep --out x --seeds 0 1", "--seeds takes one value: 1 is one too many"),
    ("sweep --out x --no-measure 1", "--no-measure takes no value: 1 is one too many"),
    ("train 5", "unknown: 5"),
    (
        "train --algorithm a4c",
        f"algorithm must be one of {', '.join(registry.names())}, got 'a4c'",
    ),
    ("train --algorithm a3c --tau 0.1", "--tau is an option of mapg, "),
    (
        "train --algorithm a3c --heads 3",
        "--heads is an option of mapg, ",
    ),
    ("train --algorithm naf --preset diverse", "diverse is a preset of mapg and td3, not of naf"),
    ("train --algorithm ppo --hold 3", "--hold is an option of mapg and td3, not of ppo"),
    ("train --algorithm trpo --repulsion stein", "--repulsion is an option of mapg and td3, not"),
    ("train --algorithm sac --target max", "--target is an option of mapg and td3, not of sac"),
    (
        "train --algorithm td3 --gradient marginal",
        "--gradient: must be one of stored, resampled, all, got 'marginal'",
    ),
    (
        "train --algorithm ppo --gradient all",
        "--gradient: must be one of stored, marginal, got 'all'",
    ),
    (
        "train --algorithm ppo --minibatches 7",
        "a rollout of 2048 steps, 128 of each environment, cannot be cut into 7 minibatches",
    ),
    ("train --algorithm td3 --policy-delay 0", "policy_delay must be at least 1, got 0"),
    ("train --hold 0", "hold must be at least 1, got 0"),
    ("train --floor -1", "floor must be above 0, got -1.0"),
    ("train --env swimmer --env-options restricted=True", "Q3C's table has no K for Swimmer"),
    ("train --env hopper --env-options restricted=-1", "restricted must be True or K above 0"),
    ("train --env point_maze --env-options maze=zz", "unknown maze 'zz'; known are v1, v2"),
    ("train --rollout-steps 5", "--rollout-steps is an option of a3c, ppo and trpo, not of mapg"),
    ("train --import nowhere", "the module 'nowhere' cannot be imported: No module named"),
    ("train --import broken", "the module 'broken' cannot be imported: division by zero"),
    ("train --out run", "run exists already; choose another --out, or go on with: mapg resume run"),
    ("train --out file/run", "file/run cannot be created: Not a directory"),
    ("trian", "trian"),
    ("resume nowhere", "there is no run folder nowhere"),
    ("resume empty", "empty is not a run folder: it has no config.json"),
    ("resume torn", "torn/config.json is damaged"),
    ("resume wrong", "heads must be at least 1, got 0"),
    ("resume unknown", "haeds is no option of a run"),
    ("resume typed", "typed/config.json is damaged"),
    ("resume listed", "listed/config.json is damaged"),
    ("resume nested", "nested/config.json is damaged"),
    ("resume older", "older is a run folder of format 1, and this version reads format 5"),
    ("evaluate older", "older is a run folder of format 1, and this version reads format 5"),
    ("report older", "older is a run folder of format 1, and this version reads format 5"),
    ("resume run --steps 0", "steps must be at least 1, got 0"),
    ("resume run --steps 100", "run has 800 steps already, more than 100; --steps with a larger"),
    ("resume held --steps 2000", "another process trains held"),
    ("evaluate nowhere", "there is no run folder nowhere"),
    ("evaluate fresh", "fresh has no complete checkpoint"),
    ("evaluate run --physics native", "pendulum has no engine 'native'; it has jax"),
    ("evaluate run --physics bullet", "bullet"),
    ("evaluate run --episodes 0", "episodes must be at least 1, got 0"),
    ("evaluate run --episodes 10000000000", "10,000,000,000 episodes side by side need"),
    ("evaluate run --select best", "select must be one of uniform, argmax-q, mean, first"),
    ("report nowhere", "there is no nowhere"),
    ("report empty", "there are no runs in empty"),
    ("report file", "file is neither a run folder, a folder of them nor a CSV of results"),
    ("report torn", "torn/config.json is damaged"),
    ("report fresh --out pictures", "no run in fresh is finished (1 are not)"),
    ("report table.csv", "table.csv is no CSV of results: its columns are a,b, not env,algorithm"),
    ("report scored --out file", "file cannot be made: File exists"),
    ("report", "name a run folder, a folder of them or a CSV file of results"),
    ("evaluate run --seed -1 --physics gymnasium", "seed must be at least 0"),
    ("paper claims --no-train", "there is nothing to show: no results in results, no runs in"),
    ("paper fig9", "fig9"),
    ("paper fig3 --seeds 0", "seeds must be at least 1, got 0"),
    ("paper fig3 --steps 7", "steps must be a multiple of 160"),
    ("paper fig3 --workers 0", "workers must be at least 1, got 0"),
    ("paper fig3 --out file/new", "file/new cannot be created: Not a directory"),
]


@pytest.mark.usefixtures("workplace")
def test_bad_input_is_named_and_leaves_nothing(mapg, contents, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for command, message in REFUSALS:
        before = contents()
        status, out, err = mapg(*command.split())
        assert status == 2, command
        assert out == "", command
        assert message in err, command
        assert err.startswith("mapg: ") and err.count("\n") == 1, command
        assert contents() == before, command


def test_too_little_memory_is_refused_with_the_numbers(mapg, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 50_000_000)
    status, out, err = mapg("train", "--env", "hopper", "--out", "run")
    assert (status, out) == (2, "")
    assert "mapg: the run needs 0.1 GB, of which the replay" in err
    assert not list(tmp_path.iterdir())


def test_only_a_size_that_nobody_asked_for_is_made_to_fit(mapg, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(memory, "available_bytes", lambda: 50_000_000)
    flags = ["train", "--env", "hopper", "--preset", "parallel", "--environments", 8]
    flags += ["--batch-size", 64, "--out", "run"]
    status, _, err = mapg(*flags, "--replay-size", 2_000_000)
    assert status == 2 and "of which the replay of 2,000,000 transitions" in err
    assert not list(tmp_path.iterdir())
    assert mapg(*flags, "--steps", 16, "--final-episodes", 1)[0] == 0
    assert "2,000,000 transitions do not fit the memory" in caplog.text
    assert 100_000 < RunFolder.open(tmp_path / "run").config.replay_size < 2_000_000


def test_memory_that_runs_out_later_is_one_line(mapg, monkeypatch):
    from mapg_jax.cli import envs as command

    def run(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.")

    monkeypatch.setattr(command, "run", run)
    status, _, err = mapg("envs")
    assert status == 1 and err.count("\n") == 1
    assert err.startswith("mapg: RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes")


def test_a_billion_episodes_are_one_line(mapg, workplace, monkeypatch):
    monkeypatch.setattr(scoring, "available_bytes", lambda: 8_000_000_000)
    status, out, err = mapg("evaluate", workplace / "run", "--episodes", 10**9)
    assert (status, out) == (2, "")
    assert err.startswith("mapg: 1,000,000,000 episodes side by side need ")
    assert err.count("\n") == 1


def test_what_draws_nothing_is_refused(mapg, workplace, contents):
    before = contents()
    status, out, err = mapg("draw", "run")
    assert (status, out) == (2, "")
    assert err == "mapg: run is a run of pendulum, which draws nothing\n"
    assert contents() == before


def test_a_drive_is_drawn_from_its_start(mapg, tmp_path, monkeypatch):
    config = dataclasses.replace(oracles.RUN, env="driving", time_limit=20)
    folder = oracles.untrained_run(config, tmp_path / "run")
    drawn = []
    record = episode.record
    monkeypatch.setattr(episode, "record", lambda *a: drawn.append(record(*a)) or drawn[0])
    status, out, err = mapg("draw", "run", "--seed", 5)
    assert status == 0, err
    pictures = {path.split(".")[-1]: folder.path.parent / path for path in out.split()}
    assert pictures["png"].read_bytes()[1:4] == b"PNG"
    assert "<html" in pictures["html"].read_text()
    ((recorded,),) = drawn
    states = recorded.states
    (key,) = jax.random.split(jax.random.split(jax.random.key(5))[0], 1)
    start = jax.jit(config.make_env().reset)(key).pipeline_state
    assert (states.x.shape, recorded.actions.shape) == ((21,), (20, 3))
    assert (states.steps == range(21)).all()
    assert (states.x[0], states.y[0]) == (start.x, start.y)


def test_train_then_resume_then_evaluate(mapg, contents, tmp_path):
    status, out, err = mapg("train", *TINY.split(), "--out", "runs/mine")
    assert status == 0, err
    assert "step 400 of 400: return" in err
    assert "scoring the last policy: 3 episodes" in err
    assert "run folder:     runs/mine" in out
    assert "learning curve: runs/mine/curve.png" in out
    assert (tmp_path / "runs/mine/curve.png").read_bytes()[1:4] == b"PNG"
    folder = RunFolder.open("runs/mine")
    assert folder.config == Config(
        heads=3, steps=400, environments=4, replay_size=200, batch_size=8, hidden=(8, 8),
        learning_starts=16, time_limit=50, evaluate_every=200, evaluation_episodes=2,
        final_episodes=3,
    )  # fmt: skip
    assert json.loads(folder.evaluation.read_text())["episodes"] == 3

    before = contents()
    status, out, _ = mapg("resume", "runs/mine")
    assert status == 0
    assert "runs/mine is finished: 400 steps" in out
    status, out, err = mapg("resume", "runs/mine", "--steps", 100)
    assert (status, out) == (2, "")
    assert "runs/mine has 400 steps already, more than 100; --steps with a larger" in err
    assert contents() == before

    status, out, err = mapg("evaluate", "runs/mine", "--json", "--episodes", 5)
    assert status == 0, err
    record = json.loads(out)
    assert record == json.loads((folder.path / "evaluations/jax-uniform-5-s0.json").read_text())
    wanted = {"env", "physics", "select", "episodes", "mean", "std", "ci95", "returns"}
    assert wanted <= set(record)
    assert len(record["returns"]) == 5
    assert {path: contents()[path] for path in before} == before  # it stands beside
    status, out, _ = mapg("evaluate", "runs/mine", "--episodes", 5)
    assert status == 0
    assert f"{record['mean']:.1f}" in out


@pytest.mark.usefixtures("workplace")
def test_a_run_that_was_cut_off_before_its_score_is_scored(mapg, monkeypatch):
    """Ctrl-C while it is scored says how to go on."""
    with monkeypatch.context() as patch:
        patch.setattr(train, "finish", lambda folder: signal.raise_signal(signal.SIGINT))
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            status, out, err = mapg("resume", "run")
        finally:
            signal.signal(signal.SIGINT, before)
    assert status == 130
    assert "mapg: interrupted while scoring; go on with: mapg resume run" in err
    status, out, err = mapg("resume", "run")
    assert status == 0
    assert "scoring the last policy: 3 episodes" in err
    assert "learning curve: run/curve.png" in out
    assert RunFolder.open("run").scored_steps() == 800


@pytest.mark.slow
def test_a3c_trains_resumes_and_is_scored(mapg, contents):
    status, out, err = mapg("train", "--preset", "smoke", "--algorithm", "a3c")
    assert status == 0, err
    assert "run folder:     runs/pendulum-a3c-1" in out
    status, _, err = mapg("resume", "runs/pendulum-a3c-1", "--steps", 3_000)
    assert status == 0, err
    status, out, _ = mapg("evaluate", "runs/pendulum-a3c-1", "--select", "mean", "--json")
    assert status == 0
    record = json.loads(out)
    assert (record["select"], record["spread"], record["q_gap"]) == ("mean", 0, 0)
    before = contents()
    status, out, err = mapg("evaluate", "runs/pendulum-a3c-1", "--select", "argmax-q")
    assert (status, out) == (2, "")
    assert err == "mapg: select must be one of uniform, mean, got 'argmax-q'\n"
    assert contents() == before


def test_a_diverging_run_exits_1(mapg):
    status, out, err = mapg(
        "train", *TINY.split(), "--critic-learning-rate", "1e30", "--out", "run"
    )
    assert (status, out) == (1, "")
    assert "mapg: numbers are no longer finite at step 16 (critic_loss)" in err
    assert "Traceback" not in err


def test_environments_are_listed(mapg):
    status, out, _ = mapg("envs")
    assert status == 0
    for name in envs.names():
        spec = envs.spec(name)
        (line,) = (line for line in out.splitlines() if f" {name} " in line)
        for text in (*spec.engines, str(spec.time_limit), spec.gymnasium_id or ""):
            assert text in line


@pytest.mark.parametrize(
    ("name", "algorithm"), [(name, x) for x in ("mapg", "a3c") for name in presets_of(x)]
)
def test_a_preset_sets_the_defaults_that_help_shows(mapg, name, algorithm, monkeypatch):
    started = []
    monkeypatch.setattr(train, "begin", lambda config, *_: started.append(config) or 1 / 0)
    flags = ("--algorithm", algorithm)
    with pytest.raises(ZeroDivisionError):
        mapg("train", "--preset", name, *flags, "--seed", 3)
    with pytest.raises(ZeroDivisionError):
        mapg("train", f"--preset={name}", "--env", "hopper", *flags)
    expected = preset(name, algorithm)
    assert started == [
        dataclasses.replace(expected, seed=3),
        dataclasses.replace(expected, env="hopper"),
    ]
    status, out, err = mapg("train", "--preset", name, *flags, "--help")
    assert status == 0
    shown = " ".join((out + err).split())
    for field in ("environments", "evaluate_every", "critic_learning_rate"):
        assert f"(default: {getattr(expected, field)})" in shown
    for field in fields(type(expected)):
        assert f"--{field.replace('_', '-')} " in shown


def test_help_imports_nothing_slow():
    """In a process of its own."""
    code = (
        "import sys; from mapg_jax.cli.main import main; sys.argv = ['mapg', '--help']; main(); "
        "print([m for m in ('jax', 'numpy', 'flax', 'brax', 'mujoco', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *shown, imported = done.stdout.splitlines()
    assert imported == "[]"
    for name in COMMANDS:
        assert any(line.startswith(f"  {name} ") for line in shown)


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
    file = folder.path / "evaluations" / "gymnasium-uniform-4-s0.json"
    assert record == json.loads(file.read_text())


@pytest.mark.mjx
def test_a_smoke_run_on_mjx(mapg, tmp_path, their_code):
    command = "train --env hopper --engine mjx --preset smoke --out run"
    status, out, err = mapg(*command.split())
    assert status == 0, err
    assert "run folder:     run" in out
    record = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert (record["physics"], record["episodes"]) == ("mjx", 4)
