"""Our environments as Gymnasium has them."""

import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs
import mapg_jax  # noqa: F401  registers them
from envs import registry
from envs.interop.gymnasium import SingleEnv, VectorEnv
from envs.interop.gymnasium_ids import gymnasium_id

USUAL = ("minimum value is -infinity", "maximum value is infinity", "symmetric and normalized")
"""What Gymnasium says of its own tasks, too."""

DRAWN = ("pendulum", "multi_goal", "point_maze", "two_mode_bandit", "four_bump_bandit")
"""Drawn, or known not to be, without a GPU's libraries and in no time."""


@pytest.mark.parametrize("first", ["mapg_jax", "gymnasium"])
def test_names_are_there_in_either_order_of_imports_and_cost_nothing(first):
    second = {"mapg_jax": "gymnasium", "gymnasium": "mapg_jax"}[first]
    code = (
        f"import {first}, {second}, sys, gymnasium; "
        "ours = sorted(x for x in gymnasium.registry if x.startswith('mapg/')); "
        "print(ours, 'jax' in sys.modules)"
    )
    said = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert said.strip() == f"{sorted(map(gymnasium_id, registry.loaded()))} False"


@pytest.mark.parametrize("name", ["driving", *DRAWN, "hopper"])
def test_gymnasiums_checker_finds_nothing_that_its_own_tasks_do_not_have(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = gymnasium.make(gymnasium_id(envs.spec(name))).unwrapped
        check_env(env, skip_render_check=name not in DRAWN)
    said = [str(w.message) for w in caught if "WARN" in str(w.message)]
    assert [text for text in said if not any(usual in text for usual in USUAL)] == []


@pytest.mark.parametrize("name", ["pendulum", "halfcheetah", "pusher"])
def test_spaces_are_gymnasiums(name):
    ours = gymnasium.make(gymnasium_id(envs.spec(name)))
    theirs = gymnasium.make(envs.spec(name).gymnasium_id)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space.shape == theirs.observation_space.shape
    assert ours.spec and theirs.spec
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps


def test_a_step_is_that_of_the_environment_in_its_own_units():
    env = gymnasium.make("mapg_jax:mapg/Pendulum-v1", g=5.0).unwrapped
    env.reset(seed=3)
    state = env._state
    plain = envs.make("pendulum", g=5.0)
    for torque in (2.0, -0.5, 7.0):
        observation, reward, terminated, truncated, _ = env.step(np.array([torque]))
        state = jax.jit(plain.step)(state, np.array([torque / 2], np.float32))
        np.testing.assert_array_equal(observation, state.obs)
        assert (reward, terminated, truncated) == (float(state.reward), False, False)


def test_many_are_reset_in_the_step_that_ends_them():
    n, limit = 8, 5
    env = gymnasium.make_vec("mapg/MultiGoal-v0", num_envs=n, max_episode_steps=limit)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    start, _ = counted.reset(seed=3)
    again, _ = counted.reset(seed=3)
    np.testing.assert_array_equal(start, again)
    assert (counted.reset(seed=4)[0] != start).any()
    total = np.zeros(n)
    for step in range(1, limit + 1):
        before = again
        action = np.full((n, 2), 0.3, np.float32)
        again, reward, terminated, truncated, info = counted.step(action)
        total += reward
        assert truncated.all() == (step == limit)
        assert not terminated.any()
    assert info["_final_obs"].all()
    np.testing.assert_allclose(np.stack(info["final_obs"]), before + 0.3, atol=1e-6)
    assert (np.abs(again) < 1.0).all()  # near the centre again
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    assert (info["episode"]["l"] == limit).all()


def test_each_of_many_can_have_a_seed_of_its_own():
    env: Any = gymnasium.make_vec("mapg/MultiGoal-v0", num_envs=3)
    first, _ = env.reset(seed=[4, 5, 4])
    second, _ = env.reset(seed=(5, None, 7))
    np.testing.assert_array_equal(first[0], first[2])
    np.testing.assert_array_equal(first[1], second[0])
    assert (first[0] != first[1]).any() and (first[0] != second[2]).any()
    with pytest.raises(ValueError, match="3 instances take as many seeds, got 2"):
        env.reset(seed=[1, 2])


def test_what_is_wrong_is_said():
    with pytest.raises(ValueError, match="has no option 'gravity'; it has g"):
        gymnasium.make("mapg/Pendulum-v1", gravity=1.0)
    with pytest.raises(ValueError, match="pendulum has no render_mode 'ansi'; it has rgb_array"):
        SingleEnv("pendulum", render_mode="ansi")
    with pytest.raises(ValueError, match=r"'rgb_array'; one by gymnasium\.make draws"):
        VectorEnv("pendulum", 2, 200, render_mode="rgb_array")
    env = gymnasium.make("mapg/Pendulum-v1").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))
