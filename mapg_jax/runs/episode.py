"""Episodes of a trained policy, state by state, and drawn."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np

import envs
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.policy import Policy, open_policy


def record(
    policy: Policy, time_limit: int, episodes: int = 1, seed: int = 0, select: str = "uniform"
) -> list[envs.Episode]:
    """Episodes, played side by side.

    Args:
      policy: of a run.
      time_limit: steps after which an episode is cut off.
      episodes: how many.
      seed: of the starts and the heads.
      select: how one action is made of the M proposals.
    """
    env, agent = policy.env, policy.agent
    start_key, act_key = jax.random.split(jax.random.key(seed))

    def step(carry, t):
        state, alive = carry
        key = agent.key_of_step(policy.state, act_key, t)
        action = agent.act(policy.state, state.obs, key, select)
        following = jax.vmap(env.step)(state, action)
        row = (state.pipeline_state, state.obs), action, alive
        return (following, alive & (following.done < 0.5)), row

    @jax.jit
    def play():
        start = jax.vmap(env.reset)(jax.random.split(start_key, episodes))
        first = start, jnp.ones(episodes, bool)
        (last, _), (before, action, alive) = jax.lax.scan(step, first, jnp.arange(time_limit))
        after = last.pipeline_state, last.obs
        seen = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), before, after)
        return seen, action, alive.sum(0)

    seen, action, length = jax.device_get(play())

    def episode(i: int) -> envs.Episode:
        states, observations = jax.tree.map(lambda x: x[: length[i] + 1, i], seen)
        return envs.Episode(states, observations, action[: length[i], i])

    return [episode(i) for i in range(episodes)]


def player(policy: Policy) -> envs.Player:
    """What an environment may ask the policy as it draws."""
    agent, state = policy.agent, policy.state
    m = int(state.hyper.heads)

    @jax.jit
    def proposals(observations):
        actions, values = agent.proposals(state, observations)
        return actions[:, :m], values[:, :m]

    @jax.jit
    def q_values(observations, actions):
        return agent.q_values(state, observations, actions)

    return envs.Player(
        lambda observations: jax.device_get(proposals(np.float32(observations))),
        lambda observations, actions: jax.device_get(
            q_values(np.float32(observations), np.float32(actions))
        ),
    )


def draw(folder: RunFolder, seed: int = 0, select: str = "uniform") -> list[pathlib.Path]:
    """Draws episodes of the newest checkpoint into the run folder, as its environment does.

    Raises:
      ValueError: if the run has no checkpoint, or its environment draws nothing.
    """
    policy = open_policy(folder, seed, select)
    env = policy.env
    if type(env).render is envs.Env.render:
        raise ValueError(f"{folder.path} is a run of {folder.config.env}, which draws nothing")
    episodes = record(policy, folder.config.episode_steps(), env.drawn_episodes, seed, select)
    return env.render(episodes, player(policy), folder.path)
