"""Tests over several tasks, against the enumeration of all permutations."""

import itertools

import numpy as np
import pytest
import scipy.stats

from mapg_jax.reports import inference
from mapg_jax.reports.stratified import effect, least_p, power, van_elteren


def enumerated(tasks):
    """T of every choice of runs within every task; the one seen first."""
    terms = []
    for new, old in tasks:
        ranks = scipy.stats.rankdata([*new, *old])
        n, size = len(new), len(ranks)
        choices = itertools.combinations(range(size), n)
        terms.append([(ranks[list(c)].sum() - n * (size + 1) / 2) / (size + 1) for c in choices])
    return np.array([sum(choice) for choice in itertools.product(*terms)])


@pytest.mark.parametrize(
    "tasks",
    [
        [([3, 5, 9], [1, 2, 4])],
        [([3, 5, 9], [1, 2, 4]), ([0, 7], [1, 2, 8])],
        [([1, 1, 2], [1, 2, 2]), ([5], [4, 5, 6]), ([1, 2], [3, 4])],  # ties
    ],
)
def test_the_test_counts_all_permutations(tasks):
    every = enumerated(tasks)
    found = van_elteren(tasks)
    assert found.statistic == pytest.approx(every[0])
    near = 1e-9
    assert found.above == pytest.approx((every >= every[0] - near).mean())
    assert found.below == pytest.approx((every <= every[0] + near).mean())
    assert found.either == pytest.approx((np.abs(every) >= abs(every[0]) - near).mean())


def test_on_one_task_it_is_the_rank_sum_test():
    rng = np.random.default_rng(1)
    new, old = rng.normal(0.8, 1, 8), rng.normal(0, 1, 6)
    found = van_elteren([(new, old)])
    assert found.either == pytest.approx(inference.rank_sum_p(new, old))
    one_sided = scipy.stats.mannwhitneyu(new, old, alternative="greater", method="exact")
    assert found.above == pytest.approx(one_sided.pvalue)


def test_the_least_p_is_that_of_arms_that_do_not_overlap():
    tasks = [([5, 6, 7], [1, 2]), ([8, 9], [1, 2, 3, 4])]
    assert least_p([(3, 2), (2, 4)]) == pytest.approx(van_elteren(tasks).above) == 1 / 10 / 15


def test_the_effect_is_a_half_where_the_statistic_is_0_and_1_where_the_new_arm_always_wins():
    tasks = [([1, 4], [2, 3]), ([5, 5], [5, 5, 5])]
    assert van_elteren(tasks).statistic == pytest.approx(0)
    assert effect(tasks).value == pytest.approx(0.5)
    assert tuple(effect([([5, 6, 7], [1, 2, 3])])) == (1, 1, 1)


def test_power_is_the_level_without_a_difference_and_1_with_a_large_one():
    rng = np.random.default_rng(0)
    cells = [(rng.normal(size=400), rng.normal(size=400)) for _ in range(3)]
    nothing = [(new[:8] - new[:8].mean(), new[:8] - new[:8].mean()) for new, _ in cells]
    found = power(nothing)  # two-sided 0.05, of which half is above; ties between arms cost some
    assert found.together < 0.025 + 4 * np.sqrt(0.025 / 1000) and found.each < 0.01
    assert power([(new[:8] + 9, old[:8]) for new, old in cells]) == (1, 1)


def test_a_task_without_an_arm_is_refused():
    with pytest.raises(ValueError, match="every task needs scores of both arms"):
        van_elteren([([1.0], [])])
    with pytest.raises(ValueError, match="not finite"):
        van_elteren([([1.0], [np.nan])])
