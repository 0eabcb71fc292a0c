"""What is known of one car that drives: where it is, and what has been counted since the start."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs.driving.sensors import KMH
from envs.driving.setup import Setup
from envs.driving.vehicle import Car

Values = Any
"""A JAX array, or a NumPy one where states are recorded, with axes in front: [T], [N]."""


class Drive(struct.PyTreeNode):
    """One instance: the car, where it is, and what has been counted since the start."""

    car: Car
    track: jax.Array  # [] i32, index into the bank
    cell: jax.Array  # [] i32
    crossings: jax.Array  # [] i32, of the start line, forwards less backwards
    start: jax.Array  # [] m, s at the start
    distance: jax.Array  # [] m along the centre line from the start
    steps: jax.Array  # [] i32, control steps
    off_steps: jax.Array  # [] i32, of them off the track
    slow_steps: jax.Array  # [] i32, the latest ones without progress
    laps: jax.Array  # [] i32, completed
    lap_began: jax.Array  # [] s
    last_lap: jax.Array  # [] s, 0 before the first lap's end
    lap_times: jax.Array  # [L] s, of the first L laps, 0 for those that are not completed
    setup: Setup | None = None  # of this episode, where it is drawn

    @property
    def x(self) -> Values:
        """m"""
        return self.car.x

    @property
    def y(self) -> Values:
        """m"""
        return self.car.y

    @property
    def heading(self) -> Values:
        """rad"""
        return self.car.heading

    @property
    def speed(self) -> Values:
        """m/s over the ground."""
        return jnp.sqrt(self.car.velocity_x**2 + self.car.velocity_y**2)


def metrics(drive: Drive) -> dict[str, jax.Array]:
    """Of `State.metrics`, each with its unit."""
    return {
        "distance": drive.distance,  # m
        "laps": drive.laps.astype(jnp.float32),
        "last_lap_time": drive.last_lap,  # s
        "best_lap_time": _best(drive.lap_times),  # s
        "off_track": drive.off_steps / jnp.maximum(drive.steps, 1),  # share of the steps so far
        "speed": drive.speed * KMH,  # km/h
    }


def _best(lap_times: jax.Array) -> jax.Array:
    """s, the shortest of the laps that are completed; 0 before the first one's end."""
    best = jnp.where(lap_times > 0, lap_times, jnp.inf).min()
    return jnp.where(jnp.isfinite(best), best, 0.0)
