"""Every algorithm by its published settings, from rows as runs would have written them."""

import pytest
from written import result

from experiments import claims, page, reference, rows, scores
from experiments.plan import make_plan, name
from mapg_jax.reports import inference
from mapg_jax.reports.results_csv import append_csv


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(inference, "RESAMPLES", 200)
    return make_plan("paper", None, None, tmp_path / "runs", tmp_path / "results")


def write(plan, cell, m, values):
    configs = reference.of(plan, cell, m)
    found = [result(config, value) for config, value in zip(configs, values, strict=False)]
    append_csv(scores.path(plan), found)


def test_plain_algorithms_come_first_and_are_named_by_their_preset(plan):
    wanted = reference.runs(plan)
    assert [config.heads for config in wanted] == [1] * 25 + [10] * 25
    assert len({name(config, plan) for config in wanted}) == len(wanted)
    assert name(wanted[0], plan) == "pendulum-naf-reference-m1-30000-s2000"
    assert wanted[0].hidden == (200, 200) and not wanted[0].layer_norm
    assert (wanted[1].algorithm, wanted[1].steps) == ("ppo", 489 * 2048)


def test_the_mean_over_seeds_is_what_must_reach(plan):
    naf, ppo, trpo, *_ = reference.CELLS
    write(plan, naf, 1, [-150.0, -160.0, -170.0, -180.0, -190.0])
    write(plan, ppo, 1, [1_700.0, 1_950.0])
    write(plan, trpo, 1, [1_400.0])
    write(plan, trpo, 10, [1_600.0])
    diverged = [*reference.of(plan, naf, 10), *reference.of(plan, trpo, 10)[1:]]
    lost = [{**rows.identity(config), "reason": "numbers"} for config in diverged]
    rows.append(plan.measured / rows.DIVERGED, lost)
    lines = reference.table(plan).markdown().splitlines()[2:]
    found = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [cells[5] for cells in found] == ["yes", "yes", "**no**, 1 of 2 seeds", *[""] * 8]
    many = ["all 5 diverged", "missing", "1600 (no interval), n = 1; 1 diverged"]
    assert [cells[6] for cells in found[:3]] == many


def test_it_stands_in_the_readme(plan, tmp_path):
    (tmp_path / "README.md").write_text("<!-- reference -->\n<!-- /reference -->\n")
    write(plan, reference.CELLS[0], 1, [-150.0])
    page.write_headline(plan, claims.ledger(plan), tmp_path / "README.md")
    assert "| NAF | pendulum | 30,000 |" in (tmp_path / "README.md").read_text()
