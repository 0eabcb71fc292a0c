"""Names of environments, and how each is made."""

import dataclasses
import inspect
import typing
from collections.abc import Callable
from typing import Any

import jax

from envs.base import Env
from envs.driving.env import Driving
from envs.interop import brax
from envs.mujoco_env import ENGINES, MujocoEnv
from envs.mujoco_tasks.ant import Ant
from envs.mujoco_tasks.halfcheetah import HalfCheetah
from envs.mujoco_tasks.hopper import Hopper
from envs.mujoco_tasks.humanoid import Humanoid
from envs.mujoco_tasks.humanoid_standup import HumanoidStandup
from envs.mujoco_tasks.inverted_double_pendulum import InvertedDoublePendulum
from envs.mujoco_tasks.inverted_pendulum import InvertedPendulum
from envs.mujoco_tasks.pusher import Pusher
from envs.mujoco_tasks.reacher import Reacher
from envs.mujoco_tasks.swimmer import Swimmer
from envs.mujoco_tasks.task import MujocoTask
from envs.mujoco_tasks.walker2d import Walker2d
from envs.pendulum import Pendulum
from envs.values import fits

BRAX = "brax:"


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """What is known of an environment before it is made."""

    name: str
    engines: tuple[str, ...]
    """The physics engines it runs on."""
    gymnasium_id: str | None
    """The Gymnasium task it equals."""
    time_limit: int
    """Steps after which an episode is truncated."""
    cls: Callable[..., Any]
    """A task for the physics engines, or an environment; its keyword arguments are the options."""


def _mujoco(name: str, task: type[MujocoTask]) -> EnvSpec:
    return EnvSpec(name, tuple(ENGINES), task.gymnasium_id, task.time_limit, task)


_SPECS = {
    spec.name: spec
    for spec in (
        EnvSpec("pendulum", ("jax",), "Pendulum-v1", 200, Pendulum),
        _mujoco("hopper", Hopper),
        _mujoco("walker2d", Walker2d),
        _mujoco("halfcheetah", HalfCheetah),
        _mujoco("swimmer", Swimmer),
        _mujoco("humanoid", Humanoid),
        _mujoco("inverted_pendulum", InvertedPendulum),
        _mujoco("inverted_double_pendulum", InvertedDoublePendulum),
        _mujoco("ant", Ant),
        _mujoco("reacher", Reacher),
        _mujoco("pusher", Pusher),
        _mujoco("humanoid_standup", HumanoidStandup),
        EnvSpec("driving", ("jax",), None, 10_000, Driving),  # 200 s at 50 Hz
    )
}


def names() -> tuple[str, ...]:
    """The names that `make` takes, besides `brax:<name>`."""
    return tuple(_SPECS)


def spec(name: str) -> EnvSpec:
    """What is known of the environment `name`.

    Raises:
      ValueError: if there is no such environment.
    """
    if name.startswith(BRAX):
        cls = brax.environment_class(name.removeprefix(BRAX))
        return EnvSpec(name, ("jax",), None, brax.TIME_LIMIT, cls)
    if name not in _SPECS:
        raise ValueError(
            f"unknown environment {name!r}; known are {', '.join(names())}, "
            f"and {BRAX}<name> for those of Brax"
        )
    return _SPECS[name]


def make(name: str, /, engine: str = "auto", **options: Any) -> Env:
    """The bare task `name`: `done` is termination only; no time limit and no automatic reset.

    Args:
      name: one of `names()`, or `brax:<name>` for one of Brax's.
      engine: a physics engine; "auto" takes MuJoCo's C engine where JAX runs on a CPU, else MJX.
      **options: the constructor arguments of the task, Gymnasium's where it equals one of them.

    Raises:
      ValueError: if the name, the engine or an option is unknown.
    """
    found = spec(name)
    parameters = inspect.signature(found.cls).parameters.values()
    known = [p.name for p in parameters if p.kind is not p.VAR_KEYWORD]
    hints = typing.get_type_hints(found.cls.__init__)
    for option, value in options.items():
        if option not in known:
            raise ValueError(f"{name} has no option {option!r}; it has {', '.join(known)}")
        hint = hints.get(option, Any)
        if not fits(value, hint):
            expected = getattr(hint, "__name__", hint) if isinstance(hint, type) else hint
            raise ValueError(f"{name}'s option {option} must be {expected}, got {value!r}")
    if engine == "auto":
        default = "native" if jax.default_backend() == "cpu" else "mjx"
        engine = default if default in found.engines else found.engines[0]
    if engine not in found.engines:
        raise ValueError(f"{name} has no engine {engine!r}; it has {', '.join(found.engines)}")
    made = found.cls(**options)
    if isinstance(made, MujocoTask):
        return MujocoEnv(made, engine)
    return brax.BraxEnv(made) if name.startswith(BRAX) else made
