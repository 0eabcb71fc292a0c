"""The experiments from end to end, in their smallest form."""

import dataclasses
import json
import shutil
import signal

import oracles
import pytest

from experiments import (
    fig2,
    fig3,
    overhead,
    page,
    paper,
    rows,
    scores,
)
from experiments import plan as plan_
from experiments.catalogue import LATER, TITLES, Name, experiment
from experiments.plan import RULES, Plan, make_plan
from mapg_jax.reports.results_csv import append_csv
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.member import DIVERGED
from mapg_jax.runs.sealing import write_score
from mapg_jax.runs.signals import StoppedError
from mapg_jax.sweeps.worker import failure_file

ALL: list[Name] = [name for name in TITLES if name != "repeats" and name not in LATER]
NAMES: list[Name] = ["fig2", "fig3", "returns"]
"""Whose runs are few: each costs a process that compiles and scores."""


def small(folder) -> Plan:
    plan = make_plan("smoke", 320, 1, folder / "runs", folder / "results")
    base = dataclasses.replace(plan.base, evaluate_every=160)
    return plan._replace(
        base=base,
        tasks=("pendulum",),
        heads=(10,),
        studied=("pendulum",),
        ruled=("pendulum",),
        carried=(),
        timing=(2, 0.01),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A plan whose runs are trained; of the rules for heads it knows one."""
    plan = small(tmp_path_factory.mktemp("paper"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan_, "RULES", {"all": RULES["all"]})
        assert paper.make(plan, NAMES, workers=2).failures == []
        yield plan


def test_a_command_trains_measures_and_draws(made):
    found = scores.of(made, paper.runs(made, NAMES))
    arms = [(r.env, r.algorithm, r.heads, r.steps) for r in found]
    assert sorted(arms) == [
        ("pendulum", "mapg", 10, 160),
        *[("pendulum", "mapg", 10, 320)] * 2,  # and the rule
    ]
    assert {r.episodes for r in found} == {4}
    assert_shown(made, ["fig2.png", "fig3.png"], "fig3", runs=2)


def assert_shown(plan, pictures, name, runs):
    """The page has them, and says what made it."""
    text = (plan.results / "README.md").read_text()
    for picture in pictures:
        assert f"({picture})" in text
        assert (plan.results / picture).read_bytes().startswith(b"\x89PNG")
    command = f"mapg paper {name} --seeds 1 --preset smoke --steps 320"
    assert f"Made by `{command}`: {runs} of {runs} runs finished" in text


@pytest.mark.slow
def test_every_experiment_trains_measures_and_draws(tmp_path):
    """All but those of later protocols, with every rule for heads."""
    made = small(tmp_path)
    assert paper.make(made, ALL, workers=2).failures == []
    found = scores.of(made, paper.runs(made, ALL))
    arms = [(r.env, r.algorithm, r.heads, r.steps) for r in found]
    pendulum = [
        ("a3c", 1, 320),
        *[("ddpg", 1, 320)] * 2,  # with and without noise
        ("mapg", 5, 320),
        ("mapg", 10, 160),
        *[("mapg", 10, 320)] * (2 + len(made.rules())),  # and each rule
    ]
    driving = [("ddpg", 1, 320), ("mapg", 10, 320)]
    assert sorted(arms) == [("driving", *x) for x in driving] + [("pendulum", *x) for x in pendulum]
    assert_shown(made, ["fig2.png", "fig3.png", "fig4.png", "heads.png"], "table2", runs=3)
    for section in ("table2", "fig2", "fig3", "fig4", "torcs", "overhead", "heads", "returns"):
        assert_whole(made, section)
    timed = rows.read(made.measured / overhead.TIMES)
    assert [(row["heads"], row["round"]) for row in timed] == [
        ("1", "0"), ("10", "0"), ("1", "1"), ("10", "1"),
    ]  # fmt: skip
    assert all(float(row[k]) > 0 for row in timed for k in row if k.startswith("seconds"))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_missing_of_what_was_trained(made, name):
    assert_whole(made, name)


def assert_whole(plan, name):
    shown = experiment(name).section(plan)
    assert "issing" not in shown and any(character.isdigit() for character in shown)


def test_the_score_is_that_of_the_run(made):
    (config,) = fig3.judged(made)
    record = json.loads((made.folder(config) / "evaluation.json").read_text())
    (result,) = scores.of(made, [config])
    assert (result.return_mean, result.episodes) == (record["mean"], len(record["returns"]))


def test_spread_by_angle_counts_every_state(made):
    bins = rows.of(made.measured / "fig3_bins.csv", fig3.judged(made), each="angle")
    assert sum(int(row["states"]) for row in bins) == 100 * 200
    episode = rows.of(made.measured / "fig3_episode.csv", paper.runs(made, ["fig3"]), each="step")
    assert abs(float(episode[0]["angle"])) <= 5  # hanging down
    assert all(float(row["spread"]) >= 0 for row in episode)


def test_results_are_made_again_from_the_run_folders(made, tmp_path):
    again = made._replace(results=tmp_path)
    paper.make(again, ["fig3"], training=False)
    assert rows.read(scores.path(made)) and rows.read(scores.path(again))
    for file, each in (
        ("curves.csv", "env_steps"),
        ("selects.csv", "select"),
        ("fig3_bins.csv", "angle"),
    ):
        old, new = (rows.of(p.measured / file, fig3.judged(made), each=each) for p in (made, again))
        assert sorted(old, key=str) == sorted(new, key=str) and old, file


def test_a_folder_that_cannot_be_read_does_not_stop_the_others(made, tmp_path):
    plan = made._replace(runs=tmp_path / "runs", results=tmp_path / "results")
    (whole,), (broken,) = fig2.runs(plan), fig3.judged(plan)
    shutil.copytree(made.folder(whole), plan.folder(whole))
    plan.folder(broken).mkdir()
    (plan.folder(broken) / "config.json").write_text("{")
    (failure,) = paper.make(plan, ["fig2", "fig3"], training=False).failures
    assert f"{plan.folder(broken)}/config.json is damaged" in failure
    assert [result.steps for result in scores.of(plan, [broken, whole])] == [whole.steps]


def test_what_is_in_the_results_is_not_trained_again(made, tmp_path):
    elsewhere = made._replace(runs=tmp_path)
    assert paper.train(elsewhere, NAMES, workers=1) == []
    assert [path.name for path in tmp_path.iterdir()] == [".training.lock"]


def test_other_steps_do_not_mix(made):
    with pytest.raises(ValueError, match=r"holds runs of \d+ steps, and these have 640"):
        longer = make_plan("smoke", 640, 1, made.runs, made.results)
        paper.make(longer, NAMES, training=False)


def test_other_presets_do_not_mix(made):
    other = make_plan("paper", 320, 1, made.runs, made.results)
    with pytest.raises(ValueError, match="settings"):
        paper.make(other, NAMES, training=False)


def test_scores_of_two_versions_of_the_tasks_do_not_mix(made, tmp_path):
    mixed = made._replace(results=tmp_path)
    found = scores.of(made, paper.runs(made, NAMES))
    append_csv(scores.path(mixed), [found[0], found[1]._replace(versions="mujoco 9")])
    with pytest.raises(ValueError, match=r"is of mujoco 9, which does not compare with gym"):
        paper.make(mixed, NAMES, training=False)


@pytest.mark.parametrize("other", [{"versions": "mujoco 9"}, {"physics": "mjx", "engine": "mjx"}])
def test_nothing_is_trained_that_would_not_compare(made, tmp_path, other):
    mixed = made._replace(runs=tmp_path / "runs", results=tmp_path / "results")
    found = scores.of(made, paper.runs(made, ["fig3"]))
    append_csv(scores.path(mixed), [found[0]._replace(**other)])
    with pytest.raises(ValueError, match=r"what would be trained here .* does not compare with"):
        paper.make(mixed, NAMES)
    assert not mixed.runs.exists()


@pytest.mark.parametrize(
    "other", [{"select": "mean"}, {"seed": 7}, {"physics": "gymnasium"}, {"episodes": 3}]
)
def test_a_score_by_another_measure_is_refused_but_one_that_is_there_stays(made, tmp_path, other):
    (config,) = fig3.judged(made)
    shutil.copytree(made.folder(config), tmp_path / "run")
    folder = RunFolder.open(tmp_path / "run")
    record = json.loads(folder.evaluation.read_text()) | other
    write_score(folder, {name: value for name, value in record.items() if name != "seal"})
    (name, value) = next(iter(other.items()))
    elsewhere = made._replace(results=tmp_path)
    (failure,) = paper.measure(elsewhere, folder)
    assert f"was scored with {name} {value}; score it by: mapg evaluate" in failure
    assert scores.of(elsewhere, [config]) == []
    before = scores.path(made).read_bytes()
    scores.measure(made, folder)
    assert scores.path(made).read_bytes() == before


def test_the_page_shows_every_seed_there_is(made, tmp_path):
    more = made._replace(results=tmp_path)
    found = scores.of(made, paper.runs(made, ["table2"]))
    append_csv(scores.path(more), [*found, *(result._replace(seed=2001) for result in found)])
    assert "(n = 2)" in page.sections(more)["table2"]


def test_a_run_that_diverged_is_named_and_not_tried_again(made, tmp_path):
    plan = made._replace(runs=tmp_path / "runs", results=tmp_path / "results")
    wanted = paper.runs(plan, ["fig2"])
    plan.folder(wanted[0]).mkdir(parents=True)
    failure_file(plan.folder(wanted[0])).write_text(f"{DIVERGED} at step 64\n")
    for _ in range(2):
        paper.record_diverged(plan, wanted)
    assert paper.train(plan, ["fig2"], workers=1) == []
    assert page.diverged(plan).count("pendulum, mapg, M = 10, seed 2000") == 1


def test_what_is_finished_is_shown_when_training_is_stopped(made, tmp_path, monkeypatch):
    def stopped(*_, **__):
        raise StoppedError(signal.SIGTERM, "the same command")

    monkeypatch.setattr(paper, "carry_out", stopped)
    plan = made._replace(results=tmp_path)
    with pytest.raises(StoppedError):
        paper.make(plan, ["fig2"])
    wanted = paper.runs(plan, ["fig2"])
    assert scores.of(plan, wanted) == scores.of(made, wanted) != []
    assert (
        "fig2 --seeds 1 --preset smoke --steps 320`: 1 of 1 runs finished"
        in (tmp_path / page.FILE).read_text()
    )


def test_two_processes_do_not_train_for_the_same_results_but_one_may_look(made):
    with paper.training_lock(made):
        with pytest.raises(BlockingIOError, match="another mapg paper is training in"):
            paper.train(made, ["fig2"], workers=1)
        assert paper.make(made, ["fig2"], training=False).failures == []


def test_a_run_that_was_given_more_steps_is_named_and_not_mixed_in(tmp_path, monkeypatch):
    plan = small(tmp_path)
    (config,) = fig3.judged(plan)
    longer = dataclasses.replace(config, steps=2 * config.steps)
    folder = oracles.finished_run(longer, plan.folder(config), [1.0, 2.0])
    monkeypatch.setattr(paper, "carry_out", lambda _, on_finished, **__: on_finished(folder) or [])
    (failure,) = paper.make(plan, ["fig3"]).failures
    assert failure == f"{folder.path} holds a run of another configuration"
    assert scores.of(plan, [config, longer]) == []


def test_a_damaged_file_is_refused(made, tmp_path):
    plan = made._replace(results=tmp_path)
    plan.measured.mkdir()
    for text, message in (("env,heads\nx,\n", "no column"), ("env\nx,y\n", "other columns")):
        (plan.measured / "curves.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            page.sections(plan)


def test_a_page_of_nothing_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"there is nothing to show: no results in .*, no runs in"):
        paper.make(small(tmp_path), NAMES, training=False)
    assert not list(tmp_path.iterdir())


def test_results_that_cannot_be_written_are_refused_before_anything_is_trained(tmp_path):
    (tmp_path / "file").touch()
    plan = small(tmp_path)._replace(results=tmp_path / "file" / "results")
    with pytest.raises(ValueError, match="results cannot be created: Not a directory"):
        paper.make(plan, ["fig2"])
    assert not plan.runs.exists()
