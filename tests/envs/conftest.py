"""Gymnasium's environments, put where a test wants them, and random states to put them in."""

import gymnasium
import mujoco
import numpy as np
import pytest

import envs


class GymnasiumTask:
    """`gymnasium.make(id).unwrapped` with a reset to a given state, and flat info."""

    def __init__(self, env):
        self.env = env
        self.data = env.data

    def reset_to(self, qpos, qvel):
        """As Gymnasium's reset leaves it, but where we say; returns the float32 observation."""
        mujoco.mj_resetData(self.env.model, self.data)
        self.env.set_state(qpos, qvel)
        return self.env._get_obs().astype(np.float32)

    def step(self, control):
        observation, reward, terminated, _, info = self.env.step(control)
        scalars = {}
        for key, value in info.items():
            if np.ndim(value):
                scalars |= {f"{key}_{i}": x for i, x in enumerate(value)}
            else:
                scalars[key] = value
        return observation.astype(np.float32), reward, terminated, scalars


@pytest.fixture(scope="session")
def gymnasium_task():
    """make(name, **options): the Gymnasium task that `envs.make(name, **options)` equals."""

    def make(name, **options):
        return GymnasiumTask(gymnasium.make(envs.spec(name).gymnasium_id, **options).unwrapped)

    return make


@pytest.fixture(scope="session")
def player():
    """make(actions [M, A], value): proposes those in every state; value(observations, actions)."""

    def make(actions, value):
        actions = np.float32(actions)

        def proposals(observations):
            proposed = np.broadcast_to(actions, (len(observations), *actions.shape))
            return proposed, value(observations, proposed)

        return envs.Player(proposals, value)

    return make


@pytest.fixture(scope="session")
def random_state():
    """draw(model, rng, scale): qpos and qvel [float64] near the model's initial ones."""

    def draw(model, rng, scale=0.05):
        offset = rng.uniform(-scale, scale, model.nq)
        return model.qpos0 + offset, scale * rng.standard_normal(model.nv)

    return draw
