"""What the car senses: 29 values in the order and scaling that drivers of TORCS know."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.driving.bank import SIGHT, Place, TrackBank
from envs.driving.vehicle import WIDTH, Car, wrap

RAY_ANGLES = {
    "snakeoil": (
        *(-45, -19, -12, -7, -4, -2.5, -1.7, -1, -0.5),
        *(0, 0.5, 1, 1.7, 2.5, 4, 7, 12, 19, 45),
    ),
    "scr": (-90, -75, -60, -45, -30, -20, -15, -10, -5, 0, 5, 10, 15, 20, 30, 45, 60, 75, 90),
}
"""Degrees from the car's axis, clockwise (to the right) positive, as SCR counts them."""

KMH = 3.6  # km/h in a m/s
TOP_SPEED_KMH = 300.0  # the unit of the speeds observed, and of the normalised reward
OFF_TRACK = -1.0  # m, what every range finder says there
SIZE = 29
CURVATURE_SCALE = 10.0  # m: a bend of a radius of 10 m is 1
TOP_SPEED = 150.0  # m/s: no car of ours gets there


def range_finders(
    bank: TrackBank,
    track: Int[Array, ""] | int,
    cell: Int[Array, ""],
    x: Float[Array, ""],
    y: Float[Array, ""],
    heading: Float[Array, ""],
    degrees: tuple[float, ...],
) -> Float[Array, "R"]:
    """m from the point to the edge of the road along each ray, at most 200.

    A ray walks through the cells of the road: ahead, it passes the portal between two cells if it
    leaves the portal's left end on its left and the right end on its right; behind, the other way
    round. It meets the edge in the first cell that it cannot leave so. The walk is along the road
    alone, so a road that crosses another one is not seen from there.
    """
    across = np.deg2rad(np.array(degrees, np.float32))
    c, s = jnp.cos(heading), jnp.sin(heading)
    ray_x, ray_y = c * np.cos(across) + s * np.sin(across), s * np.cos(across) - c * np.sin(across)
    reach = bank.reach
    row = bank.first[track] + cell
    portals = jax.lax.dynamic_slice(bank.edges, (row - reach, 0), (2 * reach + 1, 4))
    portals = portals - jnp.stack([x, y, x, y])[None]  # as the car sees them

    def left_of_rays(points):
        return (
            ray_x[:, None] * points[None, :, 1] - ray_y[:, None] * points[None, :, 0]
        )  # [R, points]

    # Most of the work is here; the smallest integers that count so far make it a third shorter.
    number = np.arange(reach + 1, dtype=np.min_scalar_type(reach))
    behind, ahead = portals[: reach + 1], portals[reach + 1 :]
    closed = (left_of_rays(ahead[:, :2]) <= 0) | (left_of_rays(ahead[:, 2:]) >= 0)
    first_closed = jnp.where(closed, number[:-1], number[-2]).min(-1).astype(jnp.int32)
    closed = (left_of_rays(behind[:, :2]) >= 0) | (left_of_rays(behind[:, 2:]) <= 0)
    last_closed = jnp.where(closed, number, number[0]).max(-1).astype(jnp.int32)
    goes_back = last_closed < reach
    end = jnp.where(goes_back, last_closed, reach + first_closed)  # [R], cell where the ray ends

    starts, ends = portals[end], portals[end + 1]  # [R, 4]
    to_left = _meet(ray_x, ray_y, starts[:, :2], ends[:, :2])
    to_right = _meet(ray_x, ray_y, starts[:, 2:], ends[:, 2:])
    return jnp.minimum(to_left, to_right)


def bounds(position: float, lookahead: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest observation, each finite: [29 + K].

    Args:
      position: the largest |trackPos|, infinite where nothing ends an episode off the track.
      lookahead: K, the distances at which the curvature is observed.
    """
    position = min(position, float(np.finfo(np.float32).max))
    speed = TOP_SPEED * KMH / TOP_SPEED_KMH
    wheels = TOP_SPEED / 0.3 / 100.0  # of a radius of more than 0.3 m, half as fast again
    highest = [1.0, *[1.0] * 19, position, *[speed] * 3, *[1.5 * wheels] * 4, 1.5]
    lowest = [-1.0, *[OFF_TRACK / SIGHT] * 19, *(-x for x in highest[20:28]), 0.0]
    sharpest = 2 / WIDTH  # 1/m: no road turns tighter than half of it, nor is narrower than a car
    curvature = [2 * CURVATURE_SCALE * sharpest] * lookahead  # of its polyline, a little more
    return (
        np.array(lowest + [-x for x in curvature], np.float32),
        np.array(highest + curvature, np.float32),
    )


def _meet(ray_x, ray_y, start, end):
    """m along each ray to the edge from `start` to `end` [R, 2]; `SIGHT` where it misses."""
    start_left = ray_x * start[:, 1] - ray_y * start[:, 0]
    end_left = ray_x * end[:, 1] - ray_y * end[:, 0]
    start_along = ray_x * start[:, 0] + ray_y * start[:, 1]
    end_along = ray_x * end[:, 0] + ray_y * end[:, 1]
    apart = end_left - start_left
    share = -start_left / jnp.where(apart == 0, 1.0, apart)
    distance = start_along + share * (end_along - start_along)
    meets = (start_left * end_left <= 0) & (apart != 0) & (distance >= 0)
    return jnp.where(meets, jnp.minimum(distance, SIGHT), SIGHT)


def observe(
    car: Car, place: Place, rays: Float[Array, "19"], engine_speed: Float[Array, ""]
) -> Float[Array, "29"]:
    """angle, 19 range finders, trackPos, speeds X, Y, Z, 4 wheel speeds and rpm, scaled.

    The scales are those of the usual TORCS wrapper: π rad, 200 m, 1, 300 km/h, 100 rad/s and
    10,000 "rpm". What TORCS calls rpm is ten times the engine's rad/s.
    """
    forward, leftward = car.body_velocity
    speeds = jnp.stack([forward, leftward, jnp.zeros_like(forward)]) * (KMH / TOP_SPEED_KMH)
    on_track = jnp.abs(place.position) <= 1
    return jnp.concatenate(
        [
            wrap(place.heading - car.heading)[None] / jnp.pi,
            jnp.where(on_track, rays, OFF_TRACK) / SIGHT,
            place.position[None],
            speeds,
            car.wheel_speed / 100.0,
            engine_speed[None] / 1000.0,
        ]
    )
