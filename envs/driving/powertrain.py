"""Engine, gearbox, differential and brakes: what turns the wheels."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.driving.tyres import per_axle

RPM = math.pi / 30  # rad/s
ENGINE_RPM = np.arange(0.0, 10_001.0, 1_000.0)
ENGINE_TORQUE = np.array([100, 160, 190, 280, 350, 405, 443, 465, 483, 415, 360.0])  # N m
IDLE, LIMITER, ENGINE_MAX = 900 * RPM, 9152 * RPM, 10_000 * RPM  # rad/s
ENGINE_BRAKING = 0.33
RATIOS = np.array([3.0, 1.9, 1.4, 1.1, 0.9, 0.77]) * 4.5  # gears 1 to 6, final drive included
SHIFT_TIME = 0.15  # s without drive at each change of gear
HYSTERESIS = 0.9  # of the speed of the change up, below which the gear changes down again
WHEELSPIN = 0.95  # of the limiter: driven tyres slip, so the wheels get there before the car

DIFFERENTIAL_LOCK = 300.0  # N m into the axle, from which both rear wheels turn as one
DIFFERENTIAL_SLIP = 0.2  # without torque: the largest difference of the wheels, of their sum

BRAKE_TORQUE = per_axle(5951.0, 2201.0)  # N m at full brake
WHEEL_RADIUS = per_axle(0.3306, 0.3276)  # m
WHEEL_INERTIA = per_axle(1.2228, 1.2240)  # kg m², with half the axle


def _torque(rpm):
    return np.interp(rpm, ENGINE_RPM, ENGINE_TORQUE)


def _shift_speeds() -> np.ndarray:
    """rad/s of the driven wheels from which the next gear pulls harder than gears 1 to 5 do."""
    speeds = np.linspace(1.0, 300.0, 30_000)[:, None]
    force = _torque(speeds * RATIOS / RPM) * RATIOS
    usable = speeds * RATIOS < WHEELSPIN * LIMITER
    return speeds[np.argmin((force[:, :-1] >= force[:, 1:]) & usable[:, :-1], axis=0), 0]


SHIFT_SPEEDS = _shift_speeds().astype(np.float32)
_SLOPES = np.diff(ENGINE_TORQUE) / np.diff(ENGINE_RPM * RPM)
_KINKS = np.diff(_SLOPES, prepend=0.0).astype(np.float32)


def engine_torque(speed: Float[Array, ""], accelerator: Float[Array, ""]) -> Float[Array, ""]:
    r"""N m at the crank: $T_{max}(\omega) (a (1 + e) - e)$, $e$ the engine's own braking.

    The torque curve is the sum of its kinks, which needs no table look-up.

    Args:
      speed: $\omega$, rad/s, from idle to the maximum.
      accelerator: $a$ in [0, 1].
    """
    knots = (ENGINE_RPM[:-1] * RPM).astype(np.float32)
    most = ENGINE_TORQUE[0] + (_KINKS * jnp.maximum(speed - knots, 0.0)).sum()
    drag = ENGINE_BRAKING * (speed - IDLE) / (ENGINE_MAX - IDLE)
    return most * (accelerator * (1 + drag) - drag)


def engine_speed(wheel_speed: Float[Array, "4"], gear: Int[Array, ""]) -> Float[Array, ""]:
    """rad/s: that of the driven axle times the gear, never below idle nor above the limiter."""
    ratio = _ratio(gear)
    return jnp.clip(0.5 * (wheel_speed[2] + wheel_speed[3]) * ratio, IDLE, LIMITER)


def _ratio(gear):
    one_hot = gear == np.arange(1, 7)
    return jnp.where(one_hot, RATIOS.astype(np.float32), 0.0).sum()


def change_gear(
    gear: Int[Array, ""], shifting: Float[Array, ""], forward: Float[Array, ""], dt: float
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The automatic gearbox: the gear of the most force at the car's speed, with hysteresis.

    It goes by the speed of the car over the ground, so that neither spinning nor locked wheels
    change the gear. Requests during a change wait for its end.

    Args:
      gear: 1 to 6.
      shifting: s left of a change of gear.
      forward: m/s.
    """
    wheel_speed = forward / WHEEL_RADIUS[2]
    lowest = 1 + (wheel_speed > SHIFT_SPEEDS).sum()
    highest = 1 + (wheel_speed > HYSTERESIS * SHIFT_SPEEDS).sum()
    wanted = jnp.where(shifting > 0, gear, jnp.clip(gear, lowest, highest)).astype(gear.dtype)
    shifting = jnp.where(wanted != gear, SHIFT_TIME, jnp.maximum(shifting - dt, 0.0))
    return wanted, shifting


def turn_wheels(
    wheel_speed: Float[Array, "4"],
    gear: Int[Array, ""],
    shifting: Float[Array, ""],
    accelerator: Float[Array, ""],
    brake: Float[Array, ""],
    force: Float[Array, "4"],
    stiffness: Float[Array, "4"],
    dt: float,
    power: Float[Array, ""] | float = 1.0,
) -> Float[Array, "4"]:
    r"""Wheel speeds one step later, rad/s, implicit in the tyres' forces.

    $I \dot\omega = T/2 - T_b - R F(\omega)$. Tyres hold a wheel to the ground with time constants
    below a millisecond, so $F$ is taken at the end of the step, along its secant. The limiter,
    the brakes and the differential are likewise torques found such that the step ends where
    they hold: they cannot overshoot, whatever its length.

    Args:
      force: of the tyres along the wheels at the end of the step, were the rims to keep their
        speeds, N.
      stiffness: of the tyres, N s/m.
      power: factor of the engine's torque.
    """
    ratio = _ratio(gear)
    inertia = WHEEL_INERTIA + dt * WHEEL_RADIUS**2 * stiffness
    rolling = wheel_speed - dt * WHEEL_RADIUS * force / inertia

    right, left = inertia[2], inertia[3]
    per_torque = 0.25 * dt * (1 / right + 1 / left)  # of the mean rear speed
    to_limiter = (LIMITER / ratio - 0.5 * (rolling[2] + rolling[3])) / per_torque
    torque = power * engine_torque(engine_speed(wheel_speed, gear), accelerator) * ratio
    torque = jnp.where(shifting > 0, 0.0, jnp.minimum(torque, jnp.maximum(to_limiter, 0.0)))
    drive = jnp.stack([jnp.zeros_like(torque)] * 2 + [0.5 * torque] * 2)

    driven = rolling + dt * drive / inertia
    braked = jnp.maximum(jnp.abs(driven) - dt * brake * BRAKE_TORQUE / inertia, 0.0)
    speed = jnp.sign(driven) * braked

    difference, total = speed[2] - speed[3], jnp.abs(speed[2] + speed[3])
    allowed = DIFFERENTIAL_SLIP * jnp.maximum(1 - torque / DIFFERENTIAL_LOCK, 0.0) * total
    impulse = (difference - jnp.clip(difference, -allowed, allowed)) / (1 / right + 1 / left)
    coupling = jnp.stack([jnp.zeros_like(impulse)] * 2 + [-impulse / right, impulse / left])
    return speed + coupling
