"""Rows of scores: which a version of the protocol takes, and that the two stay apart."""

import oracles
import pytest
from written import ON_ONE

from experiments import paper, scores
from experiments.plan import MAPG, make_plan
from mapg_jax.reports.results_csv import append_csv


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 150}, "seed 150 is not of version 2 of the protocol, whose seeds are 2000 and"),
        ({"processor": ""}, "seed 2000 does not name its processor, as version 2"),
        ({"threads": ""}, "seed 2000 does not name its threads, as version 2"),
        ({"return_std": -5.0}, "seed 2000 has a return_std of -5, and a deviation is at least 0"),
        (
            {"metrics": {"lap_share": 7.5}},
            "seed 2000 has a lap_share of 7.5, and a share is from 0 to 1",
        ),
        ({"engine": "mjx"}, "seed 2000 was trained on mjx and scored on native; leave it out"),
        (
            {"select": "argmax-q"},
            "holds a run that was scored by 100 episodes and argmax-q; choose",
        ),
        ({"episodes": 1}, "holds a run that was scored by 1 episodes and uniform; choose"),
    ],
)
def test_rows_that_the_protocol_does_not_know_are_refused(tmp_path, changes, message):
    plan = make_plan("paper", 1600, 3, tmp_path / "runs", tmp_path)
    usual = {"seed": 2000, "episodes": 100, "engine": "native", **ON_ONE}
    found = oracles.result(steps=1600, **{**usual, **changes})
    append_csv(scores.path(plan), [found])
    with pytest.raises(ValueError, match=message) as error:
        paper.make(plan, ["table2"], training=False)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        (0, "holds two scores of hopper, mapg, M = 10, seed 0; leave one out"),
        (2000, "seed 2000 is not of version 1 of the protocol, whose seeds are below 2000; leave"),
    ],
)
def test_rows_that_version_1_does_not_know_are_refused(seed, message, tmp_path):
    """A seed of version 2, or a row that stands there twice."""
    plan = make_plan("paper", 1600, 3, tmp_path / "runs", tmp_path)
    file = scores.path(plan._replace(version=1))
    append_csv(file, [oracles.result(seed=seed, steps=1600)])
    ours = oracles.result(seed=2001, steps=1600, engine="native", **ON_ONE)
    append_csv(scores.path(plan), [ours])
    with file.open("a") as out:
        out.write(file.read_text().splitlines(keepends=True)[-1])
    with pytest.raises(ValueError, match=message):
        paper.make(plan, ["table2"], training=False)


def test_the_versions_of_the_protocol_are_apart(tmp_path):
    plan = make_plan("paper", 1600, 3, tmp_path / "runs", tmp_path)
    earlier = plan._replace(version=1)
    for version, seed, score in ((earlier, 0, 1.0), (plan, 2000, 5.0)):
        made = oracles.result(seed=seed, steps=1600, return_mean=score, episodes=100)
        append_csv(scores.path(version), [made._replace(engine="native", **ON_ONE)])
    cell = plan.over_seeds("hopper", **MAPG)
    assert scores.means(plan, cell) == [5.0]
    assert scores.means(earlier, earlier.over_seeds("hopper", **MAPG)) == [1.0]
    assert len(scores.means(plan, earlier.over_seeds("hopper", **MAPG))) == 0
