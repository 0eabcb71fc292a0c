"""One episode of a trained policy, state by state, and drawn."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import Policy, open_policy


def record(policy: Policy, time_limit: int, seed: int = 0, select: str = "uniform") -> Any:
    """The physics states [T, ...] of one episode, its start included.

    Args:
      policy: of a run.
      time_limit: steps after which the episode is cut off.
      seed: of the start and the heads.
      select: how one action is made of the M proposals.
    """
    env, agent = policy.env, policy.agent
    start_key, act_key = jax.random.split(jax.random.key(seed))

    def step(carry, t):
        state, alive = carry
        action = agent.act(
            policy.state, state.obs, agent.key_of_step(policy.state, act_key, t), select
        )
        following = env.step(state, action)
        return (following, alive & (following.done < 0.5)), (state.pipeline_state, alive)

    @jax.jit
    def play():
        first = env.reset(start_key), jnp.ones((), bool)
        return jax.lax.scan(step, first, jnp.arange(time_limit))[1]

    states, alive = play()
    length = int(np.asarray(alive).sum())
    return jax.tree.map(lambda x: np.asarray(x)[:length], states)


def draw(folder: RunFolder, seed: int = 0, select: str = "uniform") -> list[pathlib.Path]:
    """Draws one episode of the newest checkpoint into the run folder, as its environment does.

    Raises:
      ValueError: if the run has no checkpoint, or its environment draws nothing.
    """
    policy = open_policy(folder, seed, select)
    if type(policy.env).render is envs.Env.render:
        raise ValueError(f"{folder.path} is a run of {folder.config.env}, which draws nothing")
    states = record(policy, folder.config.episode_steps(), seed, select)
    return policy.env.render(states, folder.path)
