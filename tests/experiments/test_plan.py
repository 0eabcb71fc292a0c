"""Which runs the protocol asks for, in its order, and what they are called."""

import collections

import pytest

from experiments import carryover, collapse, paper, reference, several
from experiments import plan as plan_
from experiments.plan import A3C, DDPG, MAPG, NO_NOISE, RULES, Plan, in_order, item, make_plan, name
from mapg_jax.training.config import Config


def test_steps_that_no_whole_number_of_turns_makes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must be a multiple of 40, .* got 501, and 520 is near"):
        make_plan("smoke", 501, 1, tmp_path, tmp_path)


def test_the_order_is_that_of_the_protocol(monkeypatch):
    monkeypatch.setattr(plan_, "RULES", RULES)  # of which the plan that is made here has one
    plan = Plan(Config(), None, *[None] * 2)
    ordered = paper.runs(plan, list(paper.TITLES))
    folders = [name(config, plan) for config in ordered]
    assert len(set(folders)) == len(folders)
    later = [
        *several.runs(plan),
        *collapse.runs(plan),
        *carryover.runs(plan),
        *reference.runs(plan),
    ]
    first = ordered[: -len(later)]
    assert [*in_order(plan, reversed(first)), *later] == ordered
    counts = collections.Counter(item(config, plan) for config in first)
    assert [counts[number] for number in range(1, 5)] == [76, 80, 87, 8]
    assert counts[5] == 10 * len(plan.rules())
    # NAF on two tasks, the others on four, M = 1 and 10; and the marginal ratio of two of them
    counts = collections.Counter(config.algorithm for config in later)
    small, restricted, one_is_best = 6 * 10, 2 * 5, 4 * 5  # runs of an arm
    assert len(several.runs(plan)) == 8 * (small + restricted) + 3 * one_is_best
    for module in (several, reference):
        counts = counts - collections.Counter(config.algorithm for config in module.runs(plan))
    assert counts == {"mapg": 150, "naf": 20, "trpo": 60, "ppo": 60, "td3": 40, "sac": 40}
    assert [config.seed for config in carryover.runs(plan)[:5]] == [2000] * 4 + [2001]
    assert {config.seed for config in ordered[:8]} == {2000}
    assert {(config.env, config.heads) for config in ordered[64:76]} == {
        ("humanoid", 1), ("humanoid", 10),
    }  # fmt: skip


def test_a_cell_has_the_seeds_of_the_protocol_and_no_more():
    plan = Plan(Config(), None, *[None] * 2)
    sizes = {
        (env, heads): [config.seed for config in plan.over_seeds(env, heads=heads)]
        for env in ("hopper", "humanoid")
        for heads in (1, 50)
    }
    assert {cell: len(seeds) for cell, seeds in sizes.items()} == {
        ("hopper", 1): 8, ("hopper", 50): 5, ("humanoid", 1): 6, ("humanoid", 50): 2,
    }  # fmt: skip
    assert sizes["hopper", 50] == [2000, 2001, 2002, 2003, 2004]
    assert len(plan._replace(seeds=99).over_seeds("hopper", **DDPG)) == 8


def test_names_say_what_sets_a_run_apart():
    plan = Plan(Config(), 1, *[None] * 2)
    for changes, expected in (
        ({"heads": 1}, "hopper-ddpg-m1-s2000"),
        (A3C, "hopper-a3c-m1-s2000"),
        ({**MAPG, **NO_NOISE}, "hopper-mapg-m10-none-s2000"),
        ({**MAPG, "gradient": "all"}, "hopper-mapg-m10-all-s2000"),
        ({**MAPG, "tau": 0.5}, "hopper-mapg-m10-tau0.5-s2000"),
        ({**MAPG, "algorithm": "ppo", "gradient": "marginal"}, "hopper-ppo-m10-marginal-s2000"),
    ):
        assert name(plan.config("hopper", **changes), plan) == expected
