"""Environments: Gymnasium's control tasks on two physics engines, and pure JAX ones.

env = envs.make("hopper")                    # the bare task: no time limit, no automatic reset
env = envs.make("hopper", engine="mjx", healthy_reward=0.5)
env = with_episodes(env, envs.spec("hopper").time_limit)
"""

from envs.base import Env, State, with_episodes
from envs.registry import EnvSpec, make, names, spec

__all__ = ["Env", "EnvSpec", "State", "make", "names", "spec", "with_episodes"]
