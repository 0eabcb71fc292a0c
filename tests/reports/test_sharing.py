"""Policies given to others and taken from them: what comes back is what was given, or nothing."""

import json
import pathlib
import sys
import types

import numpy as np
import oracles
import pytest
import yaml

from mapg_jax.reports import sharing
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import load_policy
from mapg_jax.runs.scoring import evaluate

OBSERVATIONS = np.random.default_rng(0).normal(size=(5, 3))


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """A run with a policy, a score of it, and a video."""
    path = tmp_path_factory.mktemp("scored") / "run"
    folder = oracles.untrained_run(oracles.RUN, path)
    evaluate(folder)
    (path / "video.gif").write_bytes(b"GIF89a")
    return folder


def test_what_is_pulled_is_what_was_pushed(scored, tmp_path):
    hub = str(tmp_path / "hub" / "mine")
    assert sharing.push(scored.path, hub) == hub
    assert sharing.pull(hub, tmp_path / "got") == tmp_path / "got"
    got, given = (load_policy(path) for path in (tmp_path / "got", scored.path))
    both = got.proposals(OBSERVATIONS), given.proposals(OBSERVATIONS)
    for theirs, ours in zip(*both, strict=True):
        np.testing.assert_array_equal(theirs, ours)
    assert evaluate(RunFolder.open(tmp_path / "got")) == evaluate(scored)
    names = {path.name for path in (tmp_path / "got").iterdir()}
    assert names >= {"README.md", "config.json", "evaluation.json", "video.gif", "checkpoints"}
    (step,) = (tmp_path / "got" / "checkpoints").iterdir()
    assert not (step / "rest").exists()  # what training alone needs
    for file in filter(pathlib.Path.is_file, (tmp_path / "got").rglob("*")):
        assert str(scored.path).encode() not in file.read_bytes()


def test_the_card_says_what_the_files_say(scored, tmp_path):
    sharing.bundle(scored.path, tmp_path / "out")
    card = (tmp_path / "out" / "README.md").read_text()
    _, front, text = card.split("---\n", 2)
    score = json.loads(scored.evaluation.read_text())
    head = yaml.safe_load(front)
    (model,) = head["model-index"]
    (metric,) = model["results"][0]["metrics"]
    assert metric == {"type": "mean_reward", "value": round(score["mean"], 3)}
    assert (head["library_name"], head["license"]) == ("mapg-jax", "apache-2.0")
    low, high = score["ci95"]
    assert f"{low:,.1f} to {high:,.1f}" in text and f"| episodes | {score['episodes']} |" in text
    assert "![Episodes](video.gif)" in text and "mapg" in text.split("## Made by")[1]
    assert f"- stopped at {score['env_steps']} of {oracles.RUN.steps} steps" in text


def test_what_cannot_be_given_is_named_and_nothing_is_left(scored, tmp_path):
    unscored = oracles.copy_run(scored, tmp_path / "unscored")
    unscored.evaluation.unlink()
    with pytest.raises(ValueError, match=r"has no score yet: mapg evaluate .*unscored"):
        sharing.push(unscored.path, str(tmp_path / "hub"))
    assert not (tmp_path / "hub").exists()
    (tmp_path / "hub").mkdir()
    (tmp_path / "hub" / "mine").write_text("kept")
    with pytest.raises(ValueError, match="exists already"):
        sharing.push(scored.path, str(tmp_path / "hub"))
    assert [file.name for file in (tmp_path / "hub").iterdir()] == ["mine"]


def test_what_is_no_policy_is_not_taken(scored, tmp_path):
    with pytest.raises(ValueError, match="there is no folder"):
        sharing.pull(str(tmp_path / "none"), tmp_path / "out")
    sharing.bundle(scored.path, tmp_path / "hub")
    (tmp_path / "outside").write_text("theirs")
    (tmp_path / "hub" / "curve.png").unlink(missing_ok=True)
    (tmp_path / "hub" / "curve.png").symlink_to(tmp_path / "outside")
    with pytest.raises(ValueError, match="is a link"):
        sharing.pull(str(tmp_path / "hub"), tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="is not a run folder"):
        sharing.pull(str(tmp_path / "empty"), tmp_path / "out")
    assert not (tmp_path / "out").exists() and (tmp_path / "outside").read_text() == "theirs"


def test_the_hugging_face_hub_is_asked_as_it_wants(scored, tmp_path, monkeypatch):
    """Its functions are replaced: nothing is sent."""
    kept = tmp_path / "kept"

    class HfApi:
        def create_repo(self, name, exist_ok):
            assert (name, exist_ok) == ("me/mine", True)
            return "the address of me/mine"

        def upload_folder(self, repo_id, folder_path):
            sharing.SharedFolder().send(pathlib.Path(folder_path), str(kept))

    def snapshot_download(name, local_dir):
        if name != "me/mine":
            raise OSError("404: there is none\nand more")
        sharing.SharedFolder().fetch(str(kept), local_dir)

    fake = types.SimpleNamespace(HfApi=HfApi, snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    assert sharing.push(scored.path, "me/mine") == "the address of me/mine"
    assert sharing.pull("me/mine", tmp_path / "got") == tmp_path / "got"
    assert evaluate(RunFolder.open(tmp_path / "got")) == evaluate(scored)
    with pytest.raises(ValueError, match=r"^me/other: 404: there is none$"):
        sharing.pull("me/other", tmp_path / "other")
    assert not (tmp_path / "other").exists()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ValueError, match=r"pip install 'mapg-jax\[hub\]'"):
        sharing.pull("me/mine", tmp_path / "again")
