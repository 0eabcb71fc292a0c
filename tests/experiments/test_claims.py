"""Verdicts by version 2 of the protocol, from rows as the runs would have written them."""

import numpy as np
import pytest
from written import ON_ONE, result, write, write_curve, write_laps

from experiments import (
    claims,
    curves,
    fig2,
    fig3,
    growth,
    overhead,
    page,
    returns,
    rows,
    scores,
    table2,
)
from experiments.comparisons import judge
from experiments.plan import A3C, DDPG, DRIVING, FIRST_SEED, MAPG, NO_NOISE, make_plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.results_csv import append_csv


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 100)  # arms here are far apart
    return make_plan("paper", 1600, 5, tmp_path / "runs", tmp_path / "results")


def spread(low, n=5):
    return low + np.arange(n)


def both(plan, name):
    """The two forms of a claim of two arms."""
    (comparison,) = (c for c in claims.comparisons(plan) if c.claims[0] == name)
    return judge(plan, comparison)


def verdicts(plan, name):
    return [verdict.verdict for verdict in both(plan, name)]


def finish(plan, config):
    """A run that is judged by other numbers than its score."""
    append_csv(scores.path(plan), [result(config, 0.0)])


def test_a_claim_waits_for_every_run_of_every_task(plan):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(50))
    for env in plan.tasks[:-1]:
        write(plan, env, MAPG, spread(100))
    assert verdicts(plan, "C1a") == ["not yet: 45 of 50 runs"] * 2
    assert both(plan, "C1a")[0].evidence == "runs missing: swimmer 5"
    write(plan, plan.tasks[-1], MAPG, spread(100, 4))
    assert verdicts(plan, "C1a") == ["not yet: 49 of 50 runs"] * 2
    diverged = plan.config(plan.tasks[-1], FIRST_SEED + 4, **MAPG)
    rows.append(plan.measured / rows.DIVERGED, [{**rows.identity(diverged), "reason": ""}])
    assert verdicts(plan, "C1a") == ["supported"] * 2
    assert both(plan, "C1a")[0].effect == "P 1.00 (1.00 to 1.00)"


def test_a_claim_waits_for_what_was_measured_on_its_runs(plan):
    """C3 is judged by curves: scores alone are not enough, and the others are not left out."""
    runs = fig2.runs(plan)
    for config in runs:
        finish(plan, config)
    for config in runs[:4]:
        write_curve(plan, config, spread=[1.0, 2.0])
    assert claims.c3(plan).verdict == "not yet: measured on 4 of 5 runs"
    write_curve(plan, runs[4], spread=[1.0, 2.0])
    assert not claims.c3(plan).verdict.startswith("not yet")


def test_a_run_counts_once(plan):
    """One that is said to have diverged hides no other one that is missing."""
    for env in plan.studied:
        write(plan, env, DDPG, spread(50))
        write(plan, env, MAPG, spread(100, 4))
    lost = rows.identity(plan.config(plan.studied[0], FIRST_SEED + 4, **MAPG))
    rows.append(plan.measured / rows.DIVERGED, [{**lost, "reason": ""}] * 2)
    assert verdicts(plan, "C5b together") == ["not yet: 19 of 20 runs"] * 2
    scored = rows.identity(plan.config(plan.studied[0], FIRST_SEED, **MAPG))
    rows.append(plan.measured / rows.DIVERGED, [{**scored, "reason": ""}])
    with pytest.raises(ValueError, match=r"pendulum, mapg, 10, 2000, .*which has a score too"):
        both(plan, "C5b together")


def test_one_task_contradicts_what_holds_of_them_together(plan):
    """5 against 5 has p = 0.004, below 0.05 / 5."""
    for env in plan.tasks:
        write(plan, env, DDPG, spread(50))
        write(plan, env, MAPG, spread(10 if env == "hopper" else 100))
    assert verdicts(plan, "C1a") == ["supported", "contradicted"]
    assert (
        "(one against below 0.01 contradicts): hopper 1 / 0.00397;" in both(plan, "C1a")[1].evidence
    )


def test_what_so_few_seeds_cannot_reach_is_not_called_undecided(plan):
    """3 against 3 has p = 0.05 at best, on one task; on two of them together 0.005."""
    plan = plan._replace(seeds=3)
    for env in plan.studied:
        write(plan, env, DDPG, [1, 3, 5])
        write(plan, env, MAPG, [2, 4, 6])
    together, each = both(plan, "C5b together")
    assert together.verdict == "undecided" and together.power.endswith("%")
    assert each.verdict == "cannot be decided with 3 seeds" and each.power == ""


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [(1.01, "smaller than the paper's"), (3.0, "not shown to be smaller than the paper's")],
)
def test_the_papers_size_is_tested_beside_the_sign(plan, ratio, expected):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(100))
        write(plan, env, MAPG, ratio * spread(100))
    (together, _) = both(plan, "C1a")
    assert f"; {expected} difference, p = " in together.evidence
    assert table2.ratio("hopper", "M = 10") == pytest.approx(824 / 603)
    assert table2.ratio("hopper", "M = 5") is None


def test_the_second_score_is_printed_and_decides_nothing(plan):
    for env in plan.studied:
        write(plan, env, DDPG, spread(50))
        write(plan, env, MAPG, spread(100))
        for seed in range(5):
            for arm, late in ((MAPG, 1.0), (DDPG, 9.0)):
                steps = np.arange(1.0, 13.0)
                score = np.where(steps <= 2, 1000.0, late + seed)
                key = rows.identity(plan.config(env, FIRST_SEED + seed, **arm))
                numbers = dict.fromkeys(curves.COLUMNS, 0.0)
                lines = [
                    {**key, **numbers, "env_steps": t, "return_mean": x}
                    for t, x in zip(steps, score, strict=True)
                ]
                rows.append(plan.measured / curves.FILE, lines)
    assert np.allclose(curves.late(plan, plan.over_seeds("halfcheetah", **DDPG)), spread(9.0))
    (together, _) = both(plan, "C5b together")
    assert together.verdict == "supported"
    assert "by the second score p = 3.1e-05, below" in together.evidence


@pytest.mark.parametrize(
    ("better", "expected"), [((), "supported"), (("swimmer",), "contradicted")]
)
def test_a3c_below_ddpg_on_every_task(plan, better, expected):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(200))
        write(plan, env, A3C, spread(300 if env in better else 100))
    assert verdicts(plan, "C9 together") == ["supported", expected]


def test_five_heads_on_all_but_humanoid(plan):
    for env in plan.tasks:
        write(plan, env, DDPG, spread(200))
        write(plan, env, {"heads": 5}, spread(100 if env == "humanoid" else 300))
    assert verdicts(plan, "C2b together") == ["supported"] * 2


@pytest.mark.parametrize(("slope", "expected"), [(1, "supported"), (-1, "contradicted")])
def test_the_score_over_m(plan, slope, expected):
    plan = plan._replace(seeds=3)
    for env in ("hopper", "walker2d"):
        for m in (1, *plan.heads):
            write(plan, env, {"heads": m}, spread(100 * slope * m, 3))
    assert growth.c2a(plan).verdict == expected


def test_the_power_of_growth_is_of_the_papers_means_and_of_the_scatter():
    """They grow on Walker2d, and on Hopper up to M = 20, by more than half of DDPG's mean."""

    def chance(scatter):
        of_m = 500 + scatter * spread(-3.5, 8)
        return growth.power({env: dict.fromkeys((1, 5, 10, 20, 50), of_m) for env in growth.ENVS})

    assert chance(0.01) == 1.0
    assert chance(1000.0) < 0.05


def test_undecided_growth_prints_its_power(plan):
    plan = plan._replace(seeds=3)
    for env in growth.ENVS:
        for m in (1, *plan.heads):
            write(plan, env, {"heads": m}, spread(500, 3))
    verdict = growth.c2a(plan)
    assert verdict.verdict == "undecided" and verdict.power.endswith("%")


def test_noise_arms_are_told_apart(plan):
    for env in ("pendulum", "halfcheetah"):
        write(plan, env, DDPG, spread(0))
        write(plan, env, MAPG, spread(-100))
        write(plan, env, {**MAPG, **NO_NOISE}, spread(100))
    assert verdicts(plan, "C5a together") == ["supported"] * 2
    assert verdicts(plan, "C5b together") == ["contradicted"] * 2


@pytest.mark.parametrize(
    ("shares", "c6a", "c6b"),
    [
        ((0.0, 0.0, 0.0), "contradicted", "supported"),
        ((0.6, 0.0, 1.0), "supported", "contradicted"),
        ((0.1, 0.2, 0.0), "undecided", "undecided"),
        ((1.0, 1.0), "cannot be decided with 2 seeds", "cannot be decided with 2 seeds"),
    ],
)
def test_laps(plan, shares, c6a, c6b):
    plan = plan._replace(seeds=len(shares))
    for changes in (DDPG, MAPG):
        write_laps(plan, changes, shares)
    assert claims.c6a(plan).verdict == c6a
    assert claims.c6b(plan).verdict == c6b
    assert f"{np.mean(shares):.2f} (" in claims.c6a(plan).effect


def test_a_score_of_driving_without_laps_is_refused(plan):
    plan = plan._replace(seeds=1)
    write(plan, "driving", {**DRIVING, **MAPG}, [100.0])
    with pytest.raises(ValueError, match="driving, seed 2000 has no lap_share; leave it out"):
        claims.c6a(plan)


def learning(seed, steps, sign):
    """Spread that falls with steps; what is left of it goes with the return, or against it."""
    noise = np.random.default_rng(seed).normal(size=len(steps))
    return np.exp(-steps / steps[-1] + 0.1 * noise), steps - sign * 20 * noise


@pytest.mark.parametrize(("sign", "expected"), [(1, "supported"), (-1, "contradicted")])
def test_spread_and_return_less_what_both_owe_to_time(plan, sign, expected):
    steps = np.arange(1.0, 401)
    for config in fig2.runs(plan):
        seed = config.seed - FIRST_SEED
        values, score = learning(seed, steps, sign)
        values[300] *= 100
        finish(plan, config)
        write_curve(plan, fig2.runs(plan)[seed], env_steps=steps, return_mean=score, spread=values)
    found = fig2.by_seed(plan)
    assert max(found.with_step) < -0.1
    assert (np.sign(found.with_return) == -sign).all()
    assert min(found.spikes) > 1
    assert claims.c3(plan).verdict == expected


def test_a_drift_that_both_share_is_no_relation():
    time = np.arange(30.0)
    assert fig2.correlation(time, -time) == -1
    assert np.isnan(fig2.detrended(time, -time, time))
    x = np.array([1, 4, 2, 8, 5, 7.0])
    assert fig2.detrended(x, x, np.arange(6)) == pytest.approx(1)


def test_the_height_of_a_spike_is_that_of_its_lower_flank():
    flat = np.exp([0.0, 0, 3, 1, 1, 1])
    increments = np.diff(np.log(flat))
    assert fig2._highest(increments) == pytest.approx(2)
    assert np.isnan(fig2.spike_excess(np.zeros(9)))
    steady = np.exp(np.arange(9.0))  # whatever the order of its increments
    assert fig2.spike_excess(steady) == pytest.approx(0)


def test_noise_about_a_level_has_spikes_over_a_random_walk_and_none_over_itself():
    """Of 50 series; why what C3 says of spikes is printed beside another number."""
    noise = np.exp(np.random.default_rng(0).normal(size=(50, 200)))
    walk, itself = (
        np.array([fig2.spike_excess(of_one, 200, levels) for of_one in noise])
        for levels in (False, True)
    )
    error = 0.5 / np.sqrt(len(noise))
    assert (walk > 0).mean() > 0.5 + 6 * error
    assert (itself > 0).mean() == pytest.approx(0.5, abs=4 * error)


@pytest.mark.parametrize(
    ("hanging", "upright", "peak", "top"),
    [
        (0.4, 0.1, "supported", "supported"),
        (0.05, 0.1, "contradicted", "supported"),
        (0.4, 0.001, "supported", "contradicted"),
    ],
)
def test_spread_by_angle(plan, hanging, upright, peak, top):
    for config in fig3.runs(plan):
        level = (hanging, 0.2, upright) if config in fig3.judged(plan) else (0.01, 0.01, 0.01)
        lines = []
        for angle in range(-175, 180, 10):
            value = level[0] if abs(angle) < 30 else level[2] if abs(angle) > 150 else level[1]
            value *= 1 + 0.01 * (config.seed - FIRST_SEED)
            lines.append({**rows.identity(config), "angle": angle, "states": 7, "spread": value})
        rows.append(plan.measured / fig3.BINS, lines)
        finish(plan, config)
    between = fig3.spread_by_seed(plan, fig3.judged(plan))["between"]
    assert np.allclose(between[:3], [0.2, 0.202, 0.204])
    assert (claims.c4a(plan).verdict, claims.c4b(plan).verdict) == (peak, top)


@pytest.mark.parametrize(("ratio", "expected"), [(1.3, "supported"), (1.8, "contradicted")])
def test_overhead_is_judged_round_by_round(plan, ratio, expected):
    rows.append(plan.measured / overhead.TIMES, timed(ratio))
    assert claims.c7(plan).verdict == expected


def timed(ratio, **where):
    """Seven rounds, each slower than the last."""
    return [
        {"heads": m, "round": r, "seconds_per_step": (1 + r) * (ratio + 0.01 * r if m == 10 else 1),
         **ON_ONE, **where}
        for r in range(7)
        for m in (1, 10)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([*timed(1.3), *timed(1.3, processor="B")], "timings of two machines or programs"),
        ([*timed(1.3), *timed(1.3)], "not one time of every M in every round"),
        (timed(1.3)[:-1], "not one time of every M in every round"),
        (timed(1.3)[1::2], "not one time of every M in every round"),  # none of M = 1
    ],
)
def test_times_of_two_timings_are_not_one(plan, lines, message):
    rows.append(plan.measured / overhead.TIMES, lines)
    with pytest.raises(ValueError, match=message):
        claims.c7(plan)


@pytest.mark.parametrize(
    ("last", "expected"), [(0.01, "supported"), (0.4, "contradicted"), (0.1, "undecided")]
)
def test_heads_that_are_worth_the_same(plan, last, expected):
    """On every task; one task contradicts."""
    for env in plan.tasks:
        for k, config in enumerate(plan.over_seeds(env, **MAPG)):
            ours = (last if env == "humanoid" else 0.01) * (0.9 + 0.05 * k)
            numbers = {"between_heads": ours, "held": 1.0, "between_actions": 1.0, "q_gap": 0.0}
            rows.append(plan.measured / returns.FILE, [{**rows.identity(config), **numbers}])
            finish(plan, config)
    verdict = claims.c8(plan)
    assert verdict.verdict == expected
    assert verdict.power == ("100%" if expected == "undecided" else "")  # with so little scatter


def test_scatter_between_actions_is_that_of_their_expected_returns():
    """20,000 states with a known scatter of 0.5 and a noise of 2 over 8 repeats."""
    rng = np.random.default_rng(0)
    means = 0.5 * rng.normal(size=(20_000, 10, 1))
    assert returns.scatter(means + 2 * rng.normal(size=(20_000, 10, 8))) == pytest.approx(
        0.5, abs=0.02
    )
    assert returns.scatter(np.zeros((3, 10, 8))) == 0


def test_a_seed_without_a_number_leaves_its_claim_undecided_and_is_counted(plan):
    steps = np.arange(1.0, 41)
    for config in fig2.runs(plan):
        seed = config.seed - FIRST_SEED
        values = np.full(40, 0.5) if seed == 2 else 1 / steps  # which has no rank
        write_curve(plan, fig2.runs(plan)[seed], env_steps=steps, return_mean=steps, spread=values)
        finish(plan, config)
    verdict = claims.c3(plan)
    assert verdict.verdict == "undecided"
    assert "of them without such a number" in verdict.evidence


def test_without_results_nothing_is_decided(plan):
    found = {verdict.claim: verdict.verdict for verdict in claims.ledger(plan)}
    assert all(verdict.startswith("not yet: 0 of ") for verdict in found.values())
    text = page.write(plan, page.sections(plan)).read_text()
    assert "missing" in text and "C10" in text


def test_version_1_stands_beside_it_as_it_was_recorded(plan):
    recorded = {"C1": "undecided", "C2b": "supported", "C4": "contradicted"}
    lines = [{"claim": k, "text": "", "evidence": "", "verdict": v} for k, v in recorded.items()]
    rows.append(plan.results / claims.EARLIER, lines)
    names = ("C1a", "C1b", "C2b together", "C2b each", "C4a")
    assert [claims.earlier(plan, claim) for claim in names] == [
        "not tested", "undecided", "not tested", "supported", "contradicted, as one C4",
    ]  # fmt: skip
