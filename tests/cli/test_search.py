"""mapg search: what is asked is trained, what falls behind is pruned, the best is a command."""

import json
import shlex
from typing import ClassVar

import pytest

from mapg_jax.cli import fields, search, train
from mapg_jax.runs.folder import RunFolder, is_blank
from mapg_jax.runs.metrics import MetricsFile
from mapg_jax.sweeps import search as module
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
    study = module.SearchFolder.open(tmp_path / "here").study()
    under_way = study.ask()  # as of a process that was killed
    under_way.suggest_float("discount", 0.5, 0.9)
    record = json.loads((tmp_path / "here" / "search.json").read_text())
    (tmp_path / "here" / "search.json").write_text(json.dumps({**record, "trials": 4}))
    fake.begun.clear()
    assert mapg("resume", "here")[0] == 0
    assert [job.path.name for job in fake.begun] == ["trial-2", "trial-3"]
    assert fake.begun[0].config.discount == under_way.params["discount"]
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
    ],
)
def test_wrong_input_is_one_line(space, message, mapg, contents):
    status, out, err = mapg(*FLAGS.split(), *space.split())
    assert (status, out) == (2, "") and message in err and err.count("\n") == 1
    assert not contents()


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
