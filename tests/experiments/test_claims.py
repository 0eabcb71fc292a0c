"""Verdicts by the protocol, from rows as the runs would have written them."""

import numpy as np
import pytest
from written import write, write_curve, write_laps

from experiments import claims, fig2, fig3, overhead, page, rows
from experiments.plan import A3C, DDPG, MAPG, NO_NOISE, make_plan
from mapg_jax.reports import inference as statistics


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 500)  # arms here are far apart
    return make_plan("paper", 1600, 5, tmp_path / "runs", tmp_path / "results")


def spread(low, n=5):
    return low + np.arange(n)


def test_a_claim_on_every_task_needs_every_task(plan):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(0))
    for env in plan.tasks[:-1]:
        write(plan, env, MAPG, spread(100))
    assert claims.c1(plan).verdict == "undecided"
    assert "swimmer missing" in claims.c1(plan).evidence
    write(plan, plan.tasks[-1], MAPG, spread(100))
    assert claims.c1(plan).verdict == "supported"


def test_one_task_contradicts(plan):
    """5 against 5 has p = 0.008, below 0.05 / 5."""
    for env in plan.tasks:
        write(plan, env, DDPG, spread(0))
        write(plan, env, MAPG, spread(-100 if env == "hopper" else 100))
    assert claims.c1(plan).verdict == "contradicted"


def test_three_seeds_against_three_decide_nothing(plan):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(0, 3))
        write(plan, env, MAPG, spread(100, 3))
    verdict = claims.c1(plan)
    assert verdict.verdict == "undecided"
    assert "hopper 1 (1 to 1), n = 3, 3" in verdict.evidence


@pytest.mark.parametrize(
    ("better", "expected"), [((), "supported"), (("swimmer",), "contradicted")]
)
def test_a3c_below_ddpg_on_every_task(plan, better, expected):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(0))
        write(plan, env, A3C, spread(100 if env in better else -100))
    assert claims.c9(plan).verdict == expected


@pytest.mark.parametrize(
    ("worse", "expected"), [(("humanoid",), "supported"), (("hopper",), "contradicted")]
)
def test_five_heads_on_all_but_humanoid(plan, worse, expected):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(0))
        write(plan, env, {"heads": 5}, spread(-100 if env in worse else 100))
    assert claims.c2b(plan).verdict == expected


@pytest.mark.parametrize(("slope", "expected"), [(1, "supported"), (-1, "contradicted")])
def test_the_score_over_m(plan, slope, expected):
    for env in ("hopper", "walker2d"):
        for m in (1, *plan.heads):
            write(plan, env, {"heads": m}, spread(100 * slope * m, 3))
    assert claims.c2a(plan).verdict == expected
    assert "n of M = 1: 3, M = 5: 3" in claims.c2a(plan).evidence


def test_noise_arms_are_told_apart(plan):
    for env in ("pendulum", "halfcheetah"):
        write(plan, env, DDPG, spread(0))
        write(plan, env, MAPG, spread(-100))
        write(plan, env, {**MAPG, **NO_NOISE}, spread(100))
    assert claims.c5a(plan).verdict == "supported"
    assert claims.c5b(plan).verdict == "contradicted"


@pytest.mark.parametrize(
    ("shares", "c6a", "c6b"),
    [
        ((0.0, 0.0, 0.0), "contradicted", "supported"),
        ((0.6, 0.0, 1.0), "supported", "contradicted"),
        ((0.1, 0.2, 0.0), "undecided", "undecided"),
        ((1.0, 1.0), "undecided", "undecided"),
    ],
)
def test_laps(plan, shares, c6a, c6b):
    for changes in (DDPG, MAPG):
        write_laps(plan, changes, shares)
    assert claims.c6a(plan).verdict == c6a
    assert claims.c6b(plan).verdict == c6b
    assert f"mean {np.mean(shares):.3g} (" in claims.c6a(plan).evidence


@pytest.mark.parametrize(("spike", "expected"), [(8.0, "supported"), (1.0, "undecided")])
def test_spread_that_falls_with_spikes(plan, spike, expected):
    steps = np.arange(1.0, 41)
    for seed in range(4):
        spread = 1 / steps
        spread[35] *= spike + seed / 100
        write_curve(plan, "pendulum", seed, env_steps=steps, return_mean=steps - 10, spread=spread)
    assert fig2.statistics_by_seed(plan).with_step[0] < -0.8
    assert claims.c3(plan).verdict == expected


@pytest.mark.parametrize("by", ["step", "return"])
def test_spread_that_grows_with_either_contradicts_c3(plan, by):
    steps = np.arange(1.0, 41)
    for seed in range(3):
        spread = steps + seed if by == "step" else 1 / (steps + seed)
        score = steps if by == "step" else -steps
        write_curve(plan, "pendulum", seed, env_steps=steps, return_mean=score, spread=spread)
    assert claims.c3(plan).verdict == "contradicted"


@pytest.mark.parametrize(
    ("hanging", "upright", "expected"),
    [(0.4, 0.1, "supported"), (0.05, 0.1, "contradicted"), (0.4, 0.001, "contradicted")],
)
def test_spread_by_angle(plan, hanging, upright, expected):
    for seed in range(3):
        key = rows.identity(plan.config("pendulum", seed, **MAPG))
        lines = []
        for angle in range(-175, 180, 10):
            value = hanging if abs(angle) < 30 else upright if abs(angle) > 150 else 0.2
            value *= 1 + 0.01 * seed
            lines.append({**key, "angle": angle, "states": 7, "spread": value})
        rows.append(plan.measured / fig3.BINS, lines)
    assert np.allclose(fig3.spread_by_seed(plan)["between"], [0.2, 0.202, 0.204])
    assert claims.c4(plan).verdict == expected


def test_seeds_that_never_stand_upright_are_counted(plan):
    for seed in range(3):
        key = rows.identity(plan.config("pendulum", seed, **MAPG))
        seen = [{**key, "angle": a, "states": 1, "spread": 0.1 + seed} for a in (5.0, 95.0)]
        rows.append(plan.measured / fig3.BINS, seen)
    verdict = claims.c4(plan)
    assert verdict.verdict == "undecided"
    assert "spread beyond 150° missing; n = 3, 3 of them without" in verdict.evidence


@pytest.mark.parametrize(("ratio", "expected"), [(1.3, "supported"), (1.8, "contradicted")])
def test_overhead_is_judged_round_by_round(plan, ratio, expected):
    lines = [
        {"heads": m, "round": r, "seconds_per_step": (1 + r) * (ratio + 0.01 * r if m == 10 else 1)}
        for r in range(7)
        for m in (1, 10)
    ]
    rows.append(plan.measured / overhead.TIMES, lines)
    assert claims.c7(plan).verdict == expected


@pytest.mark.parametrize(
    ("last", "expected"), [(0.01, "supported"), (0.4, "contradicted"), (0.1, "undecided")]
)
def test_gaps_of_q(plan, last, expected):
    """Of the last evaluation, on every task; one task contradicts."""
    for env in plan.tasks:
        for seed in range(3):
            gap = np.array([5.0, (last if env == "humanoid" else 0.01) * (0.9 + 0.1 * seed)])
            steps = np.array([1.0, 2.0])
            write_curve(plan, env, seed, env_steps=steps, q_gap_relative=gap)
    assert claims.c8(plan).verdict == expected


def test_a_seed_without_a_number_leaves_its_claim_undecided_and_is_counted(plan):
    steps = np.arange(1.0, 41)
    for seed in range(4):
        spread = np.full(40, 0.5) if seed == 2 else 1 / steps  # which has no rank
        write_curve(plan, "pendulum", seed, env_steps=steps, return_mean=steps, spread=spread)
        write_curve(plan, "hopper", seed, env_steps=steps, q_gap_relative=spread * np.nan)
    verdict = claims.c3(plan)
    assert verdict.verdict == "undecided"
    assert "n = 4, 1 of them without such a number" in verdict.evidence
    assert "hopper missing, n = 4, 4 of them without such a number" in claims.c8(plan).evidence


def test_without_results_nothing_is_decided(plan):
    verdicts = {verdict.claim: verdict.verdict for verdict in claims.ledger(plan)}
    assert verdicts.pop("C10") == "not tested"
    assert set(verdicts.values()) == {"undecided"}
    text = page.write(plan, page.sections(plan)).read_text()
    assert "missing" in text and "C10" in text
