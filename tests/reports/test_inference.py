"""Intervals and comparisons against closed forms, brute force and simulation."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from mapg_jax.reports import inference as statistics
from mapg_jax.reports.inference import (
    RESAMPLES,
    Estimate,
    bootstrap,
    compare,
    interquartile_mean,
    mean,
    mean_probability_of_improvement,
    median,
    probability_of_improvement,
    rank_sum_p,
    spearman,
    student,
    verdict,
)


def assert_is_the_percentile_interval(estimate, every_resample, level=0.95):
    """Between the exact quantiles 5 standard errors of 10,000 draws below and above."""
    tail = (1 - level) / 2
    error = 5 * math.sqrt(tail * (1 - tail) / RESAMPLES)
    for got, q in ((estimate.low, tail), (estimate.high, 1 - tail)):
        low = np.quantile(every_resample, max(q - error, 0), method="lower")
        high = np.quantile(every_resample, min(q + error, 1), method="higher")
        assert low - 1e-12 <= got <= high + 1e-12


def resamples(sample):
    return list(itertools.product(sample, repeat=len(sample)))


@pytest.mark.parametrize("level", [0.95, 0.99, 0.8])
@pytest.mark.parametrize(
    ("aggregate", "by_hand"),
    [
        (mean, lambda x: sum(x) / len(x)),
        (median, lambda x: sorted(x)[len(x) // 2]),
        (interquartile_mean, lambda x: sum(sorted(x)[1:-1]) / 3),
    ],
)
def test_aggregates_of_five_seeds_against_all_resamples(aggregate, by_hand, level):
    scores = [3.0, 10.0, 4.5, 8.0, -20.0]
    estimate = aggregate(scores, level)
    assert estimate.value == pytest.approx(by_hand(scores), abs=1e-12)
    assert_is_the_percentile_interval(estimate, [by_hand(x) for x in resamples(scores)], level)


def improvement_by_hand(new, old):
    wins = [1.0 if y > x else 0.5 if y == x else 0.0 for y in new for x in old]
    return sum(wins) / len(wins)


def test_probability_of_improvement_against_all_resamples():
    new, old = [5.0, 1.0, 7.0], [2.0, 5.0, 0.0, 1.0]
    estimate = probability_of_improvement(new, old)
    assert estimate.value == pytest.approx(improvement_by_hand(new, old))
    every = [improvement_by_hand(y, x) for y in resamples(new) for x in resamples(old)]
    assert_is_the_percentile_interval(estimate, every)


def test_strata_are_resampled_apart():
    """Over two tasks: the mean, and an interval from all resamples within each cell."""
    tasks = [([5.0, 1.0, 3.0], [2.0, 4.0, 0.0]), ([-1.0, 30.0, 8.0], [7.0, 9.0, 9.5])]
    estimate = mean_probability_of_improvement(tasks)
    by_task = [improvement_by_hand(*task) for task in tasks]
    assert estimate.value == pytest.approx(np.mean(by_task))
    cells = [[improvement_by_hand(y, x) for y in resamples(n) for x in resamples(o)]
             for n, o in tasks]  # fmt: skip
    every = np.add.outer(*cells).ravel() / 2
    assert_is_the_percentile_interval(estimate, every)


def test_improvement_and_its_opposite_sum_to_one():
    rng = np.random.default_rng(0)
    for n, m in ((1, 1), (3, 4), (6, 7)):
        y, x = rng.integers(0, 6, n), rng.integers(0, 6, m)
        there, back = probability_of_improvement(y, x), probability_of_improvement(x, y)
        assert there.value + back.value == pytest.approx(1, abs=1e-12)
        assert rank_sum_p(y, x) == pytest.approx(rank_sum_p(x, y), abs=1e-12)
    assert probability_of_improvement([1.0, 2.0], [1.0, 2.0]).value == 0.5


def test_the_order_of_seeds_changes_nothing_and_reruns_agree():
    scores = [3.0, 10.0, 4.5, 8.0, -20.0]
    assert mean(scores) == mean(scores) == mean(scores[::-1])
    assert compare(scores, scores[:3]) == compare(scores[::-1], scores[2::-1])


def test_one_seed_has_no_interval():
    one, two = [4.0], [1.0, 2.0]
    single = [f(one) for f in (mean, median, interquartile_mean, student)]
    for estimate in [
        *single,
        probability_of_improvement(one, two),
        probability_of_improvement(two, one),
        mean_probability_of_improvement([(two, two), (one, two)]),
        spearman({1: two, 10: one}),
    ]:
        assert math.isfinite(estimate.value)
        assert math.isnan(estimate.low)
        assert math.isnan(estimate.high)
    assert [estimate.value for estimate in single] == [4.0] * 4


def test_equal_seeds_have_an_interval_without_width():
    """Several seeds that agree are no missing interval."""
    for aggregate in (mean, median, interquartile_mean, student):
        assert aggregate([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)


def test_coverage_of_the_mean():
    """Of normal scores the interval covers the truth as often as theory says, within 4 errors.

    The bootstrap's spread is s √((n - 1) / n) and it knows no Student, so that it covers
    P(|t| < z √((n - 1) / n)) and not 95 %: 0.899 for ten seeds.
    """
    rng, trials, n = np.random.default_rng(1), 600, 10
    intervals = [mean(rng.normal(size=n)) for _ in range(trials)]
    covered = np.mean([low < 0 < high for _, low, high in intervals])
    expected = 1 - 2 * stats.t.sf(1.96 * math.sqrt((n - 1) / n), n - 1)
    # A hundredth more for resamples of ten seeds, which are not quite normal.
    error = 4 * math.sqrt(expected * (1 - expected) / trials) + 0.01
    assert abs(covered - expected) < error


def test_student_is_the_t_test():
    values = [0.3, -0.1, 0.7, 0.2]
    for level in (0.95, 0.99):
        expected = stats.ttest_1samp(values, 0).confidence_interval(level)
        assert student(values, level)[1:] == pytest.approx(tuple(expected))
    assert student(values).value == pytest.approx(0.275)


def test_student_covers_as_often_as_it_says():
    rng, trials = np.random.default_rng(2), 4000
    intervals = [student(rng.normal(size=3)) for _ in range(trials)]
    covered = np.mean([low < 0 < high for _, low, high in intervals])
    assert abs(covered - 0.95) < 4 * math.sqrt(0.95 * 0.05 / trials)


def rank_sum_by_hand(new, old):
    """Twice the smaller tail of U over all ways to name the arms."""
    scores, n = [*new, *old], len(new)
    every = []
    for chosen in itertools.combinations(range(len(scores)), n):
        y = [scores[i] for i in chosen]
        x = [scores[i] for i in range(len(scores)) if i not in chosen]
        every.append(improvement_by_hand(y, x))
    got, every = improvement_by_hand(new, old), np.array(every)
    return min(1, 2 * min(np.mean(every >= got - 1e-9), np.mean(every <= got + 1e-9)))


@pytest.mark.parametrize(
    ("new", "old"),
    [
        ([4.0, 5.0, 6.0], [1.0, 2.0, 3.0]),
        ([4.0, 5.0, 6.0, 1.5], [1.0, 2.0, 3.0, 9.0, 8.0]),
        ([1.0, 1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 2.0]),  # ties
        ([1.0, 1.0], [1.0, 1.0, 1.0]),
        ([7.0], [8.0]),
        ([7.0], [7.0]),
        ([7.0], [7.0, 9.0, 7.0]),
        ([1.0, 1.0, 2.0, 2.0, 5.0], [1.0]),
    ],
)
def test_rank_sum_against_all_permutations(new, old):
    assert rank_sum_p(new, old) == pytest.approx(rank_sum_by_hand(new, old), abs=1e-12)


def test_known_p():
    """Three against three cannot go below 0.1, four against four reach 2 / 70."""
    assert rank_sum_p([4, 5, 6], [1, 2, 3]) == pytest.approx(0.1)
    assert rank_sum_p([5, 6, 7, 8], [1, 2, 3, 4]) == pytest.approx(2 / 70)


def test_ten_against_ten_with_ties_have_room_for_all_permutations():
    assert math.comb(20, 10) <= statistics.PERMUTATIONS


def test_spearman_is_scipys_and_its_interval_all_resamples():
    groups = {1: [1.0, 4.0, 0.5], 5: [2.0, 3.0, 2.5], 20: [5.0, 3.5, 1.5]}
    estimate = spearman(groups)

    def by_hand(*samples):
        scores = [score for sample in samples for score in sample]
        return stats.spearmanr(np.repeat([1, 5, 20], 3), scores).statistic

    assert estimate.value == pytest.approx(by_hand(*groups.values()))
    every = [by_hand(*s) for s in itertools.product(*(resamples(g) for g in groups.values()))]
    assert_is_the_percentile_interval(estimate, every)
    assert spearman({1: [1.0, 2.0], 10: [3.0, 4.0, 5.0], 50: [6.0, 7.0]}).value > 0.9
    assert spearman({1: [1.0] * 3, 10: [1.0] * 3}) == (0, 0, 0)


def test_verdicts():
    clear, touching, missing = (
        Estimate(0.9, 0.7, 1.0),
        Estimate(0.8, 0.5, 1.0),
        Estimate(1.0, math.nan, math.nan),
    )
    assert verdict(clear, 0.5, 3) == "above"
    assert verdict(clear, 1.1, 3) == "below"
    assert verdict(clear, 0.5, 2) == "undecided"
    assert verdict(touching, 0.5, 9) == "undecided"
    assert verdict(missing, 0.5, 9) == "undecided"
    assert verdict(clear, 0.5, 3, p=0.049) == "above"
    assert verdict(clear, 0.5, 3, p=0.05) == "undecided"
    assert verdict(clear, 0.5, 3, p=0.01, level=1 - 0.05 / 5) == "undecided"
    assert verdict(clear, 0.5, 3, p=0.0099, level=1 - 0.05 / 5) == "above"


def test_three_against_three_decide_nothing_and_four_against_four_may():
    """All pairs are won, and the bootstrap says [1, 1]; by chance that is one time in ten."""
    three = compare([4, 5, 6], [1, 2, 3])
    assert three.improvement == (1, 1, 1)
    assert (three.p, three.seeds, three.verdict) == (pytest.approx(0.1), (3, 3), "undecided")
    four = compare([5, 6, 7, 8], [1, 2, 3, 4])
    assert four.verdict == "above"
    assert compare([1, 2, 3, 4], [5, 6, 7, 8]).verdict == "below"
    assert compare([5, 6, 7, 8], [1, 2, 3, 4], level=0.99).verdict == "undecided"


def test_a_verdict_is_rarely_wrong():
    """Arms that do not differ are called different in at most 5 % of trials, within 4 errors."""
    rng, trials = np.random.default_rng(3), 300
    wrong = sum(
        compare(rng.normal(size=5), rng.normal(size=5)).verdict != "undecided"
        for _ in range(trials)
    )
    assert wrong / trials < 0.05 + 4 * math.sqrt(0.05 * 0.95 / trials)


def test_a_number_that_a_seed_lacks_has_no_mean():
    for values in ([], [1.0, math.nan], [1.0, -math.inf]):
        assert all(map(math.isnan, student(values)))


def test_an_estimate_as_text():
    assert f"{Estimate(0.123456, 0.1, 0.2):.3g}" == "0.123 (0.1 to 0.2)"
    assert f"{Estimate(0.5, math.nan, math.nan):.0%}" == "50% (no interval)"
    assert f"{student([]):.3g}" == "missing"


def test_bad_scores_are_refused():
    for scores, message in (([], "no scores"), ([1.0, math.nan], "not finite")):
        with pytest.raises(ValueError, match=message):
            mean(scores)
        with pytest.raises(ValueError, match=message):
            probability_of_improvement([1.0, 2.0], scores)
    with pytest.raises(ValueError, match="no scores"):
        bootstrap([], np.mean)


def test_holm_adjusts_as_his_procedure_decides():
    """Rejecting while the i-th least p is at most level / (k - i + 1), i from 1."""
    rng = np.random.default_rng(3)
    for ps in rng.uniform(0, 0.1, (200, 5)):
        adjusted = statistics.holm(ps)
        for level in (0.01, 0.05, 0.1):
            rejected, open_ = set(), list(np.argsort(ps))
            while open_ and ps[open_[0]] <= level / len(open_):
                rejected.add(open_.pop(0))
            assert {i for i in range(5) if adjusted[i] <= level} == rejected
    assert statistics.holm([0.5, 0.02]) == [0.5, 0.04]
