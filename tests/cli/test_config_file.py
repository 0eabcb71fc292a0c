"""Flags from YAML files: what is printed is read again, and the command line wins."""

import pytest

from mapg_jax.cli import config_file, fields, sweep, train
from mapg_jax.training.config import preset


@pytest.mark.parametrize(
    ("algorithm", "changes"),
    [
        ("mapg", {"hidden": (8, 8, 8), "normalize": False, "time_limit": None}),
        ("mapg", {"env": "driving", "env_options": ("control_hz=10", "lookahead=(20, 50)")}),
        ("td3", {"heads": 3, "save_replay": False}),
        ("ppo", {"rollout_steps": 64}),
    ],
)
def test_what_is_printed_is_read_again(algorithm, changes, tmp_path):
    config = preset("smoke", algorithm, **changes)
    file = tmp_path / "run.yaml"
    file.write_text(config_file.dump(config))
    arguments = train.parse(["--config", str(file)])
    assert preset("paper", **fields.given(arguments)) == config


def test_the_command_line_wins(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text("preset: smoke\nheads: 2\nenv_options: {track: speedway}\nout: there\n")
    arguments = train.parse(["--heads", "5", "--config", str(file), "--steps=70"])
    assert (arguments.heads, arguments.steps, arguments.preset) == (5, 70, "smoke")
    assert (arguments.env_options, str(arguments.out)) == (("track=speedway",), "there")


def test_none_and_lists_are_as_yaml_has_them(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text(
        "out: null\ntime_limit: null\nhidden: [8, 8]\nenv: driving\nenv_options:\n"
        "  {off_track_end: null, lookahead: [20, 50], track: [town, eight], start: line}\n"
    )
    arguments = train.parse(["--config", str(file)])
    assert (arguments.out, arguments.time_limit, arguments.hidden) == (None, None, (8, 8))
    config = preset("paper", **fields.given(arguments))
    assert config.parsed_env_options() == {
        "off_track_end": None, "lookahead": [20, 50], "track": ["town", "eight"], "start": "line"
    }  # fmt: skip
    assert config.make_env().observation_size == 31


def test_lists_of_a_sweep_are_values_of_its_runs(tmp_path):
    file = tmp_path / "sweep.yaml"
    file.write_text("hidden: [[8, 8], [4, 4]]\nenv_options: [{g: 1, a: [2, 3]}, {g: null}]\n")
    arguments = sweep.parse(["--config", str(file), "--out", "there"])
    assert arguments.hidden == [(8, 8), (4, 4)]
    assert arguments.env_options == [("g=1", "a=[2,3]"), ("g=none",)]


def test_a_file_of_a_sweep_lists_its_values(tmp_path):
    file = tmp_path / "sweep.yaml"
    file.write_text(
        "heads: [1, 10]\nnormalize: [true, false]\nkeep_replay: true\nno-measure: true\n"
    )
    arguments = sweep.parse(["--config", str(file), "--out", "there"])
    assert (arguments.heads, arguments.normalize) == ([1, 10], [True, False])
    assert (arguments.keep_replay, arguments.measure) == (True, False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read: No such file"),
        ("a: [", "cannot be read: while parsing"),
        ("- heads", "must hold flags and values, as in steps: 100000"),
        ("!!python/object/apply:os.system ['true']", "cannot be read: could not determine"),
        ("haeds: 3", "did you mean --heads"),
        ("heads: many", "must be a whole number, got 'many'"),
        ("rollout_steps: 3", "is an option of"),
        ("config: other.yaml", "no file can; give both: --config"),
        ("env_options: {gravity: 1}", "pendulum has no option 'gravity'"),
    ],
)
def test_other_files_are_refused_in_a_line(text, message, mapg, contents, tmp_path):
    file = tmp_path / "file.yaml"
    if text is not None:
        file.write_text(text)
    status, out, err = mapg("train", "--config", str(file))
    assert (status, out) == (2, "")
    assert message in err and err.count("\n") == 1


def test_print_config_trains_nothing(mapg, contents):
    status, out, _ = mapg("train", "--preset", "smoke", "--print-config")
    assert status == 0 and "env: pendulum\n" in out and "hidden:\n- 16\n" in out
    assert not contents()
