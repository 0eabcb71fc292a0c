"""The report: every number is the statistic it is called, and nothing is mixed or hidden."""

import csv
import html.parser
import io
import re

import numpy as np
import oracles
import pytest

from mapg_jax.reports import inference as statistics
from mapg_jax.reports import plots as plotting
from mapg_jax.reports import report, tables
from mapg_jax.reports.document import Bullets, Heading, Paragraph, Picture, Table, markdown, page
from mapg_jax.reports.results import read_run, sort_settings
from mapg_jax.reports.results_csv import append_csv
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config, preset

SCORES = {
    ("hopper", 1): [10.0, 12.0, 9.0, 11.0],
    ("hopper", 10): [20.0, 22.0, 31.0, 21.0],
    ("swimmer", 1): [5.0, 7.0, 8.0],
    ("swimmer", 10): [6.0],
    ("swimmer", 50): [1.0, 2.0, 3.0],
}


def results(scores=None, **fields):
    return [
        oracles.result(
            env=env,
            algorithm="ddpg" if heads == 1 else "mapg",
            heads=heads,
            seed=seed,
            return_mean=score,
            return_std=score / 10,
            **fields,
        )
        for (env, heads), of_cell in (scores or SCORES).items()
        for seed, score in enumerate(of_cell)
    ]


@pytest.fixture
def runs(tmp_path):
    """Folders of three arms on Hopper, of other steps, and one that is not finished."""
    for seed in range(3):
        for heads, top in ((1, 10.0), (10, 20.0)):
            config = Config(env="hopper", heads=heads, seed=seed, steps=1000)
            name = tmp_path / "runs" / f"m{heads}" / str(seed)
            oracles.finished_run(config, name, [top + seed, top - seed, top + 5])
    config = Config(env="hopper", heads=10, steps=2000, batch_size=32)
    oracles.finished_run(config, tmp_path / "runs" / "long", [1.0, 2.0])
    RunFolder.create(tmp_path / "runs" / "half", config)
    return tmp_path / "runs"


# ----- tables


def rows_of(table):
    """{(task, arm): the other cells by their header}."""
    return {tuple(row[:2]): dict(zip(table.header[2:], row[2:], strict=True)) for row in table.rows}


def test_cells_are_the_statistics_of_their_scores():
    for cell in tables.cells(results()):
        scores = SCORES[cell.env, cell.arm.heads]
        assert cell.seeds == len(scores)
        assert cell.mean == statistics.mean(scores)
        assert cell.median == statistics.median(scores)
        assert cell.interquartile_mean == statistics.interquartile_mean(scores)
        assert cell.std == pytest.approx(np.mean(scores) / 10)
        if cell.arm.heads == 1:
            assert cell.comparison is None
        else:
            assert cell.comparison == statistics.compare(scores, SCORES[cell.env, 1])


def test_the_table_shows_every_cell_and_what_is_missing():
    rows = rows_of(tables.tables(results())[0])
    assert list(rows) == [
        (env, arm) for env in ("hopper", "swimmer") for arm in ("DDPG", "M = 10", "M = 50")
    ]
    assert rows["hopper", "M = 10"]["mean ± 3σ"] == "23.5 ± 7.1"
    assert rows["hopper", "M = 10"]["P over plain"] == "1.00 (1.00 to 1.00)"
    assert rows["hopper", "M = 10"]["P is"] == "above ½, p = 0.029"
    assert rows["swimmer", "M = 10"]["mean"] == "6.0"
    assert rows["swimmer", "M = 10"]["P is"] == "undecided, p = 1"
    assert rows["swimmer", "M = 50"]["P is"] == "undecided, p = 0.1"
    assert set(rows["hopper", "M = 50"].values()) == {"0", "missing"}


def test_without_ddpg_there_is_nothing_to_compare_with():
    scores = {("hopper", 10): [1.0, 2.0], ("swimmer", 1): [3.0, 4.0]}
    (table,) = tables.tables(results(scores))
    assert rows_of(table)["hopper", "M = 10"]["P over plain"] == "DDPG missing"


def test_the_mean_over_tasks_takes_tasks_that_have_both_arms():
    table = tables.over_tasks(results())
    pairs = [(SCORES[env, 10], SCORES[env, 1]) for env in ("hopper", "swimmer")]
    value = statistics.mean_probability_of_improvement(pairs).value
    assert table.rows == [["M = 10", "hopper, swimmer", f"{value:.2f}"]]


def test_an_algorithm_with_several_heads_is_compared_with_itself():
    """TD3 with M = 10 with TD3; TD3 itself, as A3C, with DDPG."""
    of = {
        slug: [oracles.result(env="hopper", algorithm=slug, heads=m, seed=i, return_mean=score + i)
               for i in range(2)]
        for slug, m, score in (("ddpg", 1, 5.0), ("td3", 1, 9.0))
    }  # fmt: skip
    several = [oracles.result(algorithm="td3", heads=10, seed=i, return_mean=7.0) for i in range(2)]
    (table,) = tables.tables(of["ddpg"] + of["td3"] + several)
    rows = {arm: cells["P over plain"][:4] for (_, arm), cells in rows_of(table).items()}
    assert rows == {"DDPG": "", "TD3": "1.00", "TD3, M = 10": "0.00"}


def test_arms_are_compared_with_ddpg_of_the_same_noise():
    quiet = results({("hopper", 1): [1.0, 2.0], ("hopper", 10): [3.0, 4.0]}, settings="noise=none")
    rules = results({("hopper", 10): [0.0, 0.5]}, settings="gradient=all noise=none")
    noisy = results({("hopper", 1): [8.0, 9.0], ("hopper", 10): [6.0, 7.0]})
    (table,) = tables.tables(quiet + rules + noisy)
    rows = {arm: cells["P over plain"][:4] for (_, arm), cells in rows_of(table).items()}
    assert rows == {
        "DDPG": "",
        "DDPG, noise=none": "",
        "M = 10": "0.00",
        "M = 10, gradient=all noise=none": "0.00",
        "M = 10, noise=none": "1.00",
    }


def test_driving_has_a_table_of_its_own():
    shares = [(100.0, 0.0, 0.0), (300.0, 1.5, 0.5)]
    names = ("distance_mean", "laps_mean", "lap_share")
    driving = [
        oracles.result(env="driving", seed=seed, metrics=dict(zip(names, numbers, strict=True)))
        for seed, numbers in enumerate(shares)
    ]
    (row,) = tables.tables(driving)[1].rows
    assert row[:3] == ["driving", "M = 10", "2"]
    assert [cell.split(" ")[0] for cell in row[3:]] == ["200", "0.75", "0.25"]


def test_protocols_are_never_in_one_table():
    few = {("hopper", 1): [10.0, 12.0], ("hopper", 10): [20.0]}
    ours = results(few)
    others = results(few, steps=2000) + results(few, versions="gymnasium 2.0, mujoco 4.0")
    text = markdown(report.compose(report.Runs(ours + others, {}, [])), pictures=False)
    assert text.count(markdown(tables.tables(ours)).rstrip()) == 3
    for said in ("1,000 environment steps", "2,000 environment steps", "gymnasium 2.0"):
        assert said in text


def test_the_csv_has_the_same_numbers():
    rows = list(csv.DictReader(io.StringIO(tables.table_csv(results() + results(steps=2000)))))
    assert len(rows) == 2 * len(SCORES)
    (row,) = (r for r in rows if (r["env"], r["arm"], r["steps"]) == ("hopper", "M = 10", "2000"))
    estimate = statistics.mean(SCORES["hopper", 10])
    got = [float(row[name]) for name in ("mean", "mean_low", "mean_high")]
    assert got == pytest.approx(list(estimate), rel=1e-5)
    assert (row["seeds"], row["verdict"]) == ("4", "above")
    (row,) = (r for r in rows if (r["arm"], r["env"], r["steps"]) == ("M = 10", "swimmer", "1000"))
    assert (row["mean"], row["mean_low"], row["verdict"]) == ("6", "", "undecided")


# ----- what is found


def test_runs_and_csv_files_are_gathered_once(runs, tmp_path):
    found = report.gather([runs, runs / "m1"])
    assert len(found.results) == 7
    assert len(found.curves) == 7
    assert [text.split(" is ")[0] for text in found.unfinished] == [str(runs / "half")]
    append_csv(tmp_path / "some.csv", found.results[:3])
    again = report.gather([tmp_path / "some.csv", runs])
    assert sorted(again.results) == sorted(found.results)
    alone = report.gather([tmp_path / "some.csv"])
    assert alone.results == found.results[:3]
    assert not alone.curves


def test_the_report_of_a_folder(runs, tmp_path):
    found = report.gather([runs])
    blocks = report.compose(found)
    text = markdown(blocks, pictures=False)
    assert "These runs follow 2 protocols" in text
    assert "## 1,000 steps" not in text  # what was taken, not what was asked for
    assert re.search(r"## 1,008 steps \(protocol \d of 2\)", text)
    assert "preset paper, but batch_size=32" in text
    assert f"- {runs / 'half'} is not finished: it has no evaluation.json" in text
    report.write(blocks, found, tmp_path / "new" / "out")
    names = {path.name for path in (tmp_path / "new" / "out").iterdir()}
    linked = set(re.findall(r"\]\((.*?)\)", (tmp_path / "new/out/report.md").read_text()))
    assert names == {"report.md", "report.csv", "report.html"} | linked
    assert len(linked) == 3  # curves of both protocols, scores over M of one
    before = {path.name: path.read_bytes() for path in (tmp_path / "new" / "out").iterdir()}
    report.write(report.compose(report.gather([runs])), found, tmp_path / "new" / "out")
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "new/out").iterdir()}


def test_a_smoke_run_is_one_of_the_preset_smoke(tmp_path):
    for name, changes in (("plain", {}), ("wide", {"hidden": (32, 32)})):
        oracles.finished_run(preset("smoke", **changes), tmp_path / name, [1.0, 2.0])
    text = markdown(report.compose(report.gather([tmp_path])), pictures=False)
    assert "preset smoke; scored" in text
    assert "preset smoke, but hidden=32,32; scored" in text


def test_one_protocol_is_not_called_mixed(runs):
    text = markdown(report.compose(report.gather([runs / "m1", runs / "m10"])), pictures=False)
    assert "protocols" not in text
    assert "Not finished" not in text
    assert "| hopper | DDPG | 3 |" in text


def test_nothing_finished_is_refused(runs):
    with pytest.raises(ValueError, match=r"no run in .* is finished \(1 are not\)"):
        report.gather([runs / "half"])


def test_another_score_of_the_same_run_is_refused(runs, tmp_path):
    result = read_run(runs / "long")
    append_csv(tmp_path / "other.csv", [result._replace(return_mean=7.0)])
    with pytest.raises(ValueError, match="two runs of hopper"):
        report.gather([runs, tmp_path / "other.csv"])
    assert sort_settings(result).own == ""


# ----- pages and pictures


class Outline(html.parser.HTMLParser):
    """Tags that are open, all that refer to something, and the cells of tables."""

    def __init__(self):
        super().__init__()
        self.open, self.references, self.cells = [], [], []

    def handle_starttag(self, tag, attributes):
        self.references += [v for k, v in attributes if k in ("src", "href", "data")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells.append(data)


def test_the_page_is_whole_and_needs_no_other_file():
    figure = plotting.draw_boxes({"hopper": {"1": [[1.0], [2.0]]}})
    blocks = [
        Heading("A < B & C", 1),
        Paragraph("1 < 2"),
        Bullets(["<b>"]),
        Table(("a|b", "<i>"), [["1", "&"]]),
        Picture(figure, "boxes", 'a "picture"'),
    ]
    text = page(blocks)
    outline = Outline()
    outline.feed(text)
    assert not outline.open
    (reference,) = outline.references
    assert reference.startswith("data:image/svg+xml;base64,")
    assert outline.cells == ["a|b", "<i>", "1", "&"]
    assert "http" not in text
    assert "<b>" not in text
    assert text == page(blocks)
    assert markdown(blocks) == (
        "# A < B & C\n\n1 < 2\n\n- &lt;b>\n\n| a\\|b | &lt;i> |\n| --- | --- |\n| 1 | & |\n\n"
        '![a "picture"](boxes.png)\n\na "picture"\n'
    )


def curve(steps, values):
    return {"env_steps": np.array(steps, float), "return_mean": np.array(values, float)}


def test_a_mean_curve_is_the_mean_at_steps_that_all_have():
    curves = [curve([10, 20, 30, 40], [1, 2, 3, 4]), curve([15, 30, 45], [0, 6, 9])]
    curves.append(curve([5, 15, 30, 45], [1, 3, 6, 9]))
    steps, mean, low, high = plotting.mean_curve(curves, "return_mean")
    np.testing.assert_array_equal(steps, [15, 30])
    np.testing.assert_allclose(mean, [1.5, 5])
    for point, of_seeds in enumerate(([1.5, 0, 3], [3, 6, 6])):
        assert (low[point], high[point]) == statistics.mean(of_seeds)[1:]
    steps, mean, low, high = plotting.mean_curve(curves[:1], "return_mean")
    np.testing.assert_array_equal(mean, [1, 2, 3, 4])
    assert np.isnan([low, high]).all()


def test_curves_have_an_arm_a_line_and_say_how_many_seeds():
    one, two = curve([10, 20], [1, 2]), curve([10, 20], [3, 4])
    tasks = {"hopper": {"DDPG": [one, two], "M = 10": [one]}, "swimmer": {"M = 10": [two, one]}}
    figure = plotting.draw_curves(tasks)
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["DDPG (n = 2)", "M = 10 (n = 1 to 2)"]
    lines = [line for axes in figure.axes for line in axes.lines if len(line.get_xdata())]
    assert len(lines) == 9  # with the edges of their bands
    colours = [line.get_color() for line in lines if line.get_linewidth() > 1]
    assert len(colours) == 3
    assert colours[0] != colours[1] == colours[2]
    assert [axes.get_title() for axes in figure.axes] == ["hopper", "swimmer"]
    assert all(axes.get_xlabel() == "environment steps" for axes in figure.axes)


def test_many_arms_look_different_and_their_legend_fits():
    tasks = {"hopper": {f"an arm of number {i}": [curve([10, 20], [i, i])] for i in range(9)}}
    figure = plotting.draw_curves(tasks)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
    looks = {(line.get_color(), line.get_linestyle()) for line in legend.get_lines()}
    assert len(looks) == 9


def test_boxes_have_a_dot_a_seed_and_name_what_is_missing():
    episodes = [np.arange(4.0), np.arange(2.0, 6.0)]
    figure = plotting.draw_boxes({"hopper": {"1": episodes, "5": [], "10": [[1.0], [2.0]]}})
    (axes,) = figure.axes
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == ["1\nn = 2", "5\nmissing", "10\nn = 2"]
    dots = [line.get_ydata() for line in axes.lines if line.get_marker() == "o"]
    assert [list(y) for y in dots] == [[1.5, 3.5], [], [1.0, 2.0]]
    medians = [line for line in axes.lines if line.get_color() == plotting.COLOURS[2]]
    assert [line.get_ydata()[0] for line in medians] == [
        2.5
    ]  # of eight episodes; not of two scores


def test_a_forest_has_a_hollow_dot_where_there_is_no_interval():
    sure, alone = statistics.Estimate(0.6, 0.5, 0.7), statistics.Estimate(0.4, np.nan, np.nan)
    (axes,) = plotting.draw_forest({"C1": {"hopper": sure, "swimmer": alone}}, "P").axes
    dots = {line.get_xdata()[0]: line for line in axes.lines if line.get_marker() == "o"}
    assert {x: line.get_fillstyle() for x, line in dots.items()} == {0.6: "full", 0.4: "none"}


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="nothing to draw"):
        plotting.draw_curves({})


def test_what_a_run_folder_says_is_text_in_markdown_too():
    blocks = [
        Heading("one\ntwo", 1),
        Bullets(["<script>alert(1)</script>"]),
        Table(("a",), [["x\n| y <b>"]]),
    ]
    assert markdown(blocks) == (
        "# one two\n\n- &lt;script>alert(1)&lt;/script>\n\n| a |\n| --- |\n| x \\| y &lt;b> |\n"
    )
    assert markdown([Paragraph("p < 0.05")]) == "p < 0.05\n"
