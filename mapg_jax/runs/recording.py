"""One episode of a trained policy, state by state, and drawn."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.drawing import animate, draw_line
from mapg_jax.algorithms import heads
from mapg_jax.runs.policy import load_policy
from mapg_jax.runs.folder import RunFolder


def record(folder: RunFolder, seed: int = 0, select: heads.Select = "uniform") -> Any:
    """The physics states [T, ...] of one episode of the newest checkpoint, its start included.

    Args:
      folder: of the run.
      seed: of the start and the heads.
      select: how one action is made of the M proposals.

    Raises:
      ValueError: if the run has no checkpoint.
    """
    policy = load_policy(folder.path, seed, select)
    env, agent = folder.config.make_env(), policy.agent
    start_key, act_key = jax.random.split(jax.random.key(seed))

    def step(carry, t):
        state, alive = carry
        action = agent.act(policy.state, state.obs, jax.random.fold_in(act_key, t), select)
        following = env.step(state, action)
        return (following, alive & (following.done < 0.5)), (state.pipeline_state, alive)

    @jax.jit
    def play():
        first = env.reset(start_key), jnp.ones((), bool)
        return jax.lax.scan(step, first, jnp.arange(folder.config.episode_steps()))[1]

    states, alive = play()
    length = int(np.asarray(alive).sum())
    return jax.tree.map(lambda x: np.asarray(x)[:length], states)


def draw_drive(folder: RunFolder, seed: int, select: heads.Select) -> list[pathlib.Path]:
    """Draws one episode of a driving run into its folder: drive.png and drive.html.

    Raises:
      ValueError: if the run has no checkpoint.
    """
    env: Any = folder.config.make_env()
    states = record(folder, seed, select)
    track = env.tracks[int(states.track[0])]
    positions = np.stack([states.x, states.y], -1)
    picture, animation = folder.path / "drive.png", folder.path / "drive.html"
    draw_line(track, positions, states.speed, picture)
    animate(track, positions, states.heading, states.speed, env.dt, animation)
    return [picture, animation]
