"""A run has diverged when any number that it learns is not finite."""

import jax
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms.deterministic import UpdateMetrics
from mapg_jax.runs.member import DivergedError, Member
from mapg_jax.training.state import Totals


def totals(broken=0):
    """Since the last row."""
    return Totals(0, (), 0, 0, 0, np.float32(broken))


@pytest.fixture(scope="module")
def member_and_learner(tmp_path_factory):
    """Of a run that has not begun: there is a checkpoint of step 0 alone."""
    folder = oracles.untrained_run(oracles.TINY, tmp_path_factory.mktemp("runs") / "run")
    return Member(folder), jax.device_get(oracles.newest_state(folder).agent.learner)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_any_parameter_that_is_not_finite_is_a_divergence(member_and_learner, value):
    """Of actor, critic, targets and optimisers, one number each."""
    member, learner = member_and_learner
    leaves, structure = jax.tree.flatten(learner)
    member.failure = None
    member.check_finite(learner, -1, totals(), 40)
    assert member.failure is None
    floats = [i for i, leaf in enumerate(leaves) if np.issubdtype(leaf.dtype, np.floating)]
    assert len(floats) > 40
    for i in floats:
        leaf = np.array(leaves[i])
        leaf.flat[-1] = value
        member.failure = None
        broken = structure.unflatten([*leaves[:i], leaf, *leaves[i + 1 :]])
        member.check_finite(broken, -1, totals(), 40)
        assert isinstance(member.failure, DivergedError)
        assert "no longer finite at step 40 (" in str(member.failure)
        assert "; no checkpoint was due" in str(member.failure)


def test_the_step_of_a_metric_that_was_not_finite_is_named(member_and_learner):
    """Also where the parameters are finite."""
    member, learner = member_and_learner
    member.failure = None
    sums = UpdateMetrics(1.0, 2.0, np.nan, 3.0, 4.0)
    member.check_finite(learner, 24, totals()._replace(update_metrics=sums), 40)
    assert "no longer finite at step 24 (q_mean)" in str(member.failure)


def test_broken_steps_are_counted_by_the_chunk(member_and_learner):
    """One environment's, or 1 % of them, are pardoned; a row sets the count back."""
    member, learner = member_and_learner
    member.failure = None
    for broken in (1, 2, 3, 0, 1, 1, 2):
        member.check_finite(learner, -1, totals(broken), 40)
        assert member.failure is None
    member.check_finite(learner, -1, totals(4), 44)
    assert "at step 44 (observations or rewards of 2 steps)" in str(member.failure)
