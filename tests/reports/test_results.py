"""Finished runs as records, told apart where they may not be averaged."""

import dataclasses
import json
import math
import shlex
import shutil

import numpy as np
import oracles
import pytest

import mapg_jax
from mapg_jax.algorithms import registry
from mapg_jax.reports.results import (
    COLUMNS,
    HOST,
    UnfinishedError,
    find_runs,
    merge,
    read_curve,
    read_run,
    run_key,
    separate,
    settings,
    sort_settings,
)
from mapg_jax.reports.results_csv import append_csv, read_csv
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.sealing import write_score
from mapg_jax.training.config import Config, preset, presets_of

RESULT = oracles.result()


def test_a_run_is_read_as_it_was_written(tmp_path):
    config = Config(env="hopper", heads=1, seed=7, steps=1000, noise="none")
    folder = oracles.finished_run(config, tmp_path / "run", [1.0, 2.0, 6.0])
    record = json.loads((folder.path / "config.json").read_text())
    result = read_run(folder)
    assert result[:8] == ("hopper", "ddpg", 1, 7, 1008, 3.0, math.sqrt(7), 3)
    assert result.settings == "noise=none"
    assert (result.select, result.physics, result.seconds) == ("uniform", "native", 12.5)
    packages = record["history"][0]["packages"]
    assert result.versions == f"gymnasium {packages['gymnasium']}, mujoco {packages['mujoco']}"
    assert (result.date, result.command) == tuple(
        record["history"][0][name] for name in ("date", "command")
    )
    assert result.metrics == {}


def test_a_run_that_was_trained_and_scored_is_read(finished_run, tmp_path):
    with pytest.raises(UnfinishedError, match=r"it has no evaluation\.json"):
        read_run(finished_run)
    path = shutil.copytree(finished_run.path, tmp_path / "run")
    score = mapg_jax.evaluate(path)
    result = read_run(path)
    assert result.return_mean == score["mean"]
    assert result.return_std == score["std"]
    assert result[:5] == ("pendulum", "mapg", 3, oracles.RUN.seed, 800)
    assert (result.episodes, result.select, result.physics) == (3, "uniform", "jax")
    assert result.seconds > 0


def test_driving_has_distance_and_laps(tmp_path):
    metrics = {"distance": [100.0, 300.0, 500.0, 700.0], "laps": [0.0, 1.0, 0.5, 2.0]}
    config = Config(env="driving", steps=1000)
    folder = oracles.finished_run(config, tmp_path / "run", [1.0] * 4, metrics=metrics)
    result = read_run(folder)
    assert result.metrics == {"distance_mean": 400.0, "laps_mean": 0.875, "lap_share": 0.5}


def test_runs_of_earlier_versions_are_read(tmp_path):
    """Fields that came later have the default; a run without dates has its evaluation's."""
    config = Config(env="hopper", steps=1000, noise="none")
    folder = oracles.finished_run(config, tmp_path / "run", [1.0, 2.0])
    file = folder.path / "config.json"
    record = json.loads(file.read_text())
    del record["config"]["truncation"], record["config"]["checkpoints_kept"]
    del record["history"][0]["date"]
    file.write_text(json.dumps(record))
    result = read_run(folder.path)
    assert RunFolder.open(folder.path).config == config
    assert result.settings == "noise=none"
    assert len(result.date.split("-")) == 3


def test_settings_are_what_differs_from_the_paper():
    assert settings(Config(env="hopper", heads=3, seed=9, steps=5)) == ""
    assert settings(Config(evaluate_every=7, checkpoints_kept=1, final_episodes=3)) == ""
    options = ("track=a b", "control_hz=10")
    config = Config(hidden=(64, 32), env_options=options, noise="none", max_gradient_norm=0.5)
    text = "'env_options=control_hz=10,track=a b' hidden=64,32 max_gradient_norm=0.5 noise=none"
    assert settings(config) == text
    assert settings(dataclasses.replace(config, env_options=options[::-1])) == text


def test_unfinished_runs_are_told_from_damaged_ones(tmp_path):
    config = Config(env="hopper", steps=1000)
    folder = RunFolder.create(tmp_path / "fresh", config)
    with pytest.raises(UnfinishedError, match=r"it has no evaluation\.json"):
        read_run(folder)
    folder = oracles.finished_run(config, tmp_path / "run", [1.0, 2.0])
    longer = dataclasses.replace(config, steps=3000)
    with pytest.raises(UnfinishedError, match="1,008 of 3,000 steps"):
        read_run(RunFolder(folder.path, longer))


def test_the_score_of_an_earlier_policy_is_none_of_the_run(tmp_path):
    """A policy can be scored while the run goes on, or after a crash."""
    folder = oracles.finished_run(Config(env="hopper", steps=1000), tmp_path / "run", [1.0, 2.0])
    record = json.loads(folder.evaluation.read_text())
    del record["seal"]
    write_score(folder, {**record, "env_steps": 992})
    with pytest.raises(UnfinishedError, match="its score is of step 992"):
        read_run(folder)
    write_score(folder, {**record, "env_steps": 1008})
    assert read_run(folder).return_mean == 1.5


DAMAGE = [
    ("evaluation.json", "{", "evaluation.json is damaged"),
    ("evaluation.json", "[]", "evaluation.json is damaged"),
    ("evaluation.json", '{"mean": 1}', "evaluation.json is damaged: it lacks 'std'"),
    ("evaluation.json", '{"mean": NaN}', "evaluation.json is damaged: nan is not finite"),
    ("metrics.csv", "", "metrics.csv is damaged: it has no rows"),
    ("metrics.csv", "env_steps,seconds\n1008\n", "metrics.csv is damaged"),
    ("metrics.csv", "env_steps,seconds\n1008,x\n", "metrics.csv is damaged"),
    ("config.json", "[]", "config.json is damaged"),
    ("config.json", '{"config": {}}', "config.json is damaged: it lacks 'history'"),
    ("config.json", '{"config": {}, "history": []}', "config.json is damaged"),
]


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("evaluation.json", '"mean": 1.5', '"mean": 1.6'),
        ("config.json", '"tau": 0.01', '"tau": 0.02'),
        ("metrics.csv", "0.375", "0.376"),
    ],
)
def test_a_digit_that_was_changed_is_not_taken_as_true(name, old, new, tmp_path):
    folder = oracles.finished_run(Config(env="hopper", steps=1000), tmp_path / "run", [1.0, 2.0])
    file = folder.path / name
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"{name} is damaged: it is not"):
        read_run(folder.path)


@pytest.mark.parametrize(("name", "text", "message"), DAMAGE)
def test_damaged_files_are_named(name, text, message, tmp_path):
    folder = oracles.finished_run(Config(env="hopper", steps=1000), tmp_path / "run", [1.0, 2.0])
    (folder.path / name).write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_run(folder)
    assert not isinstance(error.value, UnfinishedError)


def test_runs_are_found_at_any_depth(tmp_path):
    config = Config(env="hopper", steps=1000)
    names = ("a", "b/c", "b/d/e")
    for name in names:
        RunFolder.create(tmp_path / name, config)
    (tmp_path / "empty").mkdir()
    assert [run.path for run in find_runs(tmp_path)] == [tmp_path / name for name in names]
    assert [run.path for run in find_runs(tmp_path / "a")] == [tmp_path / "a"]
    for path, message in (("nowhere", "there is no"), ("empty", "there are no runs in")):
        with pytest.raises(ValueError, match=message):
            find_runs(tmp_path / path)


def test_a_csv_reads_back_equal(tmp_path):
    path = tmp_path / "new" / "results.csv"
    results = [
        RESULT._replace(return_mean=0.1 + 0.2, command='a "b", c\nd'),
        RESULT._replace(seed=1, settings="'env_options=track=a b'", metrics={"laps_mean": 1 / 3}),
    ]
    append_csv(path, results[:1])
    append_csv(path, results)
    assert read_csv(path) == results
    assert path.read_text().splitlines()[0] == ",".join([*COLUMNS, "laps_mean"])
    assert read_csv(tmp_path / "none.csv") == []


def test_rows_that_say_nothing_of_their_machine_are_read_beside_others(tmp_path):
    path = tmp_path / "results.csv"
    older = [RESULT._replace(metrics={"laps_mean": 0.5})]
    values = [str(getattr(RESULT, name)) for name in OLDER]
    path.write_text(f"{HEADER}\n" + ",".join([*(f'"{value}"' for value in values), "0.5"]) + "\n")
    assert read_csv(path) == older
    newer = RESULT._replace(seed=2000, processor="A", commit="1a2b", threads="1", engine="native")
    append_csv(path, [newer])
    assert read_csv(path) == [*older, newer]


def test_a_row_names_every_machine_that_trained_the_run(tmp_path):
    folder = oracles.finished_run(Config(env="hopper", steps=1000), tmp_path / "run", [1.0, 2.0])
    for processor in ("A", "B", "B"):
        folder.write_config()
        folder.write_host({"processor": processor, "threads": "1", "commit": ""})
    result = read_run(folder)
    assert (result.processor, result.threads, result.commit) == ("A; B", "1", "")


def test_a_row_with_another_score_is_refused_whole(tmp_path):
    path = tmp_path / "results.csv"
    append_csv(path, [RESULT])
    before = path.read_bytes()
    with pytest.raises(ValueError, match="two runs of hopper, mapg, M = 10, seed 0, 1,000 steps"):
        append_csv(path, [RESULT._replace(seed=1), RESULT._replace(return_mean=8.0)])
    assert path.read_bytes() == before
    append_csv(path, [RESULT._replace(seconds=1.0, date="2030-01-01")])  # the same run again
    assert path.read_bytes() == before


OLDER = [name for name in COLUMNS if name not in HOST]
HEADER = ",".join([*OLDER, "laps_mean"])
BAD_ROWS = [
    ("a,b\n1,2\n", "is no CSV of results: its columns are a,b"),
    ("", "is no CSV of results"),
    (f"{HEADER}\nhopper,mapg\n", "row 2 has 2 cells, not 16"),
    (
        f"{HEADER}\n" + ",".join(["1"] * 4 + ["many"] + ["1"] * 11),
        "row 2: steps is no number: 'many'",
    ),
    (
        f"{HEADER}\n" + ",".join(["1"] * 5 + ["nan"] + ["1"] * 10),
        "row 2: return_mean is no number: 'nan'",
    ),
    (f"{HEADER}\n" + ",".join(["1"] * 15 + ["two"]), "row 2: laps_mean is no number: 'two'"),
    (f"{HEADER}\n" + ",".join(["1"] * 16), "row 2: no algorithm with M = 1 is called '1'"),
    ('"a', "is no CSV"),
]


@pytest.mark.parametrize(("text", "message"), BAD_ROWS)
def test_a_bad_csv_is_refused(text, message, tmp_path):
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_csv(path)


def test_mixed_protocols_are_apart_and_arms_of_one_together():
    arms = [
        RESULT,
        RESULT._replace(algorithm="ddpg", heads=1),
        RESULT._replace(settings="gradient=all noise=none target=sampled"),
        RESULT._replace(env="walker2d", seed=3),
    ]
    others = [
        RESULT._replace(steps=2000),
        RESULT._replace(settings="batch_size=8 noise=none"),
        RESULT._replace(select="mean"),
        RESULT._replace(physics="mjx"),
        RESULT._replace(episodes=10),
        RESULT._replace(versions="gymnasium 2.0"),
    ]
    assert list(separate(arms + others).values()) == [arms, *([other] for other in others)]
    assert sort_settings(others[1]) == ("paper", "batch_size=8", "noise=none")


@pytest.mark.parametrize(
    ("name", "algorithm"), [(name, x) for x in ("mapg", "a3c") for name in presets_of(x)]
)
def test_settings_are_told_from_the_nearest_preset(name, algorithm):
    def sorted_settings(**changes):
        config = preset(name, algorithm, **changes)
        return sort_settings(RESULT._replace(**run_key(config)._asdict()))

    found = sorted_settings(steps=7, evaluation_episodes=3)
    if name == "diverse":  # the paper's, but for options of the algorithm's own
        options = registry.find(algorithm)
        theirs = {
            k: v
            for k, v in options.presets.get(name, {}).items()
            if v != getattr(options.Options, k)
        }
        assert found[:2] == ("paper", "")
        assert len(shlex.split(found.own)) == len(theirs)
        return
    assert found == (name, "", "")
    changes = {"discount": 0.9, "critic_learning_rate": 0.5}
    assert sorted_settings(**changes) == (name, "discount=0.9", "critic_learning_rate=0.5")
    assert sorted_settings(hidden=(9, 9)) == (name, "hidden=9,9", "")


def test_a_field_that_has_the_papers_value_again_is_a_change_of_the_preset():
    config = preset("parallel", hidden=(64, 64))
    result = RESULT._replace(**run_key(config)._asdict())
    assert sort_settings(result) == ("parallel", "hidden=64,64", "")


def test_a_run_has_one_identity():
    config = Config(env="hopper", heads=10, seed=3, steps=1000, noise="none")
    assert run_key(config) == ("hopper", "mapg", 10, 3, 1000, "noise=none")
    assert run_key(config) == RESULT._replace(seed=3, settings="noise=none").run
    for other in ({"seed": 4}, {"heads": 9}, {"steps": 5}, {"env": "swimmer"}, {"tau": 0.5}):
        assert run_key(dataclasses.replace(config, **other)) != run_key(config)
    assert run_key(dataclasses.replace(config, evaluate_every=7)) == run_key(config)


def test_a_run_found_twice_counts_once():
    again = RESULT._replace(date="2030-01-01")
    assert merge([RESULT, again]) == [RESULT]
    assert len(merge([RESULT, RESULT._replace(settings="noise=none", return_mean=1.0)])) == 2


@pytest.mark.parametrize("rows", [1, 2, 40, 41, 79, 80, 81, 100])
def test_thinned_curves_end_with_the_run(rows, tmp_path):
    folder = RunFolder.create(tmp_path / "run", Config(steps=100 * rows))
    lines = [f"{100 * i},{i / 7!r},nan" for i in range(1, rows + 1)]
    folder.metrics.write_text("\n".join(["env_steps,return_mean,spread", *lines, ""]))
    with pytest.raises(ValueError, match="no rows"):
        read_curve(folder)  # without the column that every run has
    lines = [line + ",1.0" for line in lines]
    folder.metrics.write_text("\n".join(["env_steps,return_mean,spread,seconds", *lines, ""]))
    curve = read_curve(folder)
    steps = curve["env_steps"]
    assert len(steps) <= 40
    assert steps[-1] == 100 * rows
    assert len(steps) == rows or len(set(np.diff(steps))) <= 1
    np.testing.assert_array_equal(curve["return_mean"], steps / 100 / 7)
    assert np.isnan(curve["spread"]).all()
    assert np.isnan(curve["q_gap_relative"]).all()


def test_a_cell_is_no_formula_for_a_spreadsheet(tmp_path):
    append_csv(tmp_path / "results.csv", [RESULT._replace(command="=cmd|' /C calc'!A0")])
    append_csv(tmp_path / "results.csv", [RESULT._replace(seed=RESULT.seed + 1)])
    assert read_csv(tmp_path / "results.csv")[0].command == "'=cmd|' /C calc'!A0"
