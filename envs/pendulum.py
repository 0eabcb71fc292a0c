"""Pendulum: a torque-limited pendulum to be swung up and held upright; Gymnasium's, in JAX."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Float64

from envs.base import Action, Env, State
from envs.frames import Canvas, Painter, Picture

DT, MASS, LENGTH = 0.05, 1.0, 1.0  # s, kg, m
MAX_SPEED = 8.0  # rad/s
MAX_TORQUE = np.float32(2.0)  # N m
MOST = np.array([1.0, 1.0, MAX_SPEED], np.float32)  # of the observation
START = np.array(
    [np.pi, 1.0], np.float32
)  # rad, rad/s: angle and speed start uniform within ±START


class Pendulum(Env):
    """Gymnasium's Pendulum-v1.

    action       [1] torque; ±1 is ±2 N m
    observation  [3] cosine and sine of the angle (0 is upright), angular velocity (rad/s)
    reward       -(angle² + 0.1 · velocity² + 0.001 · torque²), the angle in [-π, π)
    start        angle uniform in ±π, velocity uniform within ±1 rad/s
    end          never

    Near the top an error grows e-fold in 0.26 s: in float32 most episodes of random actions would
    drift by more than 1e-5. So angle and velocity are float64, as in Gymnasium, and travel as
    their bits, [2, 2] uint32, which JAX carries whatever its default precision.
    """

    action_high = np.array([MAX_TORQUE])
    observation_bounds = (-MOST, MOST)
    dt = DT

    def __init__(self, g: float = 10.0):  # m/s²
        self.g = g

    @property
    def observation_size(self) -> int:
        return 3

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "jax"

    def reset(self, rng: jax.Array) -> State:
        return self.reset_to(*jax.random.uniform(rng, (2,), minval=-START, maxval=START))

    def reset_to(self, theta, theta_dot) -> State:
        """Start at an angle (rad) and angular velocity (rad/s); float64 keeps every bit."""
        with jax.enable_x64(True):
            values = jnp.stack([jnp.asarray(x, jnp.float64) for x in (theta, theta_dot)])
            zero = jnp.zeros((), jnp.float32)
            return State(_to_bits(values), _observation(values), zero, zero, {}, {})

    def step(self, state: State, action: Action) -> State:
        torque = (self.clipped(action) * MAX_TORQUE)[0]
        with jax.enable_x64(True):
            theta, theta_dot = _from_bits(state.pipeline_state)
            angle = (theta + np.pi) % (2 * np.pi) - np.pi
            cost = angle**2 + 0.1 * theta_dot**2 + 0.001 * torque**2
            gravity = 3 * self.g / (2 * LENGTH) * jnp.sin(theta)
            acceleration = gravity + 3.0 / (MASS * LENGTH**2) * torque
            theta_dot = jnp.clip(theta_dot + acceleration * DT, -MAX_SPEED, MAX_SPEED)
            values = jnp.stack([theta + theta_dot * DT, theta_dot])
            return state.replace(
                pipeline_state=_to_bits(values),
                obs=_observation(values),
                reward=-cost.astype(jnp.float32),
                done=jnp.zeros((), jnp.float32),
            )

    def painter(self, width: int, height: int) -> Painter:
        """The rod, upright where the angle is 0."""

        def paint(bits: Any) -> Picture:
            angle = np.ascontiguousarray(bits).view(np.float64)[0, 0]
            tip = np.array([-np.sin(angle), np.cos(angle)]) * LENGTH
            canvas = Canvas((-1.3, -1.3), (1.3, 1.3), width, height)
            canvas.line([np.zeros(2), tip], "#b3402a", 0.2)
            canvas.disc(tip, 0.1, "#b3402a")
            canvas.disc(np.zeros(2), 0.05, "black")
            return canvas.picture()

        return paint


def _to_bits(values: Float64[Array, "2"]) -> Any:
    return jax.lax.bitcast_convert_type(values, jnp.uint32)


def _from_bits(bits: Any) -> Float64[Array, "2"]:
    return jax.lax.bitcast_convert_type(bits, jnp.float64)


def _observation(values: Float64[Array, "2"]) -> Float32[Array, "3"]:
    theta, theta_dot = values
    return jnp.stack([jnp.cos(theta), jnp.sin(theta), theta_dot]).astype(jnp.float32)
