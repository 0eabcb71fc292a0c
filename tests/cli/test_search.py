"""mapg search: what is asked is trained, what falls behind is pruned, the best is a command."""

import json
import shlex
import shutil
import sys
from typing import ClassVar

import pytest

from mapg_jax.cli import fields, search, train
from mapg_jax.runs import disk
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.runs.metrics import MetricsFile
from mapg_jax.sweeps import search as module
from mapg_jax.training import plugins
from mapg_jax.training.config import preset

FLAGS = "search --preset smoke --heads 2 --workers 1 --out here --space"


class FakeWorker:
    """Scores a run by its discount at once: at 100, 200, … steps, and at the end."""

    begun: ClassVar[list] = []
    ends = True

    def __init__(self, group, share, keep_replay, launcher):
        (job,) = group
        new = is_blank(job.path)
        self.folder = RunFolder.create(job.path, job.config) if new else RunFolder.open(job.path)
        self.begun.append(job)
        self.stopped = self.done = False

    def running(self):
        if self.done or self.stopped:
            return False
        rows = MetricsFile(self.folder.metrics)
        for step in (100, 200):
            rows.write({"env_steps": step, "return_mean": self.folder.config.discount})
        rows.close()
        self.done = True
        return True  # it is seen with its rows before it ends

    def stop(self):
        self.stopped = True

    def wait(self):
        if not self.stopped:
            record = {"mean": self.folder.config.discount}
            self.folder.evaluation.write_text(json.dumps(record))

    def failures(self):
        return {self.folder.path: "stopped"} if self.stopped else {}


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(module, "Worker", FakeWorker)
    monkeypatch.setattr(module, "POLL_SECONDS", 0.0)
    monkeypatch.setattr(FakeWorker, "begun", [])
    return FakeWorker


def test_the_best_trial_is_printed_as_a_command(fake, mapg, tmp_path):
    status, out, err = mapg(*f"{FLAGS} discount=0.5..0.99 batch_size=8,16 --trials 12".split())
    assert status == 0
    configs = [job.config for job in fake.begun]
    assert len(configs) == 12 and all(0.5 <= c.discount <= 0.99 for c in configs)
    assert {c.batch_size for c in configs} == {8, 16}
    assert err.count("pruned") >= 1  # once four have ended, what is below their median
    best = max(configs, key=lambda config: config.discount)
    line = next(line for line in out.splitlines() if line.startswith("mapg train"))
    arguments = train.parse(shlex.split(line)[2:])
    assert preset(arguments.preset, **fields.given(arguments)) == best


def test_a_search_goes_on_with_what_it_had(fake, mapg, tmp_path):
    assert mapg(*f"{FLAGS} discount=0.5..0.9 --trials 2".split())[0] == 0
    first = [job.config.discount for job in fake.begun]
    study = module.SearchFolder.open(tmp_path / "here").study()
    under_way = study.ask()  # as of a process that was killed
    under_way.suggest_float("discount", 0.5, 0.9)
    record = json.loads((tmp_path / "here" / "search.json").read_text())
    (tmp_path / "here" / "search.json").write_text(json.dumps({**record, "trials": 4}))
    fake.begun.clear()
    assert mapg("resume", "here")[0] == 0
    assert [job.path.name for job in fake.begun] == ["trial-2", "trial-3"]
    assert fake.begun[0].config.discount == under_way.params["discount"]
    assert len({*first, *(job.config.discount for job in fake.begun)}) == 4  # none twice
    assert mapg("resume", "here", "--steps", "9")[0] == 2


def test_values_that_are_lists_stand_in_brackets():
    config = preset("smoke")
    for text in ("hidden=[8,8],[4,4]", "hidden=[[8,8],[4,4]]"):
        name, dimension = search._dimension(config, text)
        assert (name, dimension.choices) == ("hidden", ((8, 8), (4, 4)))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("discount", "a space is written NAME=LOW..HIGH or NAME=A,B,C, got 'discount'"),
        ("gamma=0..1", "gamma is no option of a run"),
        ("rollout_steps=1..9", "is an option of"),
        ("discount=0.9..0.5", "0.9..0.5 is no range of numbers, low..high"),
        ("discount=log:0..0.5", "is no range of numbers above 0"),
        ("discount=cubic:0.1..0.5", "cubic is no scale"),
        ("discount=0.5..2", "discount must be"),
        ("batch_size=8,many", "must be a whole number, got 'many'"),
        ("heads=1,2", "heads is given and looked for"),
        ("discount=0.5..0.9 --trials 0", "trials must be at least 1, got 0"),
        ("discount=0.1..0.2 discount=0.3,0.4", "--space names discount twice"),
        ("discount=0.5..0.9 --workers 0", "workers must be at least 1, got 0"),
        ("discount=0.5..0.9 --launcher slurm --workers -1", "workers must be at least 1, got -1"),
        ("discount=0.5..0.9 --launcher-options a=1", "the launcher local has no options"),
        ("discount=0.5..0.9 --env nonsense", "unknown environment 'nonsense'"),
        ("env_options=a=1", "pendulum has no option 'a'"),
        ("engine=jax,foo", "pendulum has no engine 'foo'"),
        ("replay_size=2000000000,100", "do not fit"),
    ],
)
def test_wrong_input_is_one_line(space, message, mapg, contents):
    status, out, err = mapg(*FLAGS.split(), *space.split())
    assert (status, out) == (2, "") and message in err and err.count("\n") == 1
    assert not contents()


def test_a_full_disk_is_refused(mapg, contents, monkeypatch):
    monkeypatch.setattr(disk, "free_bytes", lambda path: 1_000_000)
    status, _, err = mapg(*FLAGS.split(), "discount=0.5..0.9")
    assert status == 2 and "has 1.0 MB left" in err
    assert not contents()


def test_values_that_do_not_go_together_are_left_out(fake, mapg):
    flags = f"{FLAGS} batch_size=64,16 replay_size=32,100 --trials 12"
    status, out, err = mapg(*flags.split())
    assert status == 0 and "best of 12 trials" in out
    left_out = err.count("left out: a batch of 64 is larger than the replay of 32\n")
    assert left_out and left_out + len(fake.begun) == 12
    assert {(c.batch_size, c.replay_size) for c in (job.config for job in fake.begun)} == {
        (64, 100), (16, 32), (16, 100),
    }  # fmt: skip
    assert mapg("resume", "here")[:2] == (0, out)
    assert left_out + len(fake.begun) == 12


def test_if_no_values_go_together_it_says_so(fake, mapg):
    status, out, err = mapg(*f"{FLAGS} batch_size=64 replay_size=32 --trials 2".split())
    assert (status, out, fake.begun) == (1, "", [])
    assert err.splitlines()[-1] == "mapg: none of the 2 trials of here has a score"


def test_memory_is_asked_for_the_largest_run(tmp_path):
    def largest(**space):
        axes = {name: module.Dimension(several) for name, several in space.items()}
        return module._largest(module.SearchFolder(tmp_path, "smoke", {}, space=axes, trials=1))

    wide = largest(hidden=((64, 64), (8, 8)), replay_size=(5000, 100))  # the last are not largest
    assert (wide.hidden, wide.replay_size) == ((64, 64), 5000)
    apart = largest(batch_size=(64, 16), replay_size=(32, 40))  # which do not go together
    assert (apart.batch_size, apart.replay_size) == (64, preset("smoke").replay_size)


@pytest.mark.parametrize(
    "damage",
    [
        {"launcher": "foo"},
        {"workers": "x"},
        {"trials": "x"},
        {"launcher_options": [1]},
        {"values": {"heads": 0}},
        {"space": {"discount": {"low": 0.9, "high": 0.5}}},
        {"space": {"discount": 5}},
    ],
)
def test_a_damaged_search_is_named(damage, mapg, tmp_path):
    axes = {"discount": module.Dimension((), 0.5, 0.9)}
    folder = module.SearchFolder(tmp_path / "here", "smoke", {"heads": 2}, space=axes, trials=3)
    folder.create()
    assert module.SearchFolder.open(folder.path) == folder
    file = folder.path / "search.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **damage}))
    status, out, err = mapg("resume", "here")
    assert (status, out) == (2, "")
    assert err.startswith("mapg: here/search.json is damaged: ") and err.count("\n") == 1


def test_a_torn_line_of_the_journal_is_cut_off(fake, mapg, tmp_path):
    _, out, _ = mapg(*f"{FLAGS} discount=0.5..0.9 --trials 2".split())
    journal = tmp_path / "here" / "study.journal"
    whole = journal.read_text()
    journal.write_text(f'{whole}{{"op_co')
    for _ in range(2):  # what is written behind it can be read
        assert mapg("resume", "here")[:2] == (0, out)
    assert journal.read_text().startswith(whole) and len(fake.begun) == 2
    journal.write_text(f'{{"op_co\n{whole}')
    status, _, err = mapg("resume", "here")
    assert status == 2 and err.startswith("mapg: here/study.journal is damaged: ")


def test_the_best_run_needs_no_folder(fake, mapg, tmp_path):
    _, out, _ = mapg(*f"{FLAGS} discount=0.5..0.9 hidden=[8,8],[4,4] --trials 2".split())
    for folder in (tmp_path / "here").glob("trial-*"):
        shutil.rmtree(folder)
    assert mapg("resume", "here")[:2] == (0, out)


def test_the_command_imports_what_the_search_did(fake, mapg, tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "_loaded", [])
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "nothing_of_ours.py").touch()
    flags = f"{FLAGS} discount=0.5..0.9 --trials 1 --import nothing_of_ours"
    _, out, _ = mapg(*flags.split())
    line = next(line for line in out.splitlines() if line.startswith("mapg train"))
    assert train.parse(shlex.split(line)[2:]).imports == ["nothing_of_ours"]


def test_without_optuna_it_says_what_to_install(mapg, contents, monkeypatch):
    monkeypatch.setattr(search.importlib.util, "find_spec", lambda name: None)
    status, _, err = mapg(*FLAGS.split(), "discount=0.5..0.9")
    assert status == 2 and "pip install 'mapg-jax[search]'" in err
    assert not contents()


@pytest.mark.slow
def test_a_search_trains_its_trials(mapg, tmp_path):
    flags = f"{FLAGS} actor_learning_rate=log:1e-5..1e-2 --steps 400 --trials 2"
    status, out, _ = mapg(*flags.split())
    assert status == 0 and "best of 2 trials" in out
    assert (tmp_path / "here" / "trial-1" / "evaluation.json").exists()
