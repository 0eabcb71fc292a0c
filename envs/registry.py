"""Names of environments, and how each is made."""

import dataclasses
import importlib.metadata
import inspect
import pkgutil
import re
import typing
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from envs.values import fits, fitted

if TYPE_CHECKING:  # at run time each is imported where an environment is made: see `envs`
    from envs.base import Env

BRAX, GYMNASIUM, PLAYGROUND = "brax:", "gym:", "playground:"
ENTRY_POINTS = "mapg_jax.envs"
"""The group in which an installed package names its environments."""
PHYSICS_ENGINES = ("native", "mjx", "mjx-warp")
WITH_CONTACT_FORCES = ("native", "mjx")
"""Engines of tasks that observe them: Warp does not compute them."""


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """What is known of an environment before it is made."""

    name: str
    engines: tuple[str, ...]
    """The physics engines it runs on; ("jax",) for one that needs none."""
    gymnasium_id: str | None
    """The Gymnasium task it equals."""
    time_limit: int
    """Steps after which an episode is truncated."""
    constructor: Callable[..., Any] | str
    """Makes an `Env`, a `MujocoTask` or an environment of Brax; its keyword arguments are the
    options. Text "module:name" is imported at the first use."""

    def load(self) -> Callable[..., Any]:
        """The constructor itself."""
        constructor = self.constructor
        return pkgutil.resolve_name(constructor) if isinstance(constructor, str) else constructor


_SPECS: dict[str, EnvSpec] = {}


def register(
    name: str,
    make: Callable[..., Any] | str,
    *,
    time_limit: int,
    gymnasium_id: str | None = None,
    engines: tuple[str, ...] | None = None,
) -> None:
    """Adds an environment under a name, for this process.

    Args:
      name: letters, digits, - and _, beginning with a letter.
      make: a class or function that returns an `Env`, a `MujocoTask` or an environment of Brax, or
        "module:name" of one; its keyword arguments are the options.
      time_limit: steps after which an episode is truncated.
      gymnasium_id: the Gymnasium task it equals.
      engines: the physics engines it runs on; all where `make` is a `MujocoTask`, else "jax".

    Raises:
      ValueError: if the name is taken or malformed, or the time limit is below 1.
    """
    if not re.fullmatch(r"[A-Za-z][\w-]*", name, re.ASCII):
        raise ValueError(
            "an environment's name is letters, digits, - and _, beginning with a letter; "
            f"got {name!r}"
        )
    if name in _SPECS:
        raise ValueError(f"there is an environment {name!r} already; choose another name")
    if time_limit < 1:
        raise ValueError(f"time_limit must be at least 1 step, got {time_limit}")
    if engines is None:
        engines = PHYSICS_ENGINES if _is_task(make) else ("jax",)
    _SPECS[name] = EnvSpec(name, engines, gymnasium_id, time_limit, make)


def names() -> tuple[str, ...]:
    """The names that `make` takes, besides `brax:<name>`, `gym:<name>` and
    `playground:<name>`.

    Those of installed packages are not loaded.
    """
    return tuple(dict.fromkeys([*_SPECS, *_entry_points()]))


def loaded() -> tuple[EnvSpec, ...]:
    """What is known without importing anything: not what installed packages name."""
    return tuple(_SPECS.values())


def spec(name: str) -> EnvSpec:
    """What is known of the environment `name`.

    Raises:
      ValueError: if there is no such environment, or its package cannot be loaded.
    """
    if name.startswith(BRAX):
        from envs.interop import brax

        constructor = brax.constructor(name.removeprefix(BRAX))
        return EnvSpec(name, ("jax",), None, brax.TIME_LIMIT, constructor)
    if name.startswith(GYMNASIUM):
        from envs.interop import hosted

        own = name.removeprefix(GYMNASIUM)
        make, limit = hosted.constructor(own), hosted.time_limit(own)
        return EnvSpec(name, ("gymnasium",), own, limit, make)
    if name.startswith(PLAYGROUND):
        from envs.interop import playground

        own = name.removeprefix(PLAYGROUND)
        make, limit = playground.constructor(own), playground.time_limit(own)
        return EnvSpec(name, ("mjx",), None, limit, make)
    if name not in _SPECS:
        found = _entry_points()
        if name not in found:
            raise ValueError(
                f"unknown environment {name!r}; known are {', '.join(names())}, "
                f"{BRAX}<name> for those of Brax, {GYMNASIUM}<name> for those of Gymnasium and "
                f"{PLAYGROUND}<name> for those of MuJoCo Playground"
            )
        _load(found[name])
    return _SPECS[name]


def make(name: str, /, engine: str = "auto", **options: Any) -> "Env":
    """The bare task `name`: `done` is termination only; no time limit and no automatic reset.

    Args:
      name: one of `names()`, `brax:<name>` for one of Brax's, `gym:<name>` for Gymnasium's, or
        `playground:<name>` for MuJoCo Playground's.
      engine: a physics engine; "auto" takes MuJoCo's C engine where JAX runs on a CPU, else MJX.
      **options: the constructor arguments of the task, Gymnasium's where it equals one of them.

    Raises:
      ValueError: if the name, the engine or an option is unknown, or its actions have no bounds.
    """
    found = spec(name)
    constructor = found.load()
    options = _checked(name, inspect.signature(constructor, eval_str=True).parameters, options)
    if engine == "auto":
        engine = _default_engine(found)
    if engine not in found.engines:
        raise ValueError(f"{name} has no engine {engine!r}; it has {', '.join(found.engines)}")
    return _bounded(name, _as_env(name, constructor(**options), engine))


def _default_engine(spec: EnvSpec) -> str:
    import jax

    default = "native" if jax.default_backend() == "cpu" else "mjx"
    return default if default in spec.engines else spec.engines[0]


def _checked(
    name: str, parameters: Mapping[str, inspect.Parameter], options: Mapping[str, Any]
) -> dict[str, Any]:
    """The options, as the constructor's annotations have them; others are refused."""
    if name.startswith((GYMNASIUM, PLAYGROUND)):  # whose constructors say what they take
        return dict(options)
    checked = {}
    known = {k: p for k, p in parameters.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    for option, value in options.items():
        if option not in known:
            raise ValueError(
                f"{name} has no option {option!r}; it has {', '.join(known) or 'none'}"
            )
        hint = known[option].annotation
        hint = Any if hint is inspect.Parameter.empty else hint
        checked[option] = fitted(value, hint)
        if not fits(checked[option], hint):
            raise ValueError(f"{name}'s option {option} must be {_text(hint)}, got {value!r}")
    missing = [k for k, p in known.items() if p.default is p.empty and k not in options]
    if missing:
        raise ValueError(f"{name} needs the option {missing[0]!r}")
    return checked


def _text(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(repr, typing.get_args(hint)))
    return getattr(hint, "__name__", str(hint)) if isinstance(hint, type) else str(hint)


def _as_env(name: str, made: Any, engine: str) -> "Env":
    from envs.base import Env
    from envs.mujoco_tasks.task import MujocoTask

    if isinstance(made, Env):
        return made
    if isinstance(made, MujocoTask):
        from envs.mujoco_env import MujocoEnv

        if engine not in PHYSICS_ENGINES:
            raise ValueError(f"{name} is a MuJoCo task: register it with engines={PHYSICS_ENGINES}")
        return MujocoEnv(made, engine)
    from envs.interop.brax import BraxEnv, is_brax  # Brax takes a second to import

    if is_brax(made):
        return BraxEnv(made)
    raise ValueError(
        f"{name} must be an Env, a MujocoTask or an environment of Brax, got {type(made).__name__}"
    )


def _bounded(name: str, env: "Env") -> "Env":
    """The environment, whose actions are shares of a bound."""
    import numpy as np

    most = np.asarray(env.action_high)
    if np.isfinite(most).all() and (most > 0).all():
        return env
    raise ValueError(
        f"{name} has actions of up to {most.tolist()}: action_high must be finite and above 0"
    )


def _is_task(make: Any) -> bool:
    if not isinstance(make, type):
        return False
    from envs.mujoco_tasks.task import MujocoTask

    return issubclass(make, MujocoTask)


def _entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}


def _load(point: importlib.metadata.EntryPoint) -> None:
    """Imports what an installed package names; the import registers the environment."""
    package = point.dist.name if point.dist else point.value
    try:
        point.load()
    except Exception as error:  # whatever a stranger's module does
        raise ValueError(
            f"the environment {point.name!r} of the package {package} cannot be loaded: {error!r}"
        ) from error
    if point.name not in _SPECS:
        raise ValueError(
            f"the package {package} names an environment {point.name!r}, but importing "
            f"{point.value} does not register it"
        )


def _register_task(
    name: str, task: str, time_limit: int = 1000, engines: tuple[str, ...] = PHYSICS_ENGINES
) -> None:
    """One of Gymnasium's tasks on MuJoCo."""
    register(
        name,
        f"envs.mujoco_tasks.{name}:{task}",
        time_limit=time_limit,
        gymnasium_id=f"{task}-v5",
        engines=engines,
    )


register("pendulum", "envs.pendulum:Pendulum", time_limit=200, gymnasium_id="Pendulum-v1")
_register_task("hopper", "Hopper")
_register_task("walker2d", "Walker2d")
_register_task("halfcheetah", "HalfCheetah")
_register_task("swimmer", "Swimmer")
_register_task("humanoid", "Humanoid", engines=WITH_CONTACT_FORCES)
_register_task("inverted_pendulum", "InvertedPendulum")
_register_task("inverted_double_pendulum", "InvertedDoublePendulum")
_register_task("ant", "Ant", engines=WITH_CONTACT_FORCES)
_register_task("reacher", "Reacher", time_limit=50)
_register_task("pusher", "Pusher", time_limit=100)
_register_task("humanoid_standup", "HumanoidStandup", engines=WITH_CONTACT_FORCES)
register("driving", "envs.driving.env:Driving", time_limit=10_000)  # 200 s at 50 Hz
register("two_mode_bandit", "envs.bandits.bandits:TwoModeBandit", time_limit=1)
register("four_bump_bandit", "envs.bandits.bandits:FourBumpBandit", time_limit=1)
register("multi_goal", "envs.points.multi_goal:MultiGoal", time_limit=30)
register("point_maze", "envs.points.point_maze:PointMaze", time_limit=500)
