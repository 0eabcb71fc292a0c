"""The sections of the page and the tables of the README, from rows as runs would have written."""

import pathlib
import shutil

import oracles
import pytest
from written import ON_ONE, result, write, write_curve, write_laps

from experiments import (
    boxes,
    claims,
    curves,
    effects,
    fig4,
    heads,
    overhead,
    page,
    pictures,
    repeats,
    rows,
    scores,
    table2,
)
from experiments.catalogue import TITLES, runs
from experiments.plan import A3C, DDPG, FIRST_SEED, MAPG, NO_NOISE, make_plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports import plots
from mapg_jax.reports.results_csv import append_csv


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
    return make_plan("paper", 1600, None, tmp_path / "runs", tmp_path / "results")


def is_picture(path):
    return path.read_bytes().startswith(b"\x89PNG")


def test_table_2_stands_beside_the_papers_numbers(plan):
    write(plan, "hopper", DDPG, [100, 200, 600])
    write(plan, "hopper", A3C, [50])
    text = page.sections(plan)["table2"]
    assert "| hopper | here | 300 ± 3 (n = 3) | 50 ± 3 (n = 1) | missing |" in text
    assert "version 1" not in text
    assert "| | the paper | 603 ± 76 | 532 ± 105 |" in text
    assert "`mapg paper table2 --steps 1600`: 4 of 164 runs finished" in text


def test_table_2_has_both_scores_with_their_tests(plan):
    """Three above three: p is 2 / C(6, 3) by the score; by the second score they tie."""
    arms = {"DDPG": DDPG, "A3C": A3C}
    for scale, changes in zip((100, 200), arms.values(), strict=True):
        write(plan, "hopper", changes, [scale, scale + 1, scale + 2])
        for config in plan.over_seeds("hopper", **changes)[:3]:
            write_curve(plan, config, return_mean=[900.0, *[float(config.seed)] * curves.LATE])
    lines = {row[1]: row for row in table2.uncertainty(plan).rows}
    assert list(lines) == list(arms)
    low, high = FIRST_SEED, FIRST_SEED + 2
    late = f"{low + 1:,} ({low:,} to {high:,})"
    assert lines["DDPG"] == ["hopper", "DDPG", "3", "101 (100 to 102)", "", "", late, "", ""]
    score = ["201 (200 to 202)", "1.00 (1.00 to 1.00)", "0.1"]
    assert lines["A3C"][2:7] == ["3", *score, late] and lines["A3C"][7].startswith("0.50 (")
    assert lines["A3C"][8] == "1"
    assert not table2.over_tasks(plan).rows  # until all seeds of both arms are there
    (over,) = table2.over_tasks(plan._replace(seeds=3)).rows
    assert over == ["A3C", "hopper", *lines["A3C"][4:6], *lines["A3C"][7:]]


@pytest.mark.parametrize(("name", "env"), [("fig1", "walker2d"), ("fig5", "swimmer")])
def test_boxes_of_the_episodes(plan, name, env):
    config = plan.config(env, **MAPG)
    lines = [{**rows.identity(config), "returns": " ".join(map(str, range(100)))}]
    rows.append(plan.measured / boxes.FILE, lines)
    sections = page.sections(plan)
    assert f"![Score over M]({name}.png)" in sections[name]
    assert is_picture(plan.results / f"{name}.png")
    found = boxes.by_task(plan, rows.read(plan.measured / boxes.FILE), [env])[env]
    assert {m: [x.mean() for x in seeds] for m, seeds in found.items() if seeds} == {"10": [49.5]}


def test_episodes_whose_mean_is_not_the_score_are_refused(plan):
    config = plan.config("walker2d", **MAPG)
    lines = [{**rows.identity(config), "returns": "1 2 6"}]
    rows.append(plan.measured / boxes.FILE, lines)
    write(plan, "walker2d", MAPG, [3.0])
    page.sections(plan)
    scores.path(plan).unlink()
    write(plan, "walker2d", MAPG, [30.0])
    with pytest.raises(ValueError, match="walker2d, mapg, M = 10, seed 2000 return 3 on average"):
        page.sections(plan)


def test_laps_and_metres(plan):
    write_laps(plan, DDPG, [0.0, 0.0, 0.0])
    write_laps(plan, MAPG, [0.5])
    text = page.sections(plan)["torcs"]
    assert "| DDPG | 2002 | 0 | 0.0 | 0% | 0 | |" in text
    assert "| **DDPG** | n = 3 | 0 (0 to 0) | 0.0 (0.0 to 0.0) | 0% (0% to 0%) |" in text
    assert "| **MAPG, M = 10** | n = 1 | 500 (no interval) | 0.5 (no interval) |" in text


def test_noise_and_rules_have_the_interval_of_the_protocol(plan):
    """The percentile bootstrap, which cannot leave the range of the scores."""
    write(plan, "halfcheetah", MAPG, [1, 2, 6])
    assert "| halfcheetah | 3 (1 to 6), n = 3 | missing |" in heads.rule_table(plan).markdown()


def test_figure_4_has_a_panel_for_either_noise_and_an_axis_a_task(plan):
    for changes, value in ((DDPG, 1.0), ({**MAPG, **NO_NOISE}, 90.0)):
        config = plan.config("halfcheetah", FIRST_SEED, **changes)
        write_curve(plan, config, return_mean=[0.0, value])
    found = fig4.panels(plan)
    assert {title: list(arms) for title, arms in found.items()} == {
        "halfcheetah, with noise": ["DDPG"],
        "halfcheetah, without noise": ["M = 10"],
    }
    (curve,) = found["halfcheetah, without noise"]["M = 10"]
    assert list(curve["return_mean"]) == [0, 90]
    one, other = (axes.get_ylim() for axes in fig4.draw(found).axes)
    assert one == other and one[1] > 90


def test_overhead_is_relative_to_one_head(plan):
    where = {"versions": "jax 1", "date": "2026-01-01", "cores": 2, "load": 0.0, **ON_ONE}
    times = [
        {"heads": m, "round": r, "seconds_per_step": (1 + r) * ratio * 1e-6,
         "seconds_per_update": 2e-6, **where}
        for r in range(3)
        for m, ratio in ((1, 1.0), (10, 1.25))
    ]  # fmt: skip
    rows.append(plan.measured / overhead.TIMES, times)
    text = page.sections(plan)["overhead"]
    assert "| 10 | 2 | 1.25 (1.25 to 1.25) | 2 | 1.00 (1.00 to 1.00) |" in text
    assert "jax 1; 2026-01-01" in text


def test_every_seed_there_is_is_shown(plan):
    """Whatever was trained last."""
    write(plan, "hopper", DDPG, [1, 2, 3, 4])
    assert "(n = 4)" in page.sections(plan._replace(seeds=1))["table2"]


def test_effects_and_profiles_are_those_of_the_scores(plan):
    write(plan, "hopper", DDPG, [1, 2, 3])
    write(plan, "hopper", MAPG, [2.5, 5, 6])
    write(plan, "halfcheetah", DDPG, [2100, 2200, 7000])
    text = page.sections(plan)["effects"]
    (found,) = effects.forest(plan).values()
    assert list(found) == ["hopper (n = 3 + 3)"]  # not together: four tasks lack an arm
    assert found["hopper (n = 3 + 3)"].value == pytest.approx(8 / 9)
    assert effects.profile(plan)["hopper"] == {"DDPG": [1, 2, 3], "M = 10": [2.5, 5, 6]}
    assert is_picture(plan.results / "effects.png") and is_picture(plan.results / "profiles.png")
    assert "| DDPG | 33% (6% to 79%) | 1 of 3 |" in text  # Wilson's


def test_a_profile_falls_by_one_run_at_each_score():
    x, share = plots.profile([5.0, 1.0, 2.0])
    assert list(x[1:-1]) == [1, 2, 5] and x[0] < 1 and x[-1] > 5
    assert list(share) == pytest.approx([1, 2 / 3, 1 / 3, 0, 0])


def test_version_1_is_shown_apart(plan):
    write(plan, "hopper", DDPG, [100])
    old = result(plan.config("hopper", 0, **DDPG), 7, processor="")
    append_csv(scores.path(plan._replace(version=1)), [old])
    text = page.sections(plan)["table2"]
    assert "| hopper | here | 100 ± 3 (n = 1) |" in text
    assert "| | version 1 | 7 ± 3 (n = 1) |" in text


def test_a_run_of_version_1_made_again_is_compared_with_itself(plan, tmp_path):
    """The third evaluation is another one; no other number has its score."""
    ddpg, _ = repeats.repeated(plan)
    earlier = plan._replace(version=1)
    append_csv(scores.path(earlier), [result(ddpg, 7, processor="")])
    numbers = dict.fromkeys(curves.COLUMNS, 0.0)
    lines = [
        {**rows.identity(ddpg), **numbers, "env_steps": t, "return_mean": x}
        for t, x in enumerate((0.5, 1.0, 9.0, 2.0))
    ]
    rows.append(earlier.measured / curves.FILE, lines)
    folder = oracles.finished_run(ddpg, tmp_path / "again", [1.0, 3.0])
    repeats.measure(plan, folder)
    text = repeats.section(plan)
    assert "| halfcheetah, DDPG, seed 0 | 7 | 2 | the first 2 of 4 |" in text
    assert scores.read(plan) == []


def test_the_page_begins_with_the_answer(plan):
    write(plan, "hopper", DDPG, [100])
    text = page.write(plan, page.sections(plan)).read_text()
    assert f"1 of {len(runs(plan, list(TITLES)))} runs are there" in text
    assert text.index("**Answer.** Not yet judged: C1a") < text.index("## The claims")


def test_a_readme_that_cannot_be_written_whole_stays_as_it_was(plan, tmp_path, monkeypatch):
    readme = tmp_path / "README.md"
    readme.write_text("<!-- answer -->\n<!-- /answer -->\nafter\n")
    before = readme.read_text()
    opened = pathlib.Path.open

    def full(path, *arguments, **options):
        """Of a disk that has room for ten letters."""
        file = opened(path, *arguments, **options)
        write = file.write

        def some(text):
            write(text[:10])
            raise OSError("No space left on device")

        file.write = some
        return file

    monkeypatch.setattr(pathlib.Path, "open", full)
    with pytest.raises(OSError, match="No space"):
        page.write_headline(plan, claims.ledger(plan), readme)
    monkeypatch.undo()
    assert readme.read_text() == before


def test_the_readme_gets_its_tables_between_its_comments(plan, tmp_path):
    append_csv(scores.path(plan), [result(plan.config("hopper", **DDPG), 7)])
    readme = tmp_path / "README.md"
    readme.write_text(
        "before\n<!-- answer -->\n<!-- /answer -->\n"
        "<!-- table 2 -->\nold\n<!-- /table 2 -->\nbetween\n"
        "<!-- claims -->\n<!-- /claims -->\nafter\n"
    )
    ledger = claims.ledger(plan)
    page.write_headline(plan, ledger, readme)
    assert page.answer(ledger) in page.abstract(plan, ledger)
    assert page.answer(ledger) in readme.read_text().splitlines()
    lines = readme.read_text().splitlines()
    assert "old" not in lines and "| hopper | here | 7 ± 3 (n = 1) |" in readme.read_text()
    assert [line for line in lines if line in ("before", "between", "after")] == [
        "before", "between", "after",
    ]  # fmt: skip
    assert (
        lines.index("between")
        < lines.index("| | claim | version 1 | version 2 |")
        < lines.index("after")
    )
    page.write_headline(plan, claims.ledger(plan), readme)
    assert readme.read_text().splitlines() == lines


def test_the_committed_page_is_that_of_the_committed_rows(tmp_path):
    """Its text word for word, and the numbers of its pictures; not their bytes."""
    committed = pathlib.Path(__file__).parents[2] / "results"
    again = tmp_path / "results"
    drawn = shutil.ignore_patterns("*.png", pictures.FOLDER, page.FILE)
    shutil.copytree(committed, again, ignore=drawn)
    shutil.copy(committed.parent / "README.md", tmp_path)
    plan = make_plan("paper", None, None, tmp_path / "runs", again)
    page.write(plan, page.sections(plan))
    assert (again / page.FILE).read_text() == (committed / page.FILE).read_text()
    numbers = {file.name: file.read_text() for file in (committed / pictures.FOLDER).glob("*")}
    assert {file.name: file.read_text() for file in (again / pictures.FOLDER).glob("*")} == numbers
    readme = (committed.parent / "README.md").read_text()
    page.write_headline(plan, claims.ledger(plan), tmp_path / "README.md")
    assert (tmp_path / "README.md").read_text() == readme
