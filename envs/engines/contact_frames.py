"""MuJoCo's contact frames between a plane and a capsule, in MJX.

MuJoCo turns the friction pyramid of such a contact along the capsule. MJX does so only for a
capsule that leans by more than 30° from the plane's normal, and else takes a fixed direction. A
pyramid is not a cone: turned, it allows other forces, and without this correction a third of an
Ant's control steps come out differently, by up to 0.02 in qpos and 1.5 in qvel.
"""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src.types import GeomType

PAIR = (GeomType.PLANE, GeomType.CAPSULE)
MIN_LENGTH = 1e-6  # of the capsule's unit axis seen from above: shorter ones have no direction

_wanted = ContextVar("MuJoCo's contact frames", default=False)  # each thread has its own
_mjx_plane_capsule = collision_driver._COLLISION_FUNC[PAIR]


@contextlib.contextmanager
def mujoco_contact_frames() -> Iterator[None]:
    """What this thread traces inside has MuJoCo's frames; MJX is as it was for everybody else."""
    token = _wanted.set(True)
    try:
        yield
    finally:
        _wanted.reset(token)


def _plane_capsule(
    model: mjx.Model, data: mjx.Data, key: object, geoms: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances, positions and frames of two contacts a pair, as MJX's table of colliders wants."""
    distance, position, frame = _mjx_plane_capsule(model, data, key, geoms)
    if not _wanted.get():
        return distance, position, frame
    normal = frame[:, 0]
    axis = jnp.repeat(data.geom_xmat[geoms[:, 1], :, 2], _mjx_plane_capsule.ncon, axis=0)
    along = axis - normal * (normal * axis).sum(-1, keepdims=True)
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    along = jnp.where(length > MIN_LENGTH, along / jnp.maximum(length, MIN_LENGTH), frame[:, 1])
    return distance, position, jnp.stack([normal, along, jnp.cross(normal, along)], 1)


_plane_capsule.ncon = _mjx_plane_capsule.ncon  # pyright: ignore[reportFunctionMemberAccess]
collision_driver._COLLISION_FUNC[PAIR] = _plane_capsule
