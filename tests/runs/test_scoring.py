"""A run's score, on our physics and in Gymnasium itself."""

import dataclasses
import json
import shutil

import gymnasium
import numpy as np
import oracles
import pytest

from mapg_jax import evaluate, load_policy
from mapg_jax.reports.results import protocol, read_run
from mapg_jax.runs import scoring
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import open_policy


@pytest.fixture(scope="module")
def pendulum(finished_run, tmp_path_factory):
    """A copy of the finished run, for scores to be written to."""
    path = tmp_path_factory.mktemp("runs") / "pendulum"
    shutil.copytree(finished_run.path, path)
    return RunFolder.open(path)


@pytest.fixture(scope="module")
def hopper(tmp_path_factory):
    """A run on Hopper that has not learned yet."""
    config = dataclasses.replace(oracles.RUN, env="hopper", engine="native", time_limit=200)
    return oracles.untrained_run(config, tmp_path_factory.mktemp("runs") / "hopper")


def test_the_record_is_the_file(pendulum):
    record = evaluate(pendulum, episodes=5, select="mean", seed=3)
    file = pendulum.path / "evaluations" / "jax-mean-5-s3.json"
    assert json.loads(file.read_text()) == record
    assert (record["env"], record["physics"], record["select"]) == ("pendulum", "jax", "mean")
    assert (record["episodes"], record["seed"]) == (5, 3)
    assert record["mean"] == pytest.approx(np.mean(record["returns"]), rel=1e-12)
    assert record["std"] == pytest.approx(np.std(record["returns"], ddof=1), rel=1e-12)
    assert record["ci95"][0] < record["mean"] < record["ci95"][1]
    assert record["lengths"] == [50] * 5
    assert record["spread"] > 0


def test_scores_asked_for_later_stand_beside_the_official_one(finished_run, tmp_path):
    folder = oracles.copy_run(finished_run, tmp_path / "run")
    evaluate(folder, episodes=1)
    assert not folder.evaluation.exists()
    official = evaluate(folder)
    assert json.loads(folder.evaluation.read_text()) == official
    assert (official["episodes"], official["select"], official["seed"]) == (3, "uniform", 0)
    result = read_run(folder)
    for other in ({"episodes": 4}, {"select": "argmax-q"}, {"seed": 1}, {"physics": "gymnasium"}):
        assert evaluate(folder, **other)["returns"] != official["returns"]
    names = {path.name for path in (folder.path / "evaluations").iterdir()}
    assert names == {
        "jax-uniform-1-s0.json", "jax-uniform-4-s0.json", "jax-argmax-q-3-s0.json",
        "jax-uniform-3-s1.json", "gymnasium-uniform-3-s0.json",
    }  # fmt: skip
    assert read_run(folder) == result
    assert protocol(read_run(folder)) == protocol(result)
    assert evaluate(folder, episodes=3) == official  # asked for by its own numbers
    assert len(list((folder.path / "evaluations").iterdir())) == len(names)


def test_a_score_names_the_step_of_its_own_policy(finished_run, tmp_path, monkeypatch):
    """Training goes on while a policy is scored: a newer checkpoint comes."""
    folder = oracles.copy_run(finished_run, tmp_path / "run", upto=400)
    expected = scoring.score(folder, episodes=2)

    def opened(*arguments):
        policy = open_policy(*arguments)
        shutil.copytree(finished_run.checkpoints / "800", folder.checkpoints / "800")
        return policy

    monkeypatch.setattr(scoring, "open_policy", opened)
    assert scoring.score(folder, episodes=2) == expected
    assert expected["env_steps"] == 400
    assert Checkpoints(folder.checkpoints).newest() == 800


@pytest.mark.parametrize("physics", ["auto", "gymnasium"])
def test_more_episodes_than_fit_are_refused_in_one_line(pendulum, physics, monkeypatch):
    monkeypatch.setattr(scoring, "available_bytes", lambda: 8_000_000_000)
    message = r"1,000,000,000 episodes .* but 8\.0 GB are available; choose fewer --episodes"
    with pytest.raises(ValueError, match=message) as error:
        evaluate(pendulum, episodes=10**9, physics=physics)
    assert "\n" not in str(error.value)
    monkeypatch.setattr(scoring, "available_bytes", lambda: 10**30)
    with pytest.raises(ValueError, match="choose fewer --episodes"):
        evaluate(pendulum, episodes=2**31, physics=physics)  # more than an index counts


def test_a_score_is_repeatable_and_seeds_differ(pendulum):
    one, again, other = (evaluate(pendulum, episodes=4, seed=seed) for seed in (0, 0, 1))
    assert one == again
    assert set(one["returns"]).isdisjoint(other["returns"])


def test_gymnasiums_score_is_a_hand_written_loop(hopper):
    """The official environment, one observation at a time.

    A batch of three and a single observation may round an action differently, by 1e-7; Hopper
    falls before that grows to 1e-3 of a return.
    """
    record = evaluate(hopper, episodes=3, physics="gymnasium", select="first", seed=11)
    policy = load_policy(hopper.path, select="first")
    returns, lengths = [], []
    for i in range(3):
        env = gymnasium.make("Hopper-v5", max_episode_steps=200)
        observation, _ = env.reset(seed=11 + i)
        total, length, ended = 0.0, 0, False
        while not ended:
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            total, length, ended = total + float(reward), length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
    assert record["lengths"] == lengths
    np.testing.assert_allclose(record["returns"], returns, rtol=1e-3)
    assert (record["physics"], record["env"]) == ("gymnasium", "hopper")
    assert record["env_steps"] == Checkpoints(hopper.checkpoints).newest()


def test_our_physics_scores_as_gymnasium_does(hopper):
    """Other starts of the same distribution: means of 40 within 6 standard errors of the gap."""
    ours = evaluate(hopper, episodes=40, physics="native", select="first")
    theirs = evaluate(hopper, episodes=40, physics="gymnasium", select="first")
    assert ours["physics"] == "native"
    error = np.hypot(ours["std"], theirs["std"]) / np.sqrt(40)
    assert abs(ours["mean"] - theirs["mean"]) < 6 * error
    assert len(set(ours["lengths"])) > 1  # episodes end by themselves


def test_options_reach_gymnasium_too(hopper, tmp_path):
    config = dataclasses.replace(
        hopper.config, env_options=("terminate_when_unhealthy=False",), time_limit=250
    )
    folder = oracles.untrained_run(config, tmp_path / "run")
    record = evaluate(folder, episodes=2, physics="gymnasium")
    assert record["lengths"] == [250, 250]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0 and below 2147483648, got -1"),
        ({"physics": "mjx"}, "pendulum has no engine 'mjx'; it has jax"),
    ],
)
def test_what_cannot_be_scored_is_refused(pendulum, arguments, message):
    before = {path: path.is_file() and path.read_bytes() for path in pendulum.path.rglob("*")}
    with pytest.raises(ValueError, match=message):
        evaluate(pendulum, **arguments)
    after = {path: path.is_file() and path.read_bytes() for path in pendulum.path.rglob("*")}
    assert after == before


def test_brax_has_no_official_task(tmp_path):
    config = dataclasses.replace(oracles.RUN, env="brax:fast")
    folder = oracles.untrained_run(config, tmp_path / "run")
    with pytest.raises(ValueError, match="brax:fast equals no Gymnasium task"):
        evaluate(folder, physics="gymnasium")
