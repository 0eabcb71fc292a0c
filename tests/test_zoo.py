"""The trained policies of zoo/ score what their cards say."""

import json
import pathlib

import numpy as np
import pytest

from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import load_policy
from mapg_jax.runs.scoring import score

ZOO = pathlib.Path(__file__).parent.parent / "zoo"
NAMES = sorted(path.name for path in ZOO.iterdir() if path.is_dir())


@pytest.mark.parametrize("name", NAMES)
def test_each_has_a_card_with_its_score(name):
    folder = RunFolder.open(ZOO / name)
    card = (ZOO / name / "README.md").read_text()
    official = json.loads(folder.evaluation.read_text())
    assert f"| return, mean | {official['mean']:,.1f} |" in card
    row = f"`{folder.config.env}` | {official['mean']:,.1f} | {official['env_steps']:,} |"
    assert f"| [{name}]({name}/README.md) | {row}" in (ZOO / "README.md").read_text()
    assert official["env_steps"] == folder.scored_steps() and official["episodes"] == 100
    assert sum(file.stat().st_size for file in (ZOO / name).rglob("*")) < 3_000_000


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_of_before_still_loads(name):
    """The state of its algorithm is what was saved, leaf by leaf."""
    policy = load_policy(ZOO / name)
    assert policy.env_steps == RunFolder.open(ZOO / name).scored_steps()


@pytest.mark.parametrize("name", ["pendulum-m10", "multi_goal-diverse"])
def test_a_policy_scores_what_its_card_says(name):
    """Other episodes: the difference of the means within four standard errors."""
    official = json.loads((ZOO / name / "evaluation.json").read_text())
    again = score(RunFolder.open(ZOO / name), episodes=50, seed=7)
    error = np.hypot(official["std"] / np.sqrt(100), again["std"] / np.sqrt(50))
    assert abs(again["mean"] - official["mean"]) < 4 * error
