"""A scripted driver: the baseline to beat, and the proof that each circuit can be driven."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.driving.bank import SIGHT
from envs.driving.sensors import KMH, TOP_SPEED_KMH
from envs.driving.vehicle import STEER_LOCK

CENTRING = 0.5  # rad of steering a half width off the centre
AHEAD = 10.0  # degrees to either side that count as ahead
CAUTION = 8.0  # m/s², at which it could stop before the edge it sees
ACCELERATOR_GAIN, BRAKE_GAIN = 0.5, 0.1  # per m/s
STRONGEST_BRAKE = 0.25  # harder locks the front wheels


def scripted_driver(
    ray_angles: tuple[float, ...],
) -> Callable[[Float[Array, "29"]], Float[Array, "3"]]:
    """A policy in the spirit of SCR's SimpleDriver: action = policy(observation).

    It steers along the track and towards its centre, and drives no faster than it could stop
    within the free road that it sees ahead: $v = \\sqrt{2 a d}$.

    Args:
      ray_angles: `Driving.ray_angles` of the environment.
    """
    ahead = np.abs(np.asarray(ray_angles)) <= AHEAD

    def policy(observation):
        angle, position = observation[0] * jnp.pi, observation[20]
        rays = observation[1:20] * SIGHT
        speed = observation[21] * TOP_SPEED_KMH / KMH
        free = jnp.where(ahead, rays, 0.0).max()
        too_slow = jnp.sqrt(2 * CAUTION * jnp.maximum(free, 1.0)) - speed
        steer = (angle - CENTRING * position) / STEER_LOCK
        accelerator = jnp.clip(ACCELERATOR_GAIN * too_slow, 0.0, 1.0)
        brake = jnp.clip(-BRAKE_GAIN * too_slow, 0.0, STRONGEST_BRAKE)
        return jnp.clip(jnp.stack([steer, 2 * accelerator - 1, brake]), -1.0, 1.0)

    return policy
