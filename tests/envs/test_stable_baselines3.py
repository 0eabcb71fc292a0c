"""Our environments as Stable-Baselines3 has them; run by make test-sb3."""

import pathlib
import re

import gymnasium
import numpy as np
import pytest

pytestmark = pytest.mark.sb3
DOCUMENT = pathlib.Path(__file__).parents[2] / "docs" / "environments.md"


@pytest.mark.filterwarnings("ignore")  # other people's
def test_the_example_of_the_documents_trains():
    text = DOCUMENT.read_text().split("\n### Stable-Baselines3\n")[1]
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[:1]
    names = {}
    exec(example.replace("100_000", "8_192"), names)
    assert names["model"].num_timesteps == 8_192
    assert np.isfinite(names["model"].policy.predict(np.zeros((2, 29), np.float32))[0]).all()


def test_a_single_car_passes_its_checker():
    from stable_baselines3.common.env_checker import check_env

    check_env(gymnasium.make("mapg_jax:mapg/Driving-v0"), warn=False)


def test_steps_are_those_of_the_vector_environment():
    """Ends are told as Stable-Baselines3 wants them: the last observation, and by the limit."""
    from envs.interop.stable_baselines3 import StableBaselinesEnv

    theirs, plain = (
        gymnasium.make_vec("mapg_jax:mapg/MultiGoal-v0", num_envs=3, max_episode_steps=4)
        for _ in range(2)
    )
    env = StableBaselinesEnv(theirs)
    assert env.num_envs == 3 and env.get_attr("render_mode") == [None] * 3
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), plain.reset(seed=5)[0])
    action = np.full((3, 2), 0.2, np.float32)
    for step in range(1, 6):
        got, expected = env.step(action), plain.step(action)
        np.testing.assert_array_equal(got[0], expected[0])
        np.testing.assert_allclose(got[1], expected[1], rtol=1e-6)
        assert got[2].all() == (step == 4)
        for i, info in enumerate(got[3]):
            assert info.get("TimeLimit.truncated", False) == (step == 4)
            if step == 4:
                np.testing.assert_array_equal(
                    info["terminal_observation"], expected[4]["final_obs"][i]
                )


def test_another_kind_of_reset_is_refused():
    from envs.interop.stable_baselines3 import StableBaselinesEnv

    other = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync")
    with pytest.raises(ValueError, match=r"the autoreset mode must be .*SAME_STEP"):
        StableBaselinesEnv(other)
