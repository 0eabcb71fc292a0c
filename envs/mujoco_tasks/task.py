"""What a MuJoCo task says of itself, once, for every physics engine."""

import dataclasses
import functools
import importlib.util
import pathlib
import warnings
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from envs.mujoco_tasks.restriction import Balls
from envs.scored import ScoredMetric

Array = Any
"""A NumPy float64 array with leading batch axes (native), or a JAX array of one instance (MJX)."""

_gymnasium = importlib.util.find_spec("gymnasium")  # its files; its code is not needed
assert _gymnasium and _gymnasium.origin
ASSETS = pathlib.Path(_gymnasium.origin).parent / "envs" / "mujoco" / "assets"


class Physics:
    """The physics fields a task reads, named as in `mujoco.MjData`; leading axes are batch axes."""

    def __init__(self, **fields: Array):
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> Array:
        raise AttributeError(f"the task reads {name!r} but does not list it in `fields`")


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoTask:
    """A task over an array namespace `xp` (NumPy or `jax.numpy`) and a record of physics fields.

    Every method indexes from the last axis, so that the same lines serve one instance and a batch.
    The dataclass fields of a task are the constructor arguments of its Gymnasium counterpart, and
    `restricted`.
    As in Gymnasium, all fields but qpos and qvel are what MuJoCo derived last: a substep earlier.
    """

    fields: ClassVar[tuple[str, ...]] = ()
    """What is read besides qpos and qvel. cfrc_ext costs a pass over the contacts."""
    scored_metrics: ClassVar[tuple[ScoredMetric, ...]] = ()
    """What belongs to a score, beside the return."""
    published_k: ClassVar[float | None] = None
    """K of the restricted task in Q3C's table, where it has one."""

    xml_file: str = ""
    """One of Gymnasium's model files, or a path that begins with "/", "." or "~"."""
    frame_skip: int = 1
    """Physics steps per environment step."""
    restricted: bool | float = False
    """Takes actions within Q3C's balls only, and others as 0: K, or True for the K of its table."""

    def __post_init__(self):
        if self.frame_skip < 1:
            raise ValueError(f"frame_skip must be at least 1, got {self.frame_skip}")

    @functools.cached_property
    def model(self) -> mujoco.MjModel:
        path = pathlib.Path(self.xml_file).expanduser()
        relative = self.xml_file.startswith(".")
        if not (path.is_absolute() or relative):
            path = ASSETS / path
        if not path.is_file():
            where = "; relative paths begin at the working folder, so give an absolute one"
            raise ValueError(f"there is no model file {path.absolute()}{where if relative else ''}")
        with warnings.catch_warnings():
            # HalfCheetah's file has it; nobody who runs the task can do anything about it.
            warnings.filterwarnings("ignore", "compiler attribute 'settotalmass' is deprecated")
            return mujoco.MjSpec.from_file(str(path)).compile()

    @functools.cached_property
    def dt(self) -> float:
        """Seconds per environment step."""
        return self.model.opt.timestep * self.frame_skip

    @functools.cached_property
    def action_high(self) -> np.ndarray:
        """Upper bound of Gymnasium's action space, [A] float32; the lower one is its negative."""
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        if not np.array_equal(low, -high):
            raise ValueError(
                f"{self.xml_file}: control ranges must be symmetric, got {low}, {high}"
            )
        return high

    @functools.cached_property
    def balls(self) -> Balls | None:
        """The actions that a restricted task takes.

        Raises:
          ValueError: if K is missing, out of range, or leaves no valid action.
        """
        k = self.published_k if self.restricted is True else self.restricted
        if k is None:
            raise ValueError(
                f"Q3C's table has no K for {type(self).__name__}: write restricted=K, such as "
                "restricted=1.0"
            )
        return None if k is False else Balls(k, self.model.nu)

    def start_offset(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A draw of (qpos, qvel) minus the model's initial ones, [nq] and [nv] float32."""
        raise NotImplementedError

    def observation(self, xp, physics: Physics) -> Array:
        """[..., D]"""
        raise NotImplementedError

    def anchor(self, xp, physics: Physics) -> Array:
        """What the next step's reward must remember of this one, [..., K]; positions, mostly."""
        return physics.qpos[..., :0]

    def reward(self, xp, anchor: Array, physics: Physics, control: Array) -> tuple[Array, dict]:
        """The reward [...], and the entries of Gymnasium's `info` as metrics.

        Args:
          xp: array namespace.
          anchor: `anchor` of the previous step.
          physics: after the step.
          control: in Gymnasium's units, [..., A] float32.
        """
        raise NotImplementedError

    def terminated(self, xp, physics: Physics) -> Array:
        """Whether the task ended, [...] bool."""
        return xp.zeros(physics.qpos.shape[:-1], bool)


def within(x: Array, bounds: tuple[float, float]) -> Array:
    """Whether x lies strictly between two bounds."""
    low, high = bounds
    return (low < x) & (x < high)


def flat(x: Array) -> Array:
    """[..., bodies, K] as [..., bodies * K]."""
    return x.reshape(*x.shape[:-2], -1)


def plane_metrics(xp, position: Array, velocity: Array) -> dict[str, Array]:
    """Gymnasium's `info` of a body that moves in the plane, from [..., 2] m and [..., 2] m/s."""
    return {
        "x_position": position[..., 0],
        "y_position": position[..., 1],
        "distance_from_origin": xp.linalg.norm(position, axis=-1),
        "x_velocity": velocity[..., 0],
        "y_velocity": velocity[..., 1],
    }


def uniform(key: jax.Array, scale: float, size: int) -> Float[jax.Array, "size"]:
    """Independent draws within ±scale."""
    return jax.random.uniform(key, (size,), jnp.float32, -scale, scale)


def uniform_offset(
    key: jax.Array, scale: float, nq: int, nv: int
) -> tuple[Float[jax.Array, "nq"], Float[jax.Array, "nv"]]:
    """Positions and velocities uniform within ±scale."""
    qpos_key, qvel_key = jax.random.split(key)
    return uniform(qpos_key, scale, nq), uniform(qvel_key, scale, nv)


def uniform_and_normal_offset(
    key: jax.Array, scale: float, nq: int, nv: int
) -> tuple[Float[jax.Array, "nq"], Float[jax.Array, "nv"]]:
    """Positions uniform within ±scale, velocities normal with standard deviation `scale`."""
    qpos_key, qvel_key = jax.random.split(key)
    return uniform(qpos_key, scale, nq), scale * jax.random.normal(qvel_key, (nv,), jnp.float32)
