"""The tyre law of TORCS's simuv2, for the four wheels at once.

Wheels are ordered front right, front left, rear right, rear left, as the sensors report them.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def per_axle(front: float, rear: float) -> Float[np.ndarray, "4"]:
    """A number of each wheel that is the same on both sides."""
    return np.array([front, front, rear, rear], np.float32)


def total(values: Float[Array, "4"]) -> Float[Array, ""]:
    """The sum over the wheels; written out, since XLA fuses additions but not so short a sum."""
    return values[0] + values[1] + values[2] + values[3]


STIFFNESS, DYNAMIC_FRICTION, CURVATURE = 20.0, 0.80, 0.7  # slope at 0, share of the peak, E
SHAPE = 2 - 2 / math.pi * math.asin(DYNAMIC_FRICTION)  # C
STEEPNESS = STIFFNESS / SHAPE  # B
SKID_GAIN = 0.30  # per unit of slip: the factor of TORCS's default skill level, semi-pro
LARGEST_SLIP = 1.5

MU = 1.6
LOAD_FACTOR_MIN, LOAD_FACTOR_MAX = 0.8, 1.6
LOAD_DECAY = math.log((1 - LOAD_FACTOR_MIN) / (LOAD_FACTOR_MAX - LOAD_FACTOR_MIN))
RATED_LOAD = per_axle(3518.0, 3247.0)  # N, where the load factor is 1
CAMBER_FACTOR = per_axle(1.0476, 1.0405)  # of -4 and -3 degrees

SPEED_FLOOR = 3.0  # m/s
"""Slip is measured against at least this speed.

The law divides by the wheel's speed, so its stiffness grows without bound towards standstill, where
any explicit step would ring. Below the floor the tyre is a damper of constant strength instead:
forces fade to exactly zero with the motion. Above it nothing changes.
"""


ARCTAN = np.array(
    [-0.01172120, 0.05265332, -0.11643287, 0.19354346, -0.33262347, 0.99997726], np.float32
)
COSINE = np.array([(-1) ** n / math.factorial(2 * n) for n in range(6, -1, -1)], np.float32)


class TyreForces(NamedTuple):
    along: Float[Array, "4"]
    """N, in the wheel's plane, forwards."""
    across: Float[Array, "4"]
    """N, to the wheel's left."""
    stiffness: Float[Array, "4"]
    """N s/m, the force along the wheel per m/s of its rim, at the present slip."""


def grip(slip: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Force as a share of load times friction, at a combined slip.

    $F(s) = \sin(C \arctan(B s (1 - E) + E \arctan(B s))) (1 + 0.3 s)$, $s$ at most 1.5   (simuv2)
    """
    slip = jnp.minimum(slip, LARGEST_SLIP)
    x = STEEPNESS * slip
    bend = _arctan(x * (1 - CURVATURE) + CURVATURE * _arctan(x))
    return _sin(SHAPE * bend) * (1 + SKID_GAIN * slip)


# XLA's arctan calls libm lane by lane on a CPU, and its sin reduces any argument. These are a third
# of the whole step otherwise; their arguments here are bounded, and their errors below 2e-6.
def _arctan(x):
    """For x at least 0. Coefficients: Chebyshev fit on [0, 1]."""
    small = jnp.where(x > 1, 1 / jnp.maximum(x, 1.0), x)
    square = small**2
    series = small * jnp.polyval(ARCTAN, square, unroll=8)
    return jnp.where(x > 1, jnp.pi / 2 - series, series)


def _sin(x):
    """For x in [0, π]: the Taylor series of the cosine about π/2."""
    square = (x - jnp.pi / 2) ** 2
    return jnp.polyval(COSINE, square, unroll=8)


def friction_limit(load: Float[Array, "4"], surface: Float[Array, "4"]) -> Float[Array, "4"]:
    r"""N, the force where `grip` is 1: $F_z \mu k (l_0 + (l_1 - l_0) e^{\kappa F_z / F_r})$.

    Args:
      load: $F_z$, N.
      surface: $k$, friction of the ground under each wheel, 1.2 on asphalt.
    """
    sensitivity = LOAD_FACTOR_MIN + (LOAD_FACTOR_MAX - LOAD_FACTOR_MIN) * jnp.exp(
        LOAD_DECAY / RATED_LOAD * load
    )
    return load * surface * sensitivity * (MU * CAMBER_FACTOR)


def tyre_forces(
    along: Float[Array, "4"],
    across: Float[Array, "4"],
    rim: Float[Array, "4"],
    limit: Float[Array, "4"],
) -> TyreForces:
    r"""Forces opposite to the combined slip $s = (s_x, s_y)$, of size $F(|s|)$ times `limit`.

    $s_x = (v_t - \omega R) / |v_t|$, $s_y = v_n / |v|$, both with the speed floor.

    Args:
      along: $v_t$, the wheel's velocity over the ground in its own plane, m/s.
      across: $v_n$, the same to its left, m/s.
      rim: $\omega R$, m/s.
      limit: of `friction_limit`, N.
    """
    along_floor = jnp.maximum(jnp.abs(along), SPEED_FLOOR)
    slip_x = (along - rim) / along_floor
    slip_y = across / jnp.maximum(jnp.sqrt(along**2 + across**2), SPEED_FLOOR)
    slip = jnp.maximum(jnp.sqrt(slip_x**2 + slip_y**2), 1e-6)
    per_slip = limit * grip(slip) / slip
    return TyreForces(-per_slip * slip_x, -per_slip * slip_y, per_slip / along_floor)
