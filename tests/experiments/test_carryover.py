"""C10: other algorithms with several actions, judged from rows as runs would have written them."""

import pytest
from written import write, write_curve

from experiments import carryover, comparisons
from experiments.plan import make_plan
from mapg_jax.reports import inference
from mapg_jax.reports.stratified import power


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(inference, "RESAMPLES", 200)
    return make_plan("paper", 20_480, None, tmp_path / "runs", tmp_path / "results")


def write_arms(plan, name, gain, seeds=5):
    """Scores of both arms on every task: M = 10 that much above M = 1 in each seed's place."""
    comparison = carryover.judged(plan)[name]
    for env in comparison.envs:
        write(plan, env, comparison.theirs, [float(k) for k in range(seeds)])
        write(plan, env, comparison.ours, [k + gain for k in range(seeds)])


def verdicts(plan):
    return {
        name: v.verdict
        for name, v in zip(carryover.ALGORITHMS, carryover.ledger(plan), strict=True)
    }


def test_all_algorithms_take_the_same_steps_whole(plan):
    """Of 16 environments, and of rollouts of 128 steps of each."""
    assert carryover.steps(plan) == 10_240
    full = plan._replace(base=plan.base.__class__(steps=2_000_000))
    assert carryover.steps(full) == 999_424 == 488 * 16 * 128
    for config in carryover.runs(plan):
        turn = config.environments * getattr(config, "rollout_steps", 1)
        assert config.steps % turn == 0


def test_every_algorithm_is_judged_at_holms_level(plan):
    write_arms(plan, "naf", 10.0)  # above in every pair: p = 2 / 252² over two tasks
    write_arms(plan, "trpo", -10.0)
    write_arms(plan, "ppo", 0.0)
    found = verdicts(plan)
    assert found["naf"] == "supported" and found["trpo"] == "contradicted"
    assert found["ppo"] == "undecided"
    assert found["td3"].startswith("not yet: 0 of 40") and found["sac"].startswith("not yet")
    assert carryover.together(plan).verdict == "contradicted"
    evidence = carryover.ledger(plan)[0].evidence
    p = 2 / 252**2
    assert evidence.startswith(f"adjusted p = {4 * p:.2g}; p = {p:.2g}")  # that of TRPO is less


def test_what_is_undecided_has_power_at_the_level_that_holm_leaves(plan):
    """Two of five tests are decided, so a third is made at a third of the level."""
    write_arms(plan, "naf", 10.0)
    write_arms(plan, "trpo", -10.0)
    write_arms(plan, "ppo", 0.0)
    found = carryover.ledger(plan)
    assert [v.power for v in found[:2]] == ["", ""] and found[2].power.endswith("%")
    comparison = carryover.judged(plan)["ppo"]
    moved = comparisons.moved(comparison, comparison.pairs(plan))
    assert found[2].power == f"{power(moved, comparisons.ALPHA / 3).together:.0%}"


def test_the_second_score_is_tested_once_every_run_has_it(plan):
    comparison = carryover.judged(plan)["naf"]
    write_arms(plan, "naf", 10.0)
    arms = [plan.over_seeds(env, **arm) for env in comparison.envs
            for arm in (comparison.ours, comparison.theirs)]  # fmt: skip
    for k, of_arm in enumerate(arms):
        for config in of_arm:
            write_curve(plan, config, return_mean=[float(-k % 2 + config.seed)])
            if config != arms[-1][-1]:
                assert "second score" not in carryover.ledger(plan)[0].evidence
    assert "by the second score p = " in carryover.ledger(plan)[0].evidence


def test_c10_waits_for_both_that_the_paper_names(plan):
    write_arms(plan, "naf", 10.0)
    assert carryover.together(plan).verdict == "not yet: 20 of 60 runs"
    write_arms(plan, "trpo", 10.0)
    assert carryover.together(plan).verdict == "supported"


def test_an_algorithm_that_lacks_runs_counts_as_p_1(plan):
    write_arms(plan, "naf", 10.0)
    write_arms(plan, "trpo", -10.0, seeds=4)
    naf, trpo = carryover.ledger(plan)[:2]
    p = 2 / 252**2
    assert naf.evidence.startswith(f"adjusted p = {5 * p:.2g}; p = {p:.2g}")
    assert (trpo.verdict, trpo.effect, trpo.evidence) == ("not yet: 32 of 40 runs", "", "")
    assert carryover.together(plan).verdict == "not yet: 52 of 60 runs"


def test_few_seeds_decide_nothing(plan):
    plan = plan._replace(seeds=1)
    write_arms(plan, "naf", 10.0, seeds=1)
    assert verdicts(plan)["naf"] == "cannot be decided with 1 seeds"


def test_the_section_shows_all_of_it(plan):
    write_arms(plan, "trpo", 10.0)
    text = carryover.section(plan)
    assert "| C10 TRPO | TRPO with M = 10 beats itself with M = 1 | **supported** |" in text
    assert "| trpo | M = 1 | 2 (1 to 3), n = 5 |" in text
    assert (plan.results / "carryover.png").exists()
