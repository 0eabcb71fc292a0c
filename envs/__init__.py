"""Environments: Gymnasium's control tasks on two physics engines, pure JAX ones, and your own.

env = envs.make("hopper")                    # the bare task: no time limit, no automatic reset
env = envs.make("hopper", engine="mjx", healthy_reward=0.5)
env = with_episodes(env, envs.spec("hopper").time_limit)
envs.register("mine", MyEnv, time_limit=500)  # then envs.make("mine")
"""

import importlib
from typing import TYPE_CHECKING, Any

from envs.registry import EnvSpec, make, names, register, spec

if TYPE_CHECKING:
    from envs.base import Env, State, with_episodes
    from envs.frames import Painter
    from envs.mujoco_tasks.task import MujocoTask
    from envs.recording import Episode, Player
    from envs.scored import ScoredMetric

__all__ = [
    "Env",
    "EnvSpec",
    "Episode",
    "MujocoTask",
    "Painter",
    "Player",
    "ScoredMetric",
    "State",
    "make",
    "names",
    "register",
    "spec",
    "with_episodes",
]

# Imported at their first use: behind the environments stand JAX, Brax and MuJoCo, two seconds
# that the list of names can do without.
_LATER = {
    "Env": "envs.base",
    "State": "envs.base",
    "with_episodes": "envs.base",
    "MujocoTask": "envs.mujoco_tasks.task",
    "Episode": "envs.recording",
    "Painter": "envs.frames",
    "Player": "envs.recording",
    "ScoredMetric": "envs.scored",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    return getattr(importlib.import_module(_LATER[name]), name)
