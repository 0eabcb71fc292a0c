"""MuJoCo Playground's environments in ours: `playground:NAME`."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import with_episodes
from mapg_jax.runs.train import train
from mapg_jax.training.config import preset

NAME = "CartpoleBalance"


def test_without_its_package_a_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(ValueError, match=r"needs: pip install 'mapg-jax\[playground\]'$"):
        envs.make(f"playground:{NAME}")


@pytest.mark.playground
@pytest.mark.usefixtures("their_code")
class TestPlayground:
    """With the package."""

    def test_its_numbers_are_playgrounds_own(self):
        from mujoco_playground import registry

        env = envs.make(f"playground:{NAME}")
        theirs = registry.load(NAME, config_overrides={"impl": "jax"})
        action = jnp.array([0.3])

        def both(key):
            ours, own = env.step(env.reset(key), 4 * action), theirs.step(theirs.reset(key), action)
            clipped = theirs.step(theirs.reset(key), jnp.ones(1))
            return (ours.obs, ours.reward), (clipped.obs, clipped.reward), own.obs

        ours, clipped, own = jax.jit(both)(jax.random.key(1))
        for found, wanted in zip(ours, clipped, strict=True):
            np.testing.assert_array_equal(found, wanted)
        assert not np.array_equal(ours[0], own)
        assert envs.spec(f"playground:{NAME}").time_limit == 1000
        assert (env.observation_size, env.action_size, env.dt) == (5, 1, 0.01)

    def test_an_action_is_repeated_and_its_rewards_add_up(self):
        env = envs.make(f"playground:{NAME}")
        twice = envs.make(f"playground:{NAME}", action_repeat=2)
        action = jnp.array([0.3])

        def both(key):
            one = env.step(env.reset(key), action)
            two = env.step(one, action)
            return one.reward + two.reward, two.obs, twice.step(twice.reset(key), action)

        rewards, observation, found = jax.jit(both)(jax.random.key(1))
        np.testing.assert_allclose(found.reward, rewards, rtol=1e-6)
        np.testing.assert_allclose(found.obs, observation, atol=1e-6)
        assert twice.dt == 0.02

    def test_episodes_end_at_the_limit_and_begin_anew(self):
        env = with_episodes(envs.make(f"playground:{NAME}"), time_limit=3)

        @jax.jit
        def play(key):
            actions = jnp.zeros((6, 1))
            return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]

        states = play(jax.random.key(0))
        np.testing.assert_array_equal(states.info["truncated"], [0, 0, 1] * 2)
        assert len(np.unique(states.obs[2::3], axis=0)) == 2

    def test_it_trains(self, tmp_path):
        config = preset(
            "smoke", env=f"playground:{NAME}", steps=40, evaluate_every=40, time_limit=10
        )
        assert 0 <= train(config, tmp_path / "run").score["mean"] <= 10

    @pytest.mark.parametrize(
        "name, options, said",
        [
            ("Cartpole", {}, "Playground has no environment 'Cartpole'; it has AcrobotSwingup, "),
            (NAME, {"gravity": 1}, f"playground:{NAME}: the option gravity=1 is unknown; it has "),
            (NAME, {"sim_dt": "x"}, f"playground:{NAME}: the option sim_dt='x' "),
            (NAME, {"action_repeat": 0}, f"playground:{NAME}: action_repeat must be at least 1"),
            (NAME, {"vision_config.depth": 1}, "the option vision_config.depth=1 is unknown"),
        ],
    )
    def test_what_is_refused(self, name, options, said):
        with pytest.raises(ValueError) as refused:
            envs.make(f"playground:{name}", **options)
        assert said in str(refused.value) and "\n" not in str(refused.value)
