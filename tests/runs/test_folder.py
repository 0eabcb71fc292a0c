"""The folder of a run: written down before it starts, data only, of one format."""

import dataclasses
import json
import pathlib

import jax
import oracles
import pytest

from mapg_jax.runs.folder import FORMAT, RunFolder, create_folder
from mapg_jax.runs.train import begin
from mapg_jax.training.config import Config, preset, presets_of


def test_the_folder_is_there_before_anything_is_compiled(tmp_path):
    run = begin(oracles.RUN, tmp_path / "run")
    assert RunFolder.open(tmp_path / "run").config == oracles.RUN
    assert not {"jitted_init", "jitted_run"} & set(vars(run.trainer))
    assert not run.folder.metrics.exists()


@pytest.mark.parametrize(
    ("name", "algorithm"), [(name, x) for x in ("mapg", "a3c") for name in presets_of(x)]
)
def test_presets_survive_the_folder(name, algorithm, tmp_path):
    changes = {"env_options": ("g=9.81", "name=a"), "max_gradient_norm": 0.1, "time_limit": 3}
    config = preset(name, algorithm, **changes)
    folder = RunFolder.create(tmp_path / "new" / "run", config)
    assert RunFolder.open(folder.path).config == config
    record = json.loads((folder.path / "config.json").read_text())
    (process,) = record["history"]
    assert process["packages"]["jax"] == jax.__version__
    assert [path.name for path in folder.path.iterdir()] == ["config.json"]


def test_folders_are_numbered_by_environment_and_algorithm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = dataclasses.replace(oracles.RUN, env="brax:ant")
    names = [RunFolder.create(None, config).path for _ in range(2)]
    assert names == [pathlib.Path(f"runs/brax-ant-mapg-m3-{n}") for n in (1, 2)]
    for changes, name in (
        ({"heads": 1}, "pendulum-ddpg-1"),
        ({"algorithm": "a3c"}, "pendulum-a3c-1"),
    ):
        assert RunFolder.create(None, Config(**changes)).path == pathlib.Path("runs") / name


def test_a_run_folder_holds_data_only(finished_run):
    kinds = {path.suffix for path in finished_run.path.rglob("*") if path.is_file()}
    assert not kinds & {".py", ".pkl", ".pickle", ".npy", ".npz", ".so", ".sh"}
    assert (finished_run.path / "config.json").is_file()
    names = {path.name.split(".")[0] for path in finished_run.path.iterdir()} - {""}  # .lock
    assert names == {"config", "metrics", "checkpoints", "events"}


@pytest.mark.parametrize("found", [1, FORMAT + 1])
def test_a_folder_of_another_format_is_refused_in_one_line_that_names_it(found, tmp_path):
    """Format 1 wrote no number, and all fields of all algorithms."""
    file = RunFolder.create(tmp_path / "run", oracles.RUN).path / "config.json"
    record = json.loads(file.read_text())
    del record["format"]
    if found != 1:
        record["format"] = found
    file.write_text(json.dumps(record))
    message = f"run is a run folder of format {found}, and this version reads format {FORMAT}"
    with pytest.raises(ValueError, match=message) as error:
        RunFolder.open(tmp_path / "run")
    assert "\n" not in str(error.value)


def test_a_folder_that_cannot_be_created_leaves_no_parents(tmp_path):
    (tmp_path / "file").touch()
    for path in ("file/run", "new/" + 300 * "x"):
        with pytest.raises(ValueError, match="cannot be created: "):
            create_folder(tmp_path / path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
