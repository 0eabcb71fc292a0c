"""Names of environments, and how each is made."""

import dataclasses
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import jax

from envs.base import Env

MUJOCO_ENGINES = ("native", "mjx")


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
    factory: Callable[[], Callable[..., Any]]
    """Imports and returns the class, whose keyword arguments are the environment's options."""


def _mujoco(name: str, module: str, class_name: str) -> EnvSpec:
    def factory():
        return getattr(importlib.import_module(f"envs.mujoco_tasks.{module}"), class_name)

    task = factory()
    return EnvSpec(name, MUJOCO_ENGINES, task.gymnasium_id, task.time_limit, factory)


_SPECS: dict[str, EnvSpec] = {spec.name: spec for spec in (_mujoco("hopper", "hopper", "Hopper"),)}


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_SPECS)


def spec(name: str) -> EnvSpec:
    """What is known of the environment `name`.

    Raises:
      ValueError: if there is no such environment.
    """
    if name not in _SPECS:
        raise ValueError(f"unknown environment {name!r}; known are {', '.join(names())}")
    return _SPECS[name]


def make(name: str, engine: str = "auto", **options: Any) -> Env:
    """The bare task `name`: `done` is termination only; no time limit and no automatic reset.

    Args:
      name: one of `names()`.
      engine: a physics engine; "auto" takes MuJoCo's C engine where JAX runs on a CPU, MJX elsewhere.
      **options: the constructor arguments of the task, Gymnasium's where it equals one of them.

    Raises:
      ValueError: if the name, the engine or an option is unknown.
    """
    found = spec(name)
    cls = found.factory()
    known = [p for p in inspect.signature(cls).parameters]
    for option in options:
        if option not in known:
            raise ValueError(f"{name} has no option {option!r}; it has {', '.join(known)}")
    if engine == "auto":
        default = "native" if jax.default_backend() == "cpu" else "mjx"
        engine = default if default in found.engines else found.engines[0]
    if engine not in found.engines:
        raise ValueError(f"{name} has no engine {engine!r}; it has {', '.join(found.engines)}")
    if engine == "jax":
        return cls(**options)
    from envs.mujoco_env import MujocoEnv

    return MujocoEnv(cls(**options), engine)
