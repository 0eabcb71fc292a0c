"""Rewards by name, of one control step."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.driving.sensors import KMH, TOP_SPEED_KMH


class Motion(NamedTuple):
    """What rewards are made of, at the end of a control step."""

    speed: Float[Array, ""]
    """v, m/s along the car's axis."""
    angle: Float[Array, ""]
    """α, rad, from the car's axis to the track's."""
    position: Float[Array, ""]
    """p, across the road: beyond ±1 off the track."""


def progress_kmh(motion: Motion) -> Float[Array, ""]:
    """v cos α in km/h, as in the MAPG paper and gym_torcs."""
    return KMH * motion.speed * jnp.cos(motion.angle)


def progress(motion: Motion) -> Float[Array, ""]:
    """v cos α in units of 300 km/h: at most about 1 a step, so that critics need no scaling."""
    return progress_kmh(motion) / TOP_SPEED_KMH


def gym_torcs(motion: Motion) -> Float[Array, ""]:
    """gym_torcs: v cos α in km/h on the track, -1 off it."""
    return jnp.where(jnp.abs(motion.position) > 1, -1.0, progress_kmh(motion))


def ddpg_keras(motion: Motion) -> Float[Array, ""]:
    """DDPG-Keras-Torcs: v cos α - |v sin α| - v |p|, v in km/h."""
    v = KMH * motion.speed
    sideways = jnp.abs(v * jnp.sin(motion.angle))
    return progress_kmh(motion) - sideways - v * jnp.abs(motion.position)


REWARDS: dict[str, Callable[[Motion], Float[Array, ""]]] = {
    "progress": progress,
    "progress_kmh": progress_kmh,
    "gym_torcs": gym_torcs,
    "ddpg_keras": ddpg_keras,
}
