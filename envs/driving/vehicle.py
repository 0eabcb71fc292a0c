"""The car: TORCS's car1-trb1 on a plane, its body, aerodynamics and steering."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from envs.driving import powertrain, tyres
from envs.driving.setup import AS_IT_IS, Setup
from envs.driving.tyres import per_axle, total

GRAVITY = 9.80665  # m/s²
MASS = 1150.0 + 94.0  # kg, with driver and a full tank
YAW_INERTIA = 1113.0  # kg m², of the car without fuel, as TORCS has it
LENGTH, WIDTH = 4.52, 1.94  # m
WHEELBASE, MEAN_TRACK = 2.64, 1.64  # m
FRONT_SHARE = 0.52  # of the weight on the front axle
TO_FRONT, TO_REAR = (1 - FRONT_SHARE) * WHEELBASE, FRONT_SHARE * WHEELBASE  # m from the CG
PITCH_ARM = 0.25 + 0.10  # m, of forces along the car: the height of the CG with the ride height
ROLL_ARM = FRONT_SHARE * 0.07 + (1 - FRONT_SHARE) * 0.09  # m, of forces across: the roll centres
WHEEL_X = per_axle(TO_FRONT, -TO_REAR)  # m forwards of the CG
WHEEL_Y = np.array([-0.84, 0.84, -0.80, 0.80], np.float32)  # m to its left

STEER_LOCK, STEER_RATE = math.radians(21), math.radians(360)  # rad, rad/s
DRAG = 0.4273 + 0.0321 + 0.2083  # N s²/m²: body, front wing, rear wing
WINGS = per_axle(0.1286, 0.8332) / 2  # N s²/m² downwards, a wheel
GROUND_EFFECT = per_axle(0.69, 0.70) / 2  # N s²/m², times that of the height
LARGEST_YAW_RATE = 9.0  # rad/s

SPRING_TIME = 0.05  # s, in which the springs pass an acceleration on to the wheels' loads
STATIC_LOAD = GRAVITY * MASS / 2 * per_axle(FRONT_SHARE, 1 - FRONT_SHARE)  # N
PITCH_TRANSFER = MASS * PITCH_ARM / WHEELBASE / 2 * per_axle(-1.0, 1.0)  # N s²/m
SPRINGS = 98_219 * per_axle(0.9, 1.1) ** 2  # N/m at the wheels, with the levers
RIDE_HEIGHT = 0.41  # m, the sum over the wheels, at rest
ROLL_STIFFNESS = WHEEL_Y**2 * SPRINGS
ROLL_TRANSFER = -MASS * ROLL_ARM * ROLL_STIFFNESS / ROLL_STIFFNESS.sum() / WHEEL_Y  # N s²/m


class Car(struct.PyTreeNode):
    """All that a step of the car changes. World axes: x east, y north, heading anticlockwise."""

    x: jax.Array  # [] m
    y: jax.Array  # [] m
    heading: jax.Array  # [] rad in [-π, π]
    velocity_x: jax.Array  # [] m/s, along the world's x
    velocity_y: jax.Array  # [] m/s, along the world's y
    yaw_rate: jax.Array  # [] rad/s
    wheel_speed: jax.Array  # [4] rad/s, front right, front left, rear right, rear left
    steer: jax.Array  # [] rad, of the inner front wheel, left positive
    gear: jax.Array  # [] i32, 1 to 6
    shifting: jax.Array  # [] s left of the present change of gear
    push_x: jax.Array  # [] m/s², acceleration forwards as the springs feel it
    push_y: jax.Array  # [] m/s², the same to the left
    sink: jax.Array  # [] m, by which downforce has lowered the four corners together

    @property
    def body_velocity(self) -> tuple[jax.Array, jax.Array]:
        """m/s forwards and to the left."""
        c, s = jnp.cos(self.heading), jnp.sin(self.heading)
        return (
            c * self.velocity_x + s * self.velocity_y,
            c * self.velocity_y - s * self.velocity_x,
        )


def at_rest(x: Float[Array, ""], y: Float[Array, ""], heading: Float[Array, ""]) -> Car:
    """The car standing still, in first gear."""
    zero = jnp.zeros((), jnp.float32)
    return Car(
        x=x,
        y=y,
        heading=heading,
        velocity_x=zero,
        velocity_y=zero,
        yaw_rate=zero,
        wheel_speed=jnp.zeros(4, jnp.float32),
        steer=zero,
        gear=jnp.ones((), jnp.int32),
        shifting=zero,
        push_x=zero,
        push_y=zero,
        sink=zero,
    )


def wrap(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """The same angle in [-π, π]."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def wheel_directions(steer: Float[Array, ""]) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Cosine and sine of each wheel's direction; the outer front wheel turns less (Ackermann)."""
    s, c = jnp.sin(steer), jnp.cos(steer)
    inwards = MEAN_TRACK * jnp.stack([jnp.maximum(s, 0.0), jnp.maximum(-s, 0.0)])
    x, y = WHEELBASE * c + inwards, WHEELBASE * s
    size = jnp.sqrt(x**2 + y**2)
    return (
        jnp.concatenate([x / size, jnp.ones(2)]),
        jnp.concatenate([y / size, jnp.zeros(2)]),
    )


def downforce(forward: Float[Array, ""], sink: Float[Array, ""]) -> Float[Array, "4"]:
    r"""N on each wheel, of the wings and of the ground effect, which grows as the car sinks.

    $v^2 (w + c \cdot 2 e^{-3 (1.5 h)^4})$, $h$ the sum of the four ride heights   (simuv2)
    """
    height = 1.5 * (RIDE_HEIGHT - sink)
    return forward**2 * (WINGS + GROUND_EFFECT * 2 * jnp.exp(-3 * height**4))


def wheel_loads(
    lift: Float[Array, "4"],
    push_x: Float[Array, ""],
    push_y: Float[Array, ""],
    mass: Float[Array, ""] | float = 1.0,
) -> Float[Array, "4"]:
    """N on each wheel: weight, downforce, and the transfer by pitch and roll, never negative.

    Args:
      mass: of the car's own.
    """
    load = mass * STATIC_LOAD + lift
    load = load + mass * PITCH_TRANSFER * push_x + mass * ROLL_TRANSFER * push_y
    return jnp.maximum(load, 0.0)


def step_car(
    car: Car,
    steer: Float[Array, ""],
    accelerator: Float[Array, ""],
    brake: Float[Array, ""],
    friction: Float[Array, "4"],
    rolling: Float[Array, "4"],
    dt: float,
    setup: Setup = AS_IT_IS,
) -> Car:
    """The car `dt` seconds later: semi-implicit Euler, velocities first.

    Args:
      steer: in [-1, 1], of the lock, left positive.
      accelerator: in [0, 1].
      brake: in [0, 1].
      friction: of the ground under each wheel, 1.2 on asphalt.
      rolling: resistance of the ground under each wheel, of its load.
      dt: s, at most 5 ms (explicit in the body's motion: the tyres damp its yaw within 4 ms).
      setup: of this car.
    """
    c, s = jnp.cos(car.heading), jnp.sin(car.heading)
    forward = c * car.velocity_x + s * car.velocity_y
    leftward = c * car.velocity_y - s * car.velocity_x
    slew = STEER_RATE * dt
    wheel_angle = car.steer + jnp.clip(steer * STEER_LOCK - car.steer, -slew, slew)
    gear, shifting = powertrain.change_gear(car.gear, car.shifting, forward, dt)

    cos_w, sin_w = wheel_directions(wheel_angle)
    ground_x = forward - car.yaw_rate * WHEEL_Y
    ground_y = leftward + car.yaw_rate * WHEEL_X
    lift = downforce(forward, car.sink)
    load = wheel_loads(lift, car.push_x, car.push_y, setup.mass)
    tyre = tyres.tyre_forces(
        ground_x * cos_w + ground_y * sin_w,
        ground_y * cos_w - ground_x * sin_w,
        car.wheel_speed * powertrain.WHEEL_RADIUS,
        tyres.friction_limit(load, setup.grip * friction),
    )
    force_x = tyre.along * cos_w - tyre.across * sin_w
    force_y = tyre.along * sin_w + tyre.across * cos_w
    speed = jnp.sqrt(forward**2 + leftward**2)
    resistance = total(rolling * load) / jnp.maximum(speed, 1.0)
    mass = setup.mass * MASS
    push_x = (total(force_x) - resistance * forward) / mass
    push_y = (total(force_y) - resistance * leftward) / mass
    twist = total(force_y * WHEEL_X - force_x * WHEEL_Y) / (setup.mass * YAW_INERTIA)

    acceleration = push_x - setup.drag * DRAG / mass * jnp.abs(forward) * forward
    # The ground under the wheels moves on too: without it they would seem heavier than they are.
    along = tyre.along - tyre.stiffness * dt * acceleration
    wheel_speed = powertrain.turn_wheels(
        car.wheel_speed, gear, shifting, accelerator, setup.brakes * brake, along, tyre.stiffness,
        dt, setup.power,
    )  # fmt: skip
    velocity_x = car.velocity_x + dt * (c * acceleration - s * push_y)
    velocity_y = car.velocity_y + dt * (s * acceleration + c * push_y)
    yaw_rate = jnp.clip(car.yaw_rate + dt * twist, -LARGEST_YAW_RATE, LARGEST_YAW_RATE)
    spring = dt / SPRING_TIME
    return Car(
        x=car.x + dt * velocity_x,
        y=car.y + dt * velocity_y,
        heading=wrap(car.heading + dt * yaw_rate),
        velocity_x=velocity_x,
        velocity_y=velocity_y,
        yaw_rate=yaw_rate,
        wheel_speed=wheel_speed,
        steer=wheel_angle,
        gear=gear,
        shifting=shifting,
        push_x=car.push_x + spring * (push_x - car.push_x),
        push_y=car.push_y + spring * (push_y - car.push_y),
        sink=car.sink + spring * (total(lift / SPRINGS) - car.sink),
    )
