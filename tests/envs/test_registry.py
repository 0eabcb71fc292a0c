"""Names, engines and options; what is wrong is named, and what would be right."""

import gymnasium
import jax
import numpy as np
import pytest

import envs
from envs.base import Env
from envs.mujoco_tasks.task import ASSETS


def test_names_are_gymnasiums_tasks():
    assert envs.names() == (
        "pendulum",
        "hopper",
        "walker2d",
        "halfcheetah",
        "swimmer",
        "humanoid",
        "inverted_pendulum",
        "inverted_double_pendulum",
        "ant",
        "reacher",
        "pusher",
        "humanoid_standup",
        "driving",
    )


@pytest.mark.parametrize("name", [n for n in envs.names() if envs.spec(n).gymnasium_id])
def test_specs_agree_with_gymnasium(name):
    spec, env = envs.spec(name), envs.make(name)
    reference = gymnasium.make(spec.gymnasium_id)
    assert isinstance(env, Env)
    assert spec.time_limit == reference.spec.max_episode_steps
    assert env.observation_size == reference.observation_space.shape[0]
    assert env.action_size == reference.action_space.shape[0]
    assert env.dt == reference.unwrapped.dt
    assert env.action_high.dtype == np.float32
    np.testing.assert_array_equal(env.action_high, reference.action_space.high)
    np.testing.assert_array_equal(-env.action_high, reference.action_space.low)


@pytest.mark.parametrize(("device", "engine"), [("cpu", "native"), ("gpu", "mjx"), ("tpu", "mjx")])
def test_auto_takes_the_engine_of_the_device(device, engine, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    assert envs.make("hopper").backend == engine
    assert envs.make("pendulum").backend == "jax"


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("hoper", {}, r"unknown environment 'hoper'; known are pendulum, hopper, .*brax:<name>"),
        ("hopper", {"engine": "jax"}, r"hopper has no engine 'jax'; it has native, mjx"),
        ("pendulum", {"engine": "native"}, r"pendulum has no engine 'native'; it has jax"),
        ("pendulum", {"gravity": 1}, r"pendulum has no option 'gravity'; it has g$"),
        ("swimmer", {"healthy_reward": 1}, r"no option 'healthy_reward'; it has xml_file, frame_"),
        ("swimmer", {"frame_skip": 0}, r"frame_skip must be at least 1, got 0"),
        ("swimmer", {"xml_file": "squid.xml"}, r"there is no model file .*squid.xml"),
        ("brax:hoper", {}, r"Brax has no environment 'hoper'; it has ant, .*walker2d"),
        ("brax:ant", {"engine": "mjx"}, r"brax:ant has no engine 'mjx'; it has jax"),
        ("brax:ant", {"speed": 1}, r"brax:ant has no option 'speed'; it has ctrl_cost_weight, "),
    ],
)
def test_bad_input_is_named(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.make(name, **arguments)


def test_a_model_file_of_ones_own_is_loaded(monkeypatch):
    def friction(**options):
        return envs.make("walker2d", "native", **options).task.model.geom("foot_geom").friction[0]

    monkeypatch.chdir(ASSETS)  # whose walker2d.xml is that of Walker2d-v4
    assert friction() == 1.9
    assert friction(xml_file="./walker2d.xml") == 0.9
    assert friction(xml_file=str(ASSETS / "walker2d.xml")) == 0.9
