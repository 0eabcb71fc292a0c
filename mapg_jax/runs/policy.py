"""A trained policy, callable with one observation or many."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.agent import Agent, AgentState, make_agent
from mapg_jax.training.trainer import agent_shapes


class Policy:
    """Draws one of the M proposed actions, as the paper does in evaluation too; A3C samples.

    Actions are float32 NumPy arrays in Gymnasium's units. An observation is [D] or [N, D].
    """

    def __init__(
        self,
        env: envs.Env,
        agent: Agent,
        state: AgentState,
        env_steps: int,
        seed: int = 0,
        select: str = "uniform",
    ):
        if select not in agent.algorithm.selects:
            known = ", ".join(agent.algorithm.selects)
            raise ValueError(f"select must be one of {known}, got {select!r}")
        self.env, self.agent, self.state, self.env_steps = env, agent, state, env_steps
        self._key = jax.random.key(_checked_seed(seed))
        self._calls = 0
        self._observation_size = state.normalizer.mean.shape[-1]

        def in_units(action):
            return action * jnp.broadcast_to(env.action_high, action.shape)

        @jax.jit
        def act(state, observation, key):
            return in_units(agent.act(state, observation, key, select))

        self._act = act
        self._proposals = jax.jit(lambda state, obs: in_units(agent.proposals(state, obs)[0]))
        self._values = jax.jit(lambda state, obs: agent.proposals(state, obs)[1])

    def __call__(self, observation: Any, seed: int | None = None) -> np.ndarray:
        """An action a state, [A] or [N, A].

        Args:
          observation: [D] or [N, D].
          seed: makes the draw repeatable; without it the policy's own stream goes on, and a head
            that was trained to be held acts for as many calls.

        Raises:
          ValueError: if the last axis is not D, a number is not finite, or the seed is negative.
        """
        if seed is None:
            key = self.agent.key_of_step(self.state, self._key, self._calls)
            self._calls += 1
        else:
            key = jax.random.key(_checked_seed(seed))
        return np.asarray(self._act(self.state, self._checked(observation), key))

    def proposals(self, observation: Any) -> np.ndarray:
        """All M actions, [M, A] or [N, M, A]."""
        m = int(self.state.hyper.heads)
        return np.asarray(self._proposals(self.state, self._checked(observation)))[..., :m, :]

    def values(self, observation: Any) -> np.ndarray:
        """The critic's value of every proposal, [M] or [N, M]."""
        m = int(self.state.hyper.heads)
        return np.asarray(self._values(self.state, self._checked(observation)))[..., :m]

    def _checked(self, observation: Any) -> np.ndarray:
        observation = np.asarray(observation, np.float32)
        size = self._observation_size
        if observation.ndim not in (1, 2) or observation.shape[-1] != size:
            raise ValueError(
                f"an observation must be [{size}] or [N, {size}], got {list(observation.shape)}"
            )
        if not np.isfinite(observation).all():
            raise ValueError("an observation must be finite, and one of these numbers is not")
        return observation


def load_policy(path: str | os.PathLike, seed: int = 0, select: str = "uniform") -> Policy:
    """The policy of a run folder's newest checkpoint.

    Args:
      path: the run folder.
      seed: of the policy's own random stream.
      select: how one action is made of the M proposals: uniform, argmax-q, mean or first; of
        A3C's Gaussian: uniform (a sample) or mean.

    Raises:
      ValueError: if the folder holds no run, or no complete checkpoint, its algorithm cannot
        select so, or the seed is out of range.
    """
    return open_policy(RunFolder.open(path), seed, select)


def open_policy(folder: RunFolder, seed: int = 0, select: str = "uniform") -> Policy:
    """`load_policy` of a folder that is open."""
    config = folder.config
    env = config.make_env()
    agent = make_agent(config, env.action_size)
    shapes = agent_shapes(config, agent, env.observation_size)
    state, env_steps = Checkpoints(folder.checkpoints, config=folder.digest).load_agent(shapes)
    return Policy(env, agent, state, env_steps, seed, select)


def _checked_seed(seed: int) -> int:
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed must be at least 0 and below 2147483648, got {seed}")
    return seed
